"""Mistakes in a model or in the arguments: each gives an error that names the method and the mend (pitfall 30)."""

import re

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from models import Heat, Motion, pid, Plane, Point, Thermostat

import nsjax
from nsjax import gallery, RESULTS, saltation_matrix, solve


def friction(field=None, guard=None, **parts):
    """A class with one `sgn` switch, of which one method is wrong."""

    class Model(nsjax.System):
        def vector_field(self, t, y, s):
            return field(t, y, s) if field else Motion(y.v, -y.x - s.belt)

        @nsjax.sgn
        def belt(self, t, y):
            return guard(t, y) if guard else y.v

    for name, value in parts.items():
        setattr(Model, name, value)
    return Model()


def wall(field=lambda t, y, s: Motion(y.v, -1.0 + s.wall), **parts):
    """A class with one impact surface x >= 0."""
    switch = nsjax.impact(lambda self, t, y: y.x, name="wall")
    for name, fn in parts.items():
        switch = getattr(switch, name)(fn)

    class Model(nsjax.System):
        def vector_field(self, t, y, s):
            return field(t, y, s)

        @property
        def switches(self):
            return (switch,)

    return Model()


class OneWay(nsjax.System):
    def vector_field(self, t, y, s):
        return Heat(s.heater - y.T)

    @nsjax.relay
    def heater(self, t, y):
        return 1.0 - y.T


class Twins(nsjax.System):
    def vector_field(self, t, y, s):
        return Motion(y.v, -s.belt)

    @property
    def switches(self):
        return tuple(nsjax.sgn(lambda self, t, y: y.v, name="belt") for _ in range(2))


START = Motion(1.0, 0.5)
MODELS = {
    "unknown switch": (
        friction(lambda t, y, s: Motion(y.v, -s.blet)),
        AttributeError,
        "`Model.vector_field` asks for `s.blet`, but the system has no switch of that name.*`belt`",
    ),
    "not affine": (
        friction(lambda t, y, s: Motion(y.v, -(s.belt**2))),
        ValueError,
        "`Model.vector_field` must be affine in `s.belt`.*Use it as a factor",
    ),
    "inside a function": (
        friction(lambda t, y, s: Motion(y.v, -jnp.tanh(s.belt))),
        ValueError,
        "must be affine in `s.belt`",
    ),
    "in a where": (
        friction(lambda t, y, s: Motion(y.v, jnp.where(s.belt > 0, -y.v, s.belt))),
        ValueError,
        "must be affine|affine",
    ),
    "other structure": (
        friction(lambda t, y, s: (y.v, -s.belt)),
        ValueError,
        r"`Model.vector_field` must return the structure of the state, Motion\(x, v\), but returned \(\*, \*\)",
    ),
    "other shape": (
        friction(lambda t, y, s: Motion(y.v, -s.belt * jnp.ones(2))),
        ValueError,
        r"leaf `.v` is float64\[2\] where the state has float64\[\]",
    ),
    "other dtype": (
        friction(lambda t, y, s: Motion(y.v.astype(jnp.float32), -s.belt)),
        ValueError,
        r"leaf `.x` is float32\[\] where the state has float64\[\]",
    ),
    "h is a vector": (
        friction(guard=lambda t, y: jnp.stack([y.x, y.v])),
        ValueError,
        r"`Model.belt` must return a scalar.*float64\[2\]",
    ),
    "h is a boolean": (
        friction(guard=lambda t, y: y.v > 0),
        ValueError,
        r"`Model.belt` must return a scalar of dtype float64.*bool\[\]",
    ),
    "h is a state": (friction(guard=lambda t, y: y), ValueError, "`Model.belt` must return a scalar"),
    "two of one name": (Twins(), ValueError, "`Twins.switches` must have different names, but `belt` occurs 2 times"),
    "no law of impact": (
        wall(),
        ValueError,
        "`Model.wall` is an impact: give it either `@wall.reset`.*or `@wall.restitution`",
    ),
    "two laws of impact": (
        wall(restitution=lambda self: 0.5, reset=lambda self, t, y: y),
        ValueError,
        "give it either",
    ),
    "restitution without direction": (
        wall(lambda t, y, s: Motion(y.v, -jnp.ones_like(y.v)), restitution=lambda self: 0.5),
        ValueError,
        r"`Model.wall.restitution` needs the direction of the impulse.*`\+ s.wall / m`",
    ),
    "reset of another structure": (
        wall(reset=lambda self, t, y: (y.x, -y.v)),
        ValueError,
        "`Model.wall.reset` must return a state of the structure",
    ),
}


@pytest.mark.parametrize("case", MODELS)
def test_model(case):
    system, error, message = MODELS[case]
    with pytest.raises(error, match=re.compile(message, re.DOTALL)):
        solve(system, 0.0, 1.0, START)


def test_relay_without_off():
    with pytest.raises(ValueError, match="`OneWay.heater` is a relay without the surface.*`@heater.off`"):
        solve(OneWay(), 0.0, 1.0, Heat(0.0))


def test_relay_backwards():
    with pytest.raises(ValueError, match="`Thermostat.heater` is a relay, whose memory cannot be run backwards"):
        solve(Thermostat(), 1.0, 0.0, Heat(20.0))


def test_breakaway_is_a_number():
    class Model(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - s.belt)

        @nsjax.sgn
        def belt(self, t, y):
            return y.v

        @belt.breakaway
        def belt(self):
            return jnp.ones(3)

    with pytest.raises(ValueError, match=r"`Model.belt.breakaway` must return a scalar, but its shape is \(3,\)"):
        solve(Model(), 0.0, 1.0, START)


STICK_SLIP = gallery.StickSlip()
ARGUMENTS = {
    "class": (
        dict(system=gallery.StickSlip),
        TypeError,
        r"instance of `nsjax.System`.*Call it, with its parameters: `Model\(...\)`",
    ),
    "no system": (dict(system=lambda t, y: y), TypeError, "must be an instance of `nsjax.System`"),
    "empty": (dict(y0=()), ValueError, "`y0` must hold at least one number, but it is empty"),
    "boolean": (dict(y0=Motion(True, 0.5)), TypeError, "`y0` must hold floating point numbers"),
    "complex": (dict(y0=Motion(1j, 0.5)), TypeError, "must be real.*real and imaginary part"),
    "times": (
        dict(t1=np.asarray([1.0, 2.0])),
        ValueError,
        r"`t1` must be a scalar, but has shape \(2,\); use `jax.vmap`",
    ),
    "solver": (dict(solver=dfx.Tsit5), TypeError, r"`solver` must be a diffrax solver such as `diffrax.Tsit5\(\)`"),
    "no Runge-Kutta solver": (
        dict(solver=dfx.LeapfrogMidpoint()),
        TypeError,
        "must be a diffrax Runge-Kutta solver.*Tsit5",
    ),
    "implicit-explicit solver": (
        dict(solver=dfx.KenCarp4()),
        TypeError,
        "must be a diffrax Runge-Kutta solver.*Kvaerno5",
    ),
    "controller": (dict(stepsize_controller=1e-8), TypeError, "must be a diffrax step size controller"),
    "max_steps": (dict(max_steps=None), ValueError, "`max_steps` must be a positive integer, but got None"),
    "max_events": (dict(max_events=-1), ValueError, "`max_events` must be a positive integer, but got -1"),
    "subs": (
        dict(saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(t1=True)])),
        ValueError,
        "`saveat` must be .*without nested `subs`",
    ),
    "solver_state": (
        dict(saveat=dfx.SaveAt(t1=True, solver_state=True)),
        ValueError,
        "must not ask for `solver_state`",
    ),
    "mode: name": (
        dict(mode={"blet": 1}),
        ValueError,
        r"must name switches of the system \(`belt`\), but got `blet`. Did you mean `belt`",
    ),
    "mode: value": (dict(mode={"belt": 2}), ValueError, r"must give `belt` one of \(-1, 0, 1\), but got 2"),
    "mode: number": (dict(mode=[1, 0]), ValueError, "must have one value for each of the 1 switches"),
    "mode: relay": (
        dict(system=Thermostat(), y0=Heat(20.0), mode={"heater": -1}),
        ValueError,
        r"must give `heater` one of \(0, 1\)",
    ),
}


@pytest.mark.parametrize("case", ARGUMENTS)
def test_arguments(case):
    change, error, message = ARGUMENTS[case]
    kwargs = dict(system=STICK_SLIP, t0=0.0, t1=1.0, y0=START) | change
    with pytest.raises(error, match=re.compile(message, re.DOTALL)):
        solve(kwargs.pop("system"), kwargs.pop("t0"), kwargs.pop("t1"), kwargs.pop("y0"), **kwargs)


def test_arguments_of_saltation_matrix():
    y = Motion(0.0, 0.2)
    with pytest.raises(ValueError, match="`switch` must be one of belt, but got 'wall'"):
        saltation_matrix(STICK_SLIP, 0.0, y, "wall", -1, 0)
    with pytest.raises(ValueError, match=r"a value for each of the switches \['belt'\]"):
        saltation_matrix(STICK_SLIP, 0.0, y, "belt", {"blet": -1}, 0)
    with pytest.raises(ValueError, match="but got 2 values"):
        saltation_matrix(STICK_SLIP, 0.0, y, "belt", -1, [0, 0])


def test_switches():
    with pytest.raises(TypeError, match=r"`sgn` must decorate a method `h\(self, t, y\)`, but got 1.0"):
        nsjax.sgn(1.0)
    with pytest.raises(ValueError, match="needs a name that is an identifier"):
        nsjax.impact(lambda self, t, y: y.x)
    with pytest.raises(TypeError, match="abstract"):
        nsjax.System()


# At run time. One class a kind of result.


CHEAP = dict(solver=dfx.Heun(), stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4))


class Trap(nsjax.System):
    """x' = 1 up to the wall x <= 0, where x is set to `to`; y' = √(x - pole)."""

    to: float = 1.0
    pole: float = -9.0

    def vector_field(self, t, y, s):
        return Plane(jnp.ones_like(t), jnp.sqrt(y.x - self.pole))

    @nsjax.impact
    def wall(self, t, y):
        return -y.x

    @wall.reset
    def wall(self, t, y):
        return Plane(self.to + 0 * y.x, y.y)


def run(**kwargs):
    x = kwargs.pop("x", -1.0)
    return solve(Trap(**kwargs), 0.0, 5.0, Plane(x, 0.0), throw=False, **CHEAP).result


def test_reset_to_the_wrong_side():
    """Pitfall 3: not silently carried on from the forbidden side. One that leaves the surface for good is welcome."""
    sol = solve(Trap(to=-1.0), 0.0, 5.5, Plane(-1.0, 0.0), **CHEAP)
    np.testing.assert_allclose(sol.events.t[:5], [1, 2, 3, 4, 5], atol=1e-12)
    np.testing.assert_allclose(sol.y1.x, -0.5, atol=1e-12)
    assert run(to=1.0) == RESULTS.wrong_reset
    with pytest.raises(nsjax.SolveError, match="A reset left the state on the wrong side of its surface"):
        solve(Trap(to=1.0), 0.0, 5.0, Plane(-1.0, 0.0), **CHEAP)


def test_start_beyond_a_wall():
    assert run(x=0.5) == RESULTS.start_penetrates


def test_not_finite():
    """Pitfall 30: a field that is NaN at once, or on the way."""
    assert run(x=-20.0) == RESULTS.nonfinite_field
    assert run(pole=jnp.nan, to=-1.0) == RESULTS.nonfinite_field


def test_mode_on_the_other_side():
    sol = solve(STICK_SLIP, 0.0, 1.0, START, mode={"belt": -1}, throw=False, **CHEAP)
    assert sol.result == RESULTS.wrong_mode
    assert solve(STICK_SLIP, 0.0, 1.0, START, mode={"belt": 1}, throw=False, **CHEAP).result == RESULTS.successful
    assert solve(STICK_SLIP, 0.0, 1.0, START, mode={"belt": 0}, throw=False, **CHEAP).result == RESULTS.wrong_mode
    with pytest.raises(nsjax.SolveError, match="`mode` places the start on one side of a surface"):
        solve(STICK_SLIP, 0.0, 1.0, START, mode={"belt": -1}, **CHEAP)


def test_limits():
    """Pitfall 16: a bound on events or steps that is reached is told."""

    def bounded(tol):
        how = dict(solver=dfx.Heun(), stepsize_controller=pid(tol), max_events=3, max_steps=100, throw=False)
        return solve(STICK_SLIP, 0.0, 100.0, Motion(2.5, -0.5), **how)

    sol = bounded(1e-2)
    assert sol.result == RESULTS.max_events_reached and len(sol.events) == 3 and sol.t1 == sol.events.t[2]
    sol = bounded(1e-4)
    assert sol.result == RESULTS.max_steps_reached and sol.stats["num_steps"] == 100 and sol.t1 < 100


def test_unknown_switch_by_item():
    with pytest.raises(AttributeError, match="no switch of that name"):
        solve(friction(lambda t, y, s: Motion(y.v, -s["blet"])), 0.0, 1.0, START)


def test_smooth_models_need_no_switch():
    class Decay(nsjax.System):
        def vector_field(self, t, y, s):
            return Point(-y.x)

    with pytest.raises(ValueError, match="switches of the system .none., but got `belt`"):
        solve(Decay(), 0.0, 1.0, Point(1.0), mode={"belt": 0})

    class Missing(nsjax.System):
        def vector_field(self, t, y, s):
            return Point(-y.x * s.belt)

    with pytest.raises(AttributeError, match="Its switches are: none"):
        solve(Missing(), 0.0, 1.0, Point(1.0))
