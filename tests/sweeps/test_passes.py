"""A sweep of affine models by plain events first; what is not plain is computed by a second program."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import flat, Motion

import nsjax
from nsjax import gallery, sweep
from nsjax._numerics._first_pass import first_pass, told


class Ball(nsjax.System):
    """A ball that falls onto the ground with g = 1: from a height of 1/2 it comes to rest at t = (1 + e) / (1 - e)."""

    e: float = 0.5

    def vector_field(self, t, y, s):
        return Motion(y.v, -1.0 + s.ground)

    @nsjax.impact
    def ground(self, t, y):
        return y.x

    @ground.restitution
    def ground(self):
        return self.e


E = np.asarray([1.0, 0.9, 0.5, 0.3, 0.999])
PLAIN = np.asarray([True, True, False, False, True])  # those that do not come to rest until t = 4


def thrown(e, **how):
    """From a height of 1/2, to t = 4."""
    sol = nsjax.solve(Ball(e=e), 0.0, 4.0, Motion(0.5, 0.0), **dict(max_events=32) | how)
    return sol.y1, sol.result, sol.events.num, sol.stats["num_steps"]


def height(e, t=4.0):
    """In closed form."""
    at, v = 1.0, e  # of the first impact, and after it
    while t - at > 2 * v > 1e-12:
        at, v = at + 2 * v, e * v
    return v * (t - at) - (t - at) ** 2 / 2 if v > 1e-9 else 0.0


@pytest.fixture(scope="module")
def found():
    return sweep(thrown, E)


def test_exact_where_it_is_plain(found):
    """And where it is not, by the same method: in as many steps as arcs."""
    y1, result, events, steps = found
    np.testing.assert_allclose(y1.x, [height(float(e)) for e in E], rtol=0, atol=1e-13)
    assert np.all(result == nsjax.RESULTS.successful)
    np.testing.assert_array_equal(steps, events + 1)
    with first_pass():
        left = jax.vmap(told(lambda e: thrown(e, throw=False)))(jnp.asarray(E))[1]
    np.testing.assert_array_equal(left, ~PLAIN)


def test_single_precision():
    """Flights that are long are plain in it, too, and so is an impact sixteen roundings before the end: as many steps as
    arcs."""
    e, t1 = jnp.asarray([[1.0, 0.9, 0.8, 1.0], [4.0, 4.0, 4.0, 1 + 16 * np.finfo(np.float32).eps]], jnp.float32)
    t0, y0 = jnp.float32(0), Motion(jnp.float32(0.5), jnp.float32(0))

    def fly(e, t1):
        sol = nsjax.solve(Ball(e=e), t0, t1, y0, max_events=32, throw=False)
        return sol.y1.x, sol.events.num, sol.stats["num_steps"]

    x, events, steps = sweep(fly, e, t1)
    np.testing.assert_allclose(x, [height(float(e), float(t)) for e, t in zip(e, t1)], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(steps, events + 1)


def first(fn, *args):
    """Whether a first pass may leave something over."""
    with first_pass():
        return jax.eval_shape(told(fn), *args)[1] is not None


def test_where_there_is_a_first_pass():
    """Of affine models, by the solver that is for them or where none is named; of no others."""
    e, start = E[0], Motion(0.5, 0.0)
    assert first(thrown, e)
    assert first(lambda e: thrown(e, solver=nsjax.Affine()), e)
    assert first(lambda e: thrown(e, rtol=1e-10), e)
    assert first(lambda e: nsjax.stroboscopic_map(gallery.ForcedFriction(), start).y, e)
    assert not first(lambda e: thrown(e, solver=dfx.Tsit5()), e)
    assert not first(lambda e: thrown(e, stepsize_controller=dfx.ConstantStepSize(), dt0=0.1), e)
    assert not first(lambda e: nsjax.solve(gallery.FallingStickSlip(), 0.0, 1.0, start).y1, e)
    # The solutions of this map end on a surface, which is not plain.
    way = dict(max_time=9.0, throw=False)
    assert not first(lambda x: nsjax.poincare_map(gallery.StickSlip(), lambda t, y: y.v, Motion(x, 0.1), **way).y, e)


@pytest.mark.slow
def test_in_pieces(found):
    """On devices that are named the same lanes are left over."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(sweep(thrown, E, devices=1)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [dict(solver=dfx.Tsit5()), dict(dt0=0.1), dict(stepsize_controller=dfx.ConstantStepSize(), dt0=0.125)]
)
def test_what_is_said_of_steps(how):
    """Holds: the same number of them as without a sweep."""
    for a, b in zip(
        jax.tree.leaves(sweep(lambda e: thrown(e, **how), E)), jax.tree.leaves(jax.vmap(lambda e: thrown(e, **how))(E))
    ):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def stuck(v_dr, x0, **how):
    """Stick-slip from where the belt holds the block: at x0 = 2 at the bound of static friction."""
    return nsjax.solve(gallery.StickSlip(v_dr=v_dr), 0.0, 20.0, Motion(x0, v_dr), throw=False, **how)


@pytest.mark.slow
def test_derivatives_of_what_is_left_over():
    """By the start: two lanes at the bound of static friction among others."""
    x0 = jnp.asarray([0.5, 2.0, 1.0, 2.0, -1.5])

    def slope(x0, **how):
        return jax.jacfwd(lambda x0: stuck(0.3, x0, **how).y1)(x0)

    want = jax.vmap(lambda x0: slope(x0, rtol=1e-11, atol=1e-11))(x0)
    np.testing.assert_allclose(flat(sweep(slope, x0)), flat(want), rtol=1e-7, atol=1e-8)


def test_failures_are_told():
    """By the general flow, which raises what it does of them: of a ball that comes to rest only just before the end."""
    with pytest.raises(RuntimeError, match="maximum number of events"):
        jax.block_until_ready(sweep(thrown, jnp.asarray(E).at[3].set(0.58)))


@pytest.mark.slow
def test_statuses():
    """Those of the general flow."""
    _, result, *_ = sweep(lambda e: thrown(e, max_events=3, throw=False), E)
    few = result == nsjax.RESULTS.max_events_reached
    np.testing.assert_array_equal(np.asarray(few), [False, False, True, True, False])


@pytest.mark.slow
def test_checks_of_the_users_own():
    """One that holds of solutions must not fail of a lane that is left over; one that does not is raised."""

    def checked(limit):
        def lane(e):
            sol = nsjax.solve(Ball(e=e), 0.0, 4.0, Motion(0.5, 0.0), throw=False)
            return eqx.error_if(sol.y1.x, sol.t1 < limit, "it has not come to its end")

        return lane

    x = sweep(checked(4.0), E)
    np.testing.assert_allclose(x, [height(float(e)) for e in E], atol=1e-7)
    with pytest.raises(RuntimeError, match="not come to its end"):
        jax.block_until_ready(sweep(checked(5.0), E))


@pytest.mark.slow
def test_where_it_cannot_be_told():
    """A solution in a loop without a bound, or beside a random key, is computed by the general flow for all lanes."""

    def fallen(e):
        return jax.lax.while_loop(
            lambda x: x > 0.4, lambda x: nsjax.solve(Ball(e=e), 0.0, 0.5, Motion(x, 0.0)).y1.x, 0.5
        )

    np.testing.assert_allclose(sweep(fallen, E), 0.375, atol=1e-9)
    keys = jax.random.split(jax.random.key(0), len(E))
    same, (y1, *_) = sweep(lambda key, e: (key, thrown(e)), keys, E)
    assert jnp.all(jax.random.key_data(same) == jax.random.key_data(keys))
    np.testing.assert_allclose(y1.x, [height(float(e)) for e in E], atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ts", "steps", "dense"])
def test_saving(kind):
    """Steps are those of a solver, and dense output that of one: they are the default one's then."""
    ts = jnp.linspace(0, 4, 9)
    saveat = dfx.SaveAt(ts=ts) if kind == "ts" else dfx.SaveAt(t1=True, **{kind: True})

    def lane(e):
        more = dict(throw=False, max_steps=256, max_events=64)
        return nsjax.solve(Ball(e=e), 0.0, 4.0, Motion(0.5, 0.0), saveat=saveat, **more)

    sol = sweep(lane, E)
    if kind == "ts":
        want = [[height(float(e), float(t)) if t > 1 else 0.5 - t**2 / 2 for t in ts] for e in E]
        np.testing.assert_allclose(sol.ys.x, want, atol=1e-9)
        np.testing.assert_array_equal(sol.stats["num_steps"], sol.events.num + 1)
    else:
        np.testing.assert_array_equal(sol.stats["num_steps"], jax.vmap(lane)(E).stats["num_steps"])
