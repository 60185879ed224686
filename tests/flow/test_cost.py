"""Nothing for nothing: a model pays only for what it contains, read off its jaxpr."""

import functools
import pathlib
import subprocess
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import pytest
from models import Motion
from programs import count, equations_of

import nsjax
from nsjax import solve
from nsjax.flow._integrator import Integrator
from nsjax.flow._solve import _flow, _Options
from nsjax.flow.steppers._stepper import RungeKutta
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


CHEAP = dict(solver=dfx.Heun(), stepsize_controller=dfx.ConstantStepSize(), dt0=0.1, throw=False)


@functools.cache
def primitives(kind, derivative=lambda fn: fn, saveat=dfx.SaveAt(t1=True)):
    flow = derivative(lambda y: solve(kind(), 0.0, 1.0, y, saveat=saveat, **CHEAP).y1)
    return count(jax.make_jaxpr(flow)(Motion(jnp.ones(()), jnp.ones(()))).jaxpr)


def total(counter):
    return sum(counter.values())


@pytest.fixture(scope="module")
def free():
    return primitives(Free)


EVENT_CODE = ("compact_cond", "cond", "lu", "sort", "argmax", "argmin", "top_k", "custom_linear_solve")


def test_without_switches_no_event_code(free):
    """One loop, no branch, no search for roots, no linear algebra."""
    assert free["while"] == 1 and free["scan"] == free["rolled"]
    for name in EVENT_CODE:
        assert free[name] == 0, name
    one = primitives(Crossing)
    assert one["compact_cond"] >= 1 and one["while"] > 1
    print(total(free), total(one), total(primitives(Rubbing)))
    assert total(free) < total(one) / 3


def test_each_declaration_adds_its_own(free):
    """No switch, `sgn`, `sgn` and `impact`: no linear system for one multiplier, and derivatives where asked for, which
    add less than the program itself. (`benchmarks/cost.py` has the seconds.)"""
    programs = {system: (primitives(system), primitives(system, jax.jacfwd)) for system in (Free, Rubbing, Hitting)}
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
    assert total(primitives(Crossing)) < 0.8 * total(primitives(Rubbing))


def test_affine_surfaces_are_not_interpolated():
    """Bernstein coefficients of an affine h are its values at the control points."""
    affine, bent = primitives(Rubbing), primitives(Bent)
    print(total(affine), total(bent), affine["dot_general"], bent["dot_general"])
    assert total(affine) < total(bent) and affine["sin"] < bent["sin"]


def test_dense_output_costs_only_where_asked_for(free):
    assert total(primitives(Free, saveat=dfx.SaveAt(dense=True))) > total(free)
    assert total(primitives(Free, saveat=dfx.SaveAt(t0=True, t1=True))) < 1.2 * total(free)


class Sliders(nsjax.System):
    """Blocks that rub, each on a belt of its own."""

    number: int

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - jnp.stack([getattr(s, k.name) for k in self.switches]))

    @property
    def switches(self):
        return tuple(nsjax.sgn(lambda _, t, y, i=i: y.v[i] - 0.1 * i, name=f"rub{i}") for i in range(self.number))


def test_each_switch_adds_and_does_not_multiply():
    """Equations against the number of switches that can hold: from five to six no more than a quarter is added."""

    def equations(n):
        y = Motion(jnp.ones(n), jnp.ones(n))
        flow = jax.make_jaxpr(lambda y: solve(Sliders(n), 0.0, 1.0, y, **CHEAP).y1)(y)
        return total(count(flow.jaxpr))

    counts = [equations(n) for n in (1, 2, 5, 6)]
    print(counts)
    assert counts[1] < 2 * counts[0] and counts[3] < 1.5 * counts[2]


class Row(nsjax.System):
    """Bodies in a row, each with a stop at the one before it."""

    number: int = 2
    restitution: float = 0.6

    def vector_field(self, t, y, s):
        forces = jnp.stack([s[f"gap{i}"] for i in range(self.number)])
        return Motion(y.v, -1.0 + forces - jnp.append(forces[1:], 0.0))

    @property
    def switches(self):
        return _gaps(self.number)


@functools.cache  # switches are told apart by identity
def _gaps(number):
    def gap(i):
        switch = nsjax.impact(lambda self, t, y: y.x[i] - (y.x[i - 1] if i else 0.0), name=f"gap{i}")
        return switch.restitution(lambda self: self.restitution)

    return tuple(map(gap, range(number)))


@pytest.mark.slow
def test_programs_of_contacts_grow_with_their_number():
    """Twice as many make half as much more of a program. (What an impact leads to was traced for each contact with all
    others inside, so that a chain of eleven did not end.)"""

    def equations(n):
        y = Motion(jnp.arange(1.0, n + 1), jnp.zeros(n))
        flow = jax.make_jaxpr(lambda y: solve(Row(n), 0.0, 1.0, y, throw=False).y1)(y)
        return sum(1 for _ in equations_of(flow.jaxpr))

    few, many = equations(6), equations(12)
    assert many < 1.6 * few, (few, many)


STRESS = """
import sys; sys.path[:0] = {path}
import jax, jax.numpy as jnp, numpy as np, nsjax
jax.config.update("jax_enable_x64", True)
from test_cost import Row
from nsjax.gallery import Motion

def end(height):
    y0 = Motion(jnp.arange(1.0, 7) + height, jnp.zeros(6))
    return nsjax.solve(Row(6, 0.0), 0.0, 5.0, y0, throw=False, max_events=200).y1

lanes, heights = jax.jit(jax.vmap(end)), jnp.linspace(0, 0.5, 512)
for _ in range(30):
    found = jax.block_until_ready(lanes(heights))
np.testing.assert_allclose(found.x, 0, atol=1e-9)  # the bodies are points
np.testing.assert_allclose(found.v, 0, atol=1e-9)
alone = jax.jit(end)(heights[100])
np.testing.assert_allclose(np.stack(alone), np.stack(found)[:, 100], atol=1e-12)
print("done")
"""


@pytest.mark.slow
def test_batches_of_crowded_events_come_to_their_end():
    """Pitfall 60: six bodies that fall on each other and stay there. A batch whose lanes choose between two ways of
    looking for the modes stood still, when the linear systems within were those of LAPACK."""
    code = STRESS.replace("{path}", repr([str(pathlib.Path(__file__).parent), *sys.path]))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=400)
    assert run.returncode == 0 and run.stdout == "done\n", run.stderr


def test_multipliers_are_not_taken_to_jump():
    """Comparisons in the linear system for several multipliers are none of the model's: nothing looks for a jump in
    time, which took a quarter of such a program."""
    t, y = jnp.zeros(()), Motion(jnp.ones(2), jnp.ones(2))
    options = _Options({}, Integrator(dfx.Heun(), None).checked(t.dtype), dfx.SaveAt(t1=True))

    def jumpy(system, y):
        model = SwitchedSystem.forwards(system, t, y)
        state = model.state_at(t, y, tuple(jnp.ones((), jnp.int32) for _ in model.switches))
        return _flow(model, RungeKutta(dfx.Heun()), (t, t + 1), y, state, options).jumpy

    class Sawtooth(Rubbing):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - s.rub + t - jnp.floor(t))

    assert not any(jumpy(Sliders(2), y))
    assert jumpy(Sawtooth(), Motion(jnp.ones(()), jnp.ones(()))) == (False, True, True)


def test_the_loop_is_not_taken_for_a_count():
    """Where its condition depends on one number alone XLA looks for a count of the turns in the whole program, which took
    a quarter of the compilation."""
    flow = jax.make_jaxpr(lambda y: solve(Rubbing(), 0.0, 1.0, y, throw=False).y1)(Motion(jnp.ones(()), jnp.ones(())))
    loops = [e for e in equations_of(flow.jaxpr) if e.primitive.name == "while"]
    outermost = max(loops, key=lambda e: total(count(e.params["body_jaxpr"].jaxpr)))
    condition = outermost.params["cond_jaxpr"].jaxpr
    used = {v for e in condition.eqns for v in e.invars if v in condition.invars}
    assert len(used) > 1
