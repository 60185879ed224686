"""Nothing for nothing: a model pays only for what it contains, read off its jaxpr."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import pytest
from models import Motion
from programs import count

import nsjax
from nsjax import solve
from nsjax.system._model import SwitchedSystem


class Free(nsjax.System):
    """x'' = -x."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x)


class Crossing(nsjax.System):
    """x'' = -x - sgn(x): its value does not act on x', so that nothing can slide."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.side)

    @nsjax.sgn
    def side(self, t, y):
        return y.x


class Rubbing(nsjax.System):
    """x'' = -x - sgn(v): it may stick."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.rub)

    @nsjax.sgn
    def rub(self, t, y):
        return y.v


class Hitting(Rubbing):
    """The same with a wall."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.rub - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return 2 - y.x

    @wall.restitution
    def wall(self):
        return 0.5


class Bent(Rubbing):
    """The same, with a surface that is not affine."""

    @nsjax.sgn
    def rub(self, t, y):
        return jnp.sin(y.v)


class Idle(nsjax.System):
    """A switch by which nothing changes."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x)

    @nsjax.sgn
    def side(self, t, y):
        return y.x


def primitives(system, derivative=lambda fn: fn, **kwargs):
    kwargs = dict(solver=dfx.Heun(), stepsize_controller=dfx.ConstantStepSize(), dt0=0.1, throw=False) | kwargs
    flow = derivative(lambda y: solve(system, 0.0, 1.0, y, **kwargs).y1)
    return count(jax.make_jaxpr(flow)(Motion(jnp.ones(()), jnp.ones(()))).jaxpr)


def total(counter):
    return sum(counter.values())


@pytest.fixture(scope="module")
def free():
    return primitives(Free())


EVENT_CODE = ("compact_cond", "cond", "scan", "lu", "sort", "argmax", "argmin", "top_k", "custom_linear_solve")


def test_without_switches_no_event_code(free):
    """One loop, no branch, no search for roots, no linear algebra."""
    assert free["while"] == 1
    for name in EVENT_CODE:
        assert free[name] == 0, name
    one = primitives(Crossing())
    assert one["compact_cond"] >= 1 and one["while"] > 1
    print(total(free), total(one), total(primitives(Rubbing())))
    assert total(free) < total(one) / 3


def test_each_declaration_adds_its_own(free):
    """No switch, `sgn`, `sgn` and `impact`: no linear system for one multiplier, and derivatives where asked for, which
    add less than the program itself. (`benchmarks/cost.py` has the seconds.)"""
    programs = {system: (primitives(system()), primitives(system(), jax.jacfwd)) for system in (Free, Rubbing, Hitting)}
    print({system.__name__: tuple(map(total, both)) for system, both in programs.items()})
    for plain, derived in programs.values():
        assert total(plain) < total(derived) < 2 * total(plain)
    for less, more in ((Free, Rubbing), (Rubbing, Hitting)):
        assert all(2 * total(a) < total(b) for a, b in zip(programs[less], programs[more]))
    assert all(program[name] == 0 for program in programs[Free] for name in EVENT_CODE)
    assert all(program["lu"] == 0 for program in programs[Rubbing])


def test_no_multiplier_where_nothing_slides():
    t, y = jnp.zeros(()), Motion(jnp.ones(()), jnp.ones(()))

    def slots(system):
        return [(s.switch, s.holding) for s in SwitchedSystem(system, jnp.ones(()), t, y).slots]

    assert slots(Free()) == []
    assert slots(Crossing()) == [(0, False)] == slots(Idle())
    assert slots(Rubbing()) == [(0, False), (0, True), (0, True)]
    assert total(primitives(Crossing())) < 0.8 * total(primitives(Rubbing()))


def test_affine_surfaces_are_not_interpolated():
    """Bernstein coefficients of an affine h are its values at the control points."""
    affine, bent = primitives(Rubbing()), primitives(Bent())
    print(total(affine), total(bent), affine["dot_general"], bent["dot_general"])
    assert total(affine) < total(bent) and affine["sin"] < bent["sin"]


def test_dense_output_costs_only_where_asked_for(free):
    assert total(primitives(Free(), saveat=dfx.SaveAt(dense=True))) > total(free)
    assert total(primitives(Free(), saveat=dfx.SaveAt(t0=True, t1=True))) < 1.2 * total(free)
