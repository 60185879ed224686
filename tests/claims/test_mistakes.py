"""Forty mistakes, each told in one line that names the argument, the value or the place, and the remedy,
without a compilation where the numbers are known."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from models import CHEAP, Motion, pid

import nsjax
from nsjax import gallery, solve, SolveError
from nsjax._numerics import _compile


BELT = gallery.StickSlip(v_dr=0.2, F_slip=1.0, F_stick=2.0)
AT = Motion(1.0, 0.0)


def belt(**parameters: Any) -> nsjax.System:
    return gallery.StickSlip(**parameters)


def run(system: Any = BELT, t0: Any = 0.0, t1: Any = 1.0, y0: Any = AT, **kwargs: Any) -> Any:
    return solve(system, t0, t1, y0, **kwargs)


def saved(*ts: float) -> dfx.SaveAt:
    return dfx.SaveAt(ts=jnp.asarray(ts))


# Found before anything is compiled.
AT_ONCE = {
    "a class for a system": (lambda: run(gallery.StickSlip), TypeError, "`system` must be an instance.*Call it"),
    "a state that is NaN": (lambda: run(y0=Motion(jnp.nan, 0.0)), ValueError, "`y0` must be finite.*`x` is nan"),
    "a state without numbers": (lambda: run(y0=()), ValueError, "`y0` must hold at least one number"),
    "a truth value in the state": (lambda: run(y0=Motion(True, 0.0)), TypeError, "`y0` must hold.*leaf of dtype bool"),
    "a tolerance and a controller": (
        lambda: run(rtol=1e-6, stepsize_controller=dfx.ConstantStepSize(), dt0=0.1),
        ValueError,
        "`stepsize_controller` must not be given together with `rtol`.*Drop `rtol`, or drop",
    ),
    "a tolerance that is a word": (lambda: run(atol="small"), TypeError, "`atol` must be a number.*but got 'small'"),
    "a tolerance below zero": (lambda: run(rtol=-1e-6), ValueError, "`rtol` and `atol` must have rtol >= 0.*-1e-06"),
    "tolerances of zero": (lambda: run(rtol=0, atol=0), ValueError, "`rtol` and `atol`.*above zero"),
    "a tolerance below rounding": (lambda: run(rtol=1e-17), ValueError, "`rtol` and `atol`.*float64 can hold.*Loosen"),
    "a complex state": (lambda: run(y0=Motion(1j, 0.0)), TypeError, "`y0` must be real"),
    "a state that is a word": (lambda: run(y0=Motion("a", 0.0)), TypeError, "`y0` must hold.*leaf 'a'"),
    "a state with a hole": (lambda: run(y0=Motion(None, 0.0)), TypeError, "`y0` must hold.*leaf None"),
    "an infinite end": (lambda: run(t1=jnp.inf), ValueError, "`t1` must be finite, but is inf"),
    "a start that is NaN": (lambda: run(t0=jnp.nan), ValueError, "`t0` must be finite, but is nan"),
    "a vector of ends": (lambda: run(t1=np.ones(3)), ValueError, r"`t1` must be a scalar.*use `jax.vmap`"),
    "a parameter that is NaN": (lambda: run(belt(k=jnp.nan)), ValueError, "`k` of `StickSlip`.*is NaN"),
    "a parameter that is None": (
        lambda: run(belt(k=None)),
        TypeError,
        "`k` of `StickSlip` must be a number, but is None",
    ),
    "a parameter that is a word": (
        lambda: run(belt(k="1")),
        TypeError,
        "`k` of `StickSlip` must be a number, but is '1'",
    ),
    "friction weaker at rest": (lambda: run(belt(F_stick=0.5)), ValueError, "belt.breakaway` must be at least 1.*0.5"),
    "restitution above 1": (lambda: run(gallery.BouncingBall(e=1.5)), ValueError, "restitution` must be.*0 to 1.*1.5"),
    "restitution below 0": (
        lambda: run(gallery.BouncingBall(e=-0.1)),
        ValueError,
        "restitution` must be.*0 to 1.*-0.1",
    ),
    "rtol below 0": (
        lambda: run(stepsize_controller=pid(-1.0)),
        ValueError,
        "must have rtol >= 0, but got rtol = -1.0",
    ),
    "no step": (
        lambda: run(stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6, dtmax=0.0)),
        ValueError,
        "must have a step `dtmax` above zero, but got dtmax = 0.0",
    ),
    "no tolerance": (lambda: run(stepsize_controller=pid(0.0)), ValueError, "tolerance above zero"),
    "rtol below rounding": (lambda: run(stepsize_controller=pid(1e-17)), ValueError, "Loosen the tolerance"),
    "a number for a controller": (
        lambda: run(stepsize_controller=1e-8),
        TypeError,
        "must be a diffrax step size contr",
    ),
    "dt0 below 0": (lambda: run(dt0=-0.1), ValueError, "`dt0` must be a time above zero.*-0.1"),
    "no steps": (lambda: run(max_steps=0), ValueError, "`max_steps` must be a positive integer"),
    "tol of solve": (lambda: run(tol=1e-8), TypeError, "no argument `tol`.*`rtol=..., atol=...`"),
    "ts of solve": (lambda: run(ts=[1.0]), TypeError, r"no argument `ts`.*SaveAt\(ts"),
    "a misspelt argument": (lambda: run(max_event=3), TypeError, "no argument `max_event`. Did you mean `max_events`"),
    "a misspelt parameter": (lambda: belt(F_slipp=1.0), TypeError, "`StickSlip` has no parameter `F_slipp`.*`F_slip`"),
    "a mode that is a word": (lambda: run(mode="slide"), ValueError, r"`mode` must be numbers.*\{'belt': 0\}"),
    "a switch's mode that is a word": (lambda: run(mode={"belt": "slide"}), ValueError, "`belt` one of .*'slide'"),
    "a mode that is none": (lambda: run(mode={"belt": 2}), ValueError, r"`belt` one of \(-1, 0, 1\), but got 2"),
    "a misspelt switch": (lambda: run(mode={"bel": 0}), ValueError, "but got `bel`. Did you mean `belt`"),
    "too many modes": (lambda: run(mode=[0, 1]), ValueError, "one value for each of the 1 switches"),
    "unsorted save times": (lambda: run(saveat=saved(0.5, 0.2)), ValueError, "in another order; sort them"),
    "a save time too late": (lambda: run(saveat=saved(0.5, 2.0)), ValueError, "t1 = 1, but got 2.0"),
    "a save time that is NaN": (lambda: run(saveat=saved(0.5, np.nan)), ValueError, "but got nan"),
    "a period for a forced system": (
        lambda: nsjax.find_orbit(gallery.thesis("6.6"), AT, period=3.0),
        ValueError,
        "`period` must not be given for a forced system; use `order`",
    ),
    "a period of an orbit below 0": (
        lambda: nsjax.find_orbit(BELT, AT, period=-1.0),
        ValueError,
        "`period` must be positive, but got -1",
    ),
    "a misspelt argument of find_orbit": (
        lambda: nsjax.find_orbit(BELT, AT, periods=13.5),
        TypeError,
        "`find_orbit` has no argument `periods`. Did you mean `period`",
    ),
    "a misspelt parameter of a branch": (
        lambda: nsjax.continue_equilibrium(BELT, AT, "v_drr", (0.1, 0.5)),
        ValueError,
        "but got 'v_drr'. Did you mean `v_dr`",
    ),
}


@pytest.fixture
def no_programs(monkeypatch):
    """Every program of the library that is called from outside fails."""

    def refuse():
        raise AssertionError("a program is called")

    monkeypatch.setattr(_compile, "without_collection", refuse)


@pytest.mark.parametrize("name", AT_ONCE)
def test_told_at_once(name, no_programs):
    mistake, kind, text = AT_ONCE[name]
    with pytest.raises(kind, match=text) as caught:
        mistake()
    assert "\n" not in str(caught.value)


def test_a_program_would_be_noticed(no_programs):
    with pytest.raises(AssertionError, match="a program is called"):
        run()


class Number(NamedTuple):
    x: Array


class Power(nsjax.System):
    """x' = x^p up to t = `end`, and no field from there on. With p = 2 it is beyond all bounds at t = 1 from x = 1."""

    p: float = 2.0
    end: float = 9.0

    def vector_field(self, t, y, s):
        return Number(jnp.where(t > self.end, jnp.nan, y.x**self.p))


class Level(nsjax.System):
    """An indicator function that is none for x < 0, or one that jumps."""

    jumps: float = 0.0

    def vector_field(self, t, y, s):
        return Number(-1.0 - 0.1 * s.level)

    @nsjax.sgn
    def level(self, t, y):
        return jnp.where(self.jumps > 0, y.x - jnp.round(3 * y.x + 0.01), jnp.log(y.x) + 50)


class Diode(nsjax.System):
    """A current that is to be kept at zero by an impact, the force of which acts on its rate."""

    def vector_field(self, t, y, s):
        return Number(-1.0 + s.blocks)

    @nsjax.impact
    def blocks(self, t, y):
        return y.x

    @blocks.restitution
    def blocks(self):
        return 0.0


class Spring(nsjax.System):
    """A force of constant size towards x = 0, which holds a mass at rest there."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -s.middle - 0.5 * y.v)

    @nsjax.sgn
    def middle(self, t, y):
        return y.x


# Found while it is solved: the place is named.
FEW = dict(max_steps=200, max_events=2)
ON_THE_WAY = {
    "a finite-time blow-up": (
        lambda: run(Power(), t1=2.0, y0=Number(1.0)),
        "t = 1.0000.*x = .*grows beyond all bounds",
    ),
    "a field that ends": (
        lambda: run(Power(p=0.0, end=0.7), t1=2.0, y0=Number(0.0)),
        "not finite.* next to t = 0.7, x = 0.7",
    ),
    "an undefined surface": (lambda: run(Level(), t1=2.0, y0=Number(1.0)), "`Level.level` returned nan at t = "),
    "a field that divides by zero": (
        lambda: run(Power(p=-1.0), y0=Number(0.0)),
        "`Power.vector_field` returned inf for `x` at t = 0",
    ),
    "a surface that jumps": (
        lambda: run(Level(jumps=1.0), t1=2.0, y0=Number(0.7)),
        "`Level.level` jumps at t = 0.22.*nsjax.clock",
    ),
    "a start on the other side": (
        lambda: run(mode={"belt": 0}),
        "`y0` lies clearly on the other. .At t = 0, x = 1, v = 0",
    ),
    "too few steps": (
        lambda: run(belt(k=1e4, v_dr=1e3), t1=40.0, **FEW),
        "reached after .* % of the time. Write `max_steps=[0-9]+000`, .*At t = ",
    ),
    "no step gets anywhere": (
        lambda: run(Power(p=2.0), t1=2.0, y0=Number(1.0), max_steps=3),
        "reached after [0-9.e-]+ % of the time",
    ),
    "a diode as an impact": (
        lambda: run(Diode(), t1=2.0, y0=Number(0.5)),
        "`Diode.blocks` is an impact.* acts on dh/dt.*such as an ideal diode, is a `sgn`",
    ),
    "a sign of a position at rest": (
        lambda: run(Spring(), t1=2.0, y0=Motion(0.0, 0.0)),
        "comes to rest on the surface of `Spring.middle` with h = dh/dt = 0, but `s.middle` acts on d²h/dt²",
    ),
    "too few events": (lambda: run(t1=90.0, y0=Motion(2.5, 0.0), **FEW), "Increase `max_events`.*At t = 15.7"),
}


@pytest.mark.parametrize("name", ON_THE_WAY)
def test_told_with_the_place(name):
    mistake, text = ON_THE_WAY[name]
    with pytest.raises(SolveError, match=text) as caught:
        mistake()
    assert "\n" not in str(caught.value)


def test_under_jit_and_in_batches():
    """Where numbers are traced the result tells, lane by lane, or an error within the program."""
    ends = jax.jit(jax.vmap(lambda x: solve(Power(), 0.0, 2.0, Number(x), throw=False, **CHEAP).result))(
        jnp.asarray([1.0, 0.1])
    )
    np.testing.assert_array_equal(ends == nsjax.RESULTS.dt_min_reached, [True, False])
    np.testing.assert_array_equal(ends == nsjax.RESULTS.successful, [False, True])
    bad = jax.jit(lambda b: solve(belt(F_stick=b), 0.0, 1.0, AT, throw=False, **CHEAP).result)(jnp.asarray(0.5))
    assert bad == nsjax.RESULTS.wrong_parameter
    with pytest.raises(Exception, match="breakaway bound is at least 1"):
        jax.jit(lambda b: solve(belt(F_stick=b), 0.0, 1.0, AT, **CHEAP).y1)(jnp.asarray(0.5))


def test_printed():
    """Every result prints itself in a few lines, batched or not."""
    sol = run(t1=90.0, y0=Motion(2.5, 0.0))
    assert str(sol.result).endswith("<successful>")
    assert [event.t for event in sol.events[-2:]] == [event.t for event in sol.events][-2:] and not sol.events[99:]
    text = str(sol)
    assert len(text.splitlines()) <= 14 and "x = " in text and "belt: belt -1 -> +0" in text and " more ..." in text
    assert repr(sol) == text and "<pre>" in sol._repr_html_() and "&gt;" in sol._repr_html_()
    many = jax.vmap(lambda x: solve(BELT, 0.0, 40.0, Motion(x, 0.0 * x), **CHEAP))(jnp.asarray([1.0, 2.5]))
    assert str(many).startswith("2 solutions of StickSlip") and "2 successful" in str(many)
    low, high = sorted(int(n) for n in many.events.num)
    assert str(many.events) == f"event logs of 2 solutions, {low} to {high} events each"
    with pytest.raises(TypeError, match="batch"):
        len(many.events)


def test_modes_of_every_kind_of_integer():
    """What `Solution.mode1` holds, and NumPy's integers, are modes."""
    for value in (1, np.int32(1), np.int64(1), jnp.asarray(1, jnp.int32)):
        for mode in ({"belt": value}, [value]):
            assert run(mode=mode, throw=False).result == nsjax.RESULTS.wrong_mode


class Kicked(nsjax.System):
    """An oscillator that is kicked at t = 1, written as an impact on the time."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x)

    @nsjax.impact
    def kick(self, t, y):
        return 1 - t

    @kick.reset
    def kick(self, t, y):
        return Motion(y.x, y.v + 1)


def test_a_reset_at_a_given_time_is_told_what_to_write():
    with pytest.raises(
        SolveError, match="`Kicked.kick` depends on the time alone.*`nsjax.clock`.*`@kick.reset` of the clock.*t = 1,"
    ):
        run(Kicked(), t1=2.0)
