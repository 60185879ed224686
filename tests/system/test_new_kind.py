"""A kind of switch that the package does not know: a dead zone, with three modes, defined by a model's author."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nsjax
from nsjax import solve


class deadzone(nsjax.LevelSwitch):
    """0 while |h| is below the width of its model, else the sign of h; with `hold` below 1 it goes back to 0 only at
    `hold` times the width."""

    modes = (-1, 0, 1)

    def margin(self, system, t, y, mode):
        h = self.guard(system, t, y)
        return jnp.where(mode == 0, system.w**2 - h**2, jnp.where(mode > 0, h, -h) - system.hold * system.w)

    def mode_at(self, system, t, y, before):
        h = self.guard(system, t, y)
        beyond = jnp.where((before != 0) & ((h > 0) == (before > 0)), system.hold, 1.0) * system.w
        return jnp.where(jnp.abs(h) > beyond, jnp.sign(h), 0).astype(jnp.int32)

    def next_mode(self, system, t, y, mode):
        return jnp.where(mode == 0, jnp.sign(self.guard(system, t, y)), 0).astype(jnp.int32)

    def smoothed_value(self, system, t, y, sign):
        h = self.guard(system, t, y)
        return 0.5 * (sign(h - system.w) + sign(h + system.w))


class Play(nsjax.System):
    """A mass between two springs that do not touch it in the middle: x'' = -c x' - s (s x - w) + load."""

    w: Any = 0.5
    c: Any = 0.0
    load: Any = 0.0
    hold: Any = 1.0

    @deadzone
    def gap(self, t, y):
        return y["x"]

    def vector_field(self, t, y, s):
        spring = s.gap * (s.gap * y["x"] - self.w)
        return {"x": y["v"], "v": -self.c * y["v"] - spring + self.load}


class Shaken(Play):
    """The same with the force cos t."""

    period = 2 * np.pi

    def vector_field(self, t, y, s):
        rates = super().vector_field(t, y, s)
        return rates | {"v": rates["v"] + jnp.cos(t)}


START = {"x": 0.0, "v": 2.0}


def test_solution_and_derivatives():
    """Straight lines between half periods of a harmonic oscillator: events at w/v, w/v + π, 3 w/v + π, ..."""
    sol = solve(Play(), 0.0, 11.0, START)
    share = 0.25
    np.testing.assert_allclose(
        [float(e.t) for e in sol.events],
        np.array(
            [
                share,
                share + np.pi,
                3 * share + np.pi,
                3 * share + 2 * np.pi,
                5 * share + 2 * np.pi,
                5 * share + 3 * np.pi,
            ]
        ),
        rtol=1e-8,
    )
    assert [(e.switch, e.mode_before["gap"], e.mode_after["gap"]) for e in sol.events] == [
        ("gap", 0, 1), ("gap", 1, 0), ("gap", 0, -1), ("gap", -1, 0), ("gap", 0, 1), ("gap", 1, 0),
    ]  # fmt: skip
    # On the last straight line x = w - v (t - t_6), in which t_6 = 5 w / v + 3 π.
    np.testing.assert_allclose(sol.y1["x"], 0.5 - 2 * (11 - 5 * share - 3 * np.pi), rtol=1e-7)
    slope = jax.jacfwd(lambda w: solve(Play(w), 0.0, 11.0, START).y1["x"])(0.5)
    np.testing.assert_allclose(slope, 1 + 5, rtol=1e-6)


def test_sweep():
    widths = jnp.linspace(0.3, 0.7, 9)
    ends = nsjax.sweep(lambda w: solve(Play(w), 0.0, 3.0, START).y1["x"], widths)
    # Beyond the gap until w/v + π > 3.
    np.testing.assert_allclose(ends, widths + 2 * np.sin(3 - widths / 2), rtol=1e-6)


def test_memory():
    """Within a hysteresis the mode is the one before: `mode=` says which."""
    model, y0 = Play(hold=0.6), {"x": 0.4, "v": 0.0}
    for given, acceleration in ((0, 0.0), (1, 0.5 - 0.4)):
        sol = solve(model, 0.0, 1e-3, y0, mode={"gap": given})
        np.testing.assert_allclose(sol.y1["v"], 1e-3 * acceleration, rtol=1e-5, atol=1e-12)


def forced(t, y, model):
    x, v = y
    return v, -model.c * v - np.sign(x) * max(abs(x) - model.w, 0) + model.load + np.cos(t)


def test_orbit():
    model = Shaken(c=0.2)
    orbit = nsjax.find_orbit(model, START)
    assert len(orbit.events) == 4
    begin = [float(orbit.y0["x"]), float(orbit.y0["v"])]
    t0 = float(orbit.t0)
    end = solve_ivp(forced, (t0, t0 + 2 * np.pi), begin, "DOP853", rtol=1e-11, atol=1e-12, args=(model,)).y[:, -1]
    np.testing.assert_allclose(end, begin, atol=1e-7)
    # The field is continuous, so that by Liouville's theorem the multipliers have the product exp(-c T).
    np.testing.assert_allclose(np.prod(orbit.multipliers).real, np.exp(-0.2 * 2 * np.pi), rtol=1e-7)


def test_equilibria():
    model = Play(c=0.2, load=0.3)
    rest = nsjax.find_equilibrium(model, {"x": 0.1, "v": 0.0})
    np.testing.assert_allclose(rest.y["x"], 0.8, rtol=1e-12)
    assert rest.stable and rest.admissible and int(rest.mode[0]) == 1
    virtual = nsjax.find_equilibrium(model, {"x": 0.1, "v": 0.0}, mode={"gap": -1})
    assert not virtual.admissible
    branch = nsjax.continue_equilibrium(model, rest.y, "load", (0.1, 1.0))
    np.testing.assert_allclose(branch.ys["x"], branch.values + 0.5, rtol=1e-9)
    assert np.isclose(branch.values[-1], 1.0) and branch.stable.all()


def test_smoothed():
    """Smoothed it has no events, and its solution converges to that with events."""
    model = Play(c=0.1)
    exact = solve(model, 0.0, 10.0, START).y1["x"]
    errors = []
    for eps in (100.0, 400.0):
        smooth = nsjax.smoothed(model, eps, "tanh")
        assert smooth.switches == ()
        errors.append(abs(float(solve(smooth, 0.0, 10.0, START).y1["x"] - exact)))
    assert errors[1] < 0.5 * errors[0] < 5e-3


def test_banded_leaves_it():
    with pytest.raises(ValueError, match="must have a `sgn` switch.*has only `gap`"):
        nsjax.banded(Play(), 1e-3)


def test_printed_and_drawn():
    sol = solve(Play(), 0.0, 12.0, START, saveat=dfx.SaveAt(dense=True))
    assert "gap: gap +0 -> +1" in str(sol)
    ax = nsjax.plot.phase_portrait(sol, "x", "v")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {f"gap {mode}{end}" for mode in ("-1", "+0", "+1") for end in ("", " ends")} <= set(labels)
    plt.close("all")


def test_backwards():
    with pytest.raises(ValueError, match="`Play.gap` is a deadzone, whose mode depends on the one before it"):
        solve(Play(), 1.0, 0.0, START)


def test_sweeps_solve_it_by_the_general_flow():
    assert not isinstance(nsjax.method_for(Play(), 0.0, START), nsjax.Affine)
