"""A sweep is `jax.vmap` with the method that the model decides, wherever the sweep stands."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import gallery, method_for, sweep


LANES = 4


def ended(system, entry, **how):
    """A function of a share: the end of the solution that starts that much further from zero than the entry's."""

    def end(share):
        y0 = jax.tree.map(lambda y: jnp.asarray(y) * (1 + share), entry.y0)
        sol = nsjax.solve(system, entry.t0, entry.t1, y0, throw=False, max_steps=8192, **how)
        return sol.y1, dict(mode=sol.mode1, result=sol.result, events=sol.events.num, unique=sol.unique)

    return end


def check(key, *contexts):
    """Compares the sweep that is called directly with others, and with `jax.vmap`."""
    entry = gallery.SYSTEMS[key]
    system, shares = entry.system(), jnp.linspace(0.0, 0.02, LANES)
    fn, named = ended(system, entry), ended(system, entry, solver=method_for(system, entry.t0, entry.y0))

    def swept(shares):
        return sweep(fn, shares)

    others = dict(
        jit=lambda: jax.jit(swept)(shares),
        jvp=lambda: jax.jvp(swept, (shares,), (jnp.ones_like(shares),))[0],
        vmap=lambda: jax.jit(jax.vmap(named))(shares),
    )
    y, rest = swept(shares)
    size = 1 + max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(y))
    for context in contexts:
        other, more = others[context]()
        jax.tree.map(np.testing.assert_array_equal, rest, more)
        for a, b in zip(jax.tree.leaves(y), jax.tree.leaves(other)):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * size, err_msg=context)


def test_wherever_it_stands():
    """Called directly and within `jax.jit`."""
    check("(2.3)", "jit")


@pytest.mark.slow
@pytest.mark.parametrize("key", ["3.4", "6.8"])
def test_within_derivatives(key):
    check(key, "jvp")


@pytest.mark.slow
@pytest.mark.parametrize("key", gallery.SYSTEMS)
def test_the_gallery(key):
    """`jax.vmap` with the method that the model decides is the same, for every system."""
    check(key, "jit", "vmap")


@pytest.mark.parametrize("key", ["2.4", "3.4", "6.6", "6.8", "A.9", "buck converter", "relay servo"])
def test_the_model_decides(key):
    """Whether it is affine in all modes, with switches and forcing for which there is an exact flow; not its numbers."""
    entry = gallery.SYSTEMS[key]
    solver = method_for(entry.system(), entry.t0, entry.y0)
    assert isinstance(solver, nsjax.Affine if key in ("3.4", "6.6", "6.8", "relay servo") else dfx.Tsit5)


def test_within_other_functions():
    """Of numbers that are being traced, and of a model that is wrong."""
    solvers = []

    def end(v_dr):
        system = gallery.StickSlip(v_dr=v_dr)
        solvers.append(method_for(system, 0.0, Motion(v_dr, 0.0)))
        return v_dr

    jax.jit(end)(0.2)
    assert isinstance(solvers[0], nsjax.Affine)
    with pytest.raises(TypeError, match="system"):
        method_for("3.4", 0.0, Motion(0.0, 0.0))
