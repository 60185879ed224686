"""Time against error: the table, what is in it, and its picture."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import reference
from models import Motion

import nsjax
from nsjax import gallery, Method, work_precision
from nsjax._work_precision import Row


def end(system, method):
    return method.solve(system, 0.0, 10.0, Motion(2.5, -0.5)).y1


SYSTEM = gallery.StickSlip(v_dr=0.5)
METHODS = {"Tsit5": dfx.Tsit5(), "band": Method(dfx.Tsit5(), lambda s: nsjax.banded(s, 1e-3))}


def exactly():
    return reference.stick_slip_final(np.array([0.5]), 10.0)[0]


@pytest.fixture(scope="module")
def table():
    """(To count evaluations each row is a program more, and a reference is two.)"""
    return work_precision(SYSTEM, end, METHODS, (1e-6,), repeats=2, count=True, reference=exactly())


@pytest.mark.slow
def test_errors_are_true():
    """Those of the event-driven method fall with the tolerance, those of the band do not; the reference agrees with the
    closed form."""
    table, exact = work_precision(SYSTEM, end, METHODS, (1e-6, 1e-10), repeats=2), exactly()
    assert table.doubt < 1e-11
    again = work_precision(SYSTEM, end, {"Tsit5": dfx.Tsit5()}, (1e-6, 1e-10), repeats=1, reference=exact)
    assert again.doubt == 0
    errors = {(r.method, r.tolerance): r.error for r in (*table.rows, *again.rows)}
    for row in table.rows:
        np.testing.assert_allclose(row.error, errors[row.method, row.tolerance], atol=1e-11)
        assert row.seconds > 0 and row.compile_seconds > 0 and row.failure == ""
    assert errors["Tsit5", 1e-10] < 1e-9 < 1e-7 < errors["Tsit5", 1e-6] < 1e-4
    np.testing.assert_allclose(errors["band", 1e-10], errors["band", 1e-6], rtol=0.2)
    assert errors["band", 1e-10] > 1e-5


class Decay(nsjax.System):
    rate: float = 1.0

    def vector_field(self, t, y, s):
        return -self.rate * y


def left(system, method):
    return method.solve(system, 0.0, 1.0, jnp.ones(())).y1


def slope(system, method):
    return jax.jacfwd(lambda rate: left(Decay(rate), method))(jnp.asarray(system.rate))


def test_the_reference_by_default():
    """It is found by two methods, and how far they are apart is told."""
    table = work_precision(Decay(), left, {"Tsit5": dfx.Tsit5()}, (1e-4, 1e-8), repeats=1)
    loose, tight = work_precision(
        Decay(), left, {"Tsit5": dfx.Tsit5()}, (1e-4, 1e-8), repeats=1, reference=np.exp(-1)
    ).rows
    np.testing.assert_allclose([row.error for row in table.rows], [loose.error, tight.error], atol=1e-12)
    assert 0 <= table.doubt < 1e-12 and tight.error < 1e-7 < loose.error < 1e-3


def test_evaluations_are_counted(table):
    """Six a step of Tsit5, and for the multiplier one at each of four points between them; some more at events."""
    rows = [r for r in table.rows if r.method == "Tsit5"]
    for row in rows:
        control = dfx.PIDController(rtol=row.tolerance, atol=row.tolerance)
        sol = nsjax.solve(SYSTEM, 0.0, 10.0, Motion(2.5, -0.5), stepsize_controller=control)
        steps, events = int(sol.stats["num_steps"]), int(sol.stats["num_events"])
        assert 9 * steps <= row.evaluations <= 10 * steps + 40 * (events + 1)


def test_print(table):
    lines = str(table).splitlines()
    assert lines[0] == "| method | tolerance | error | seconds | evaluations | compile [s] |"
    assert len(lines) == 2 + len(METHODS) and lines[2].startswith("| Tsit5 | 1e-06 | ")
    exact = nsjax.WorkPrecision(table.rows, doubt=1.0)
    assert "< 1e+00" in str(exact)


def test_picture(table):
    ax = nsjax.plot.work_precision(table)
    assert ax.get_xscale() == ax.get_yscale() == "log" and ax.xaxis_inverted()
    assert [line.get_label() for line in ax.lines[:2]] == ["Tsit5", "band"]
    ax = nsjax.plot.work_precision(table, against="evaluations", unit="m")
    assert ax.get_xlabel() == "error [m]" and "evaluations" in ax.get_ylabel()
    with pytest.raises(ValueError, match="`against` must be"):
        nsjax.plot.work_precision(table, against="time")
    plt.close("all")


def test_table_of_pandas():
    pytest.importorskip("pandas")
    rows = (Row("Tsit5", 1e-6, 0.5, 1e-7, 2.0, None, ""), Row("Heun", 1e-6, float("nan"), float("nan"), 1.0, 7, "no"))
    table = nsjax.WorkPrecision(rows, 0.0).to_dataframe()
    assert list(table) == list(Row._fields) and list(table["method"]) == ["Tsit5", "Heun"]
    np.testing.assert_array_equal(table["evaluations"], [np.nan, 7.0])
    assert list(table["failure"]) == ["", "no"]


def test_a_method_has_one_colour():
    """In whatever order and company; variants of one kind differ in their lines."""

    def drawn(*names):
        rows = tuple(Row(name, 1e-6, 1.0, 10.0**-e, 0.0, None, "") for name in names for e in (3, 6))
        ax = nsjax.plot.work_precision(nsjax.WorkPrecision(rows, 0.0), ax=plt.figure().add_subplot())
        return {line.get_label(): (line.get_color(), line.get_linestyle()) for line in ax.lines}

    first = drawn("events, Tsit5", "events, Dopri8", "band, η = 1e-4", "band, η = 1e-6", "mine")
    second = drawn("mine too", "band, η = 1e-6", "arctan, ε = 1e4", "events, Dopri8")
    assert first["events, Dopri8"] == second["events, Dopri8"]
    assert first["band, η = 1e-4"][0] == first["band, η = 1e-6"][0] == second["band, η = 1e-6"][0]
    assert len(set(first.values())) == 5 and len(set(second.values())) == 4
    plt.close("all")


def test_derivatives_and_failures():
    """A quantity may be a derivative; what fails is told in its row, and the others are there."""
    methods = {"Tsit5": dfx.Tsit5(), "Heun": dfx.Heun()}
    table = work_precision(Decay(), slope, methods, (1e-9,), reference=-np.exp(-1), repeats=1, max_steps=300)
    good, bad = table.rows
    assert good.failure == "" and good.error < 1e-6
    assert "maximum number of solver steps" in bad.failure and np.isnan(bad.error) and bad.failure in str(table)


def test_methods_by_default():
    """The static friction point leaves out what cannot have it; a system without friction has nothing to be smoothed."""
    names = list(nsjax.methods_for(SYSTEM))
    assert names == ["events, Tsit5", "events, Dopri8", "events, Taylor", "band, η = 1e-4"]
    assert len(nsjax.methods_for(gallery.FallingStickSlip())) == 6
    assert len(nsjax.methods_for(gallery.BouncingBall())) == 3
    with pytest.raises(TypeError, match="`methods` must have .* for 'x', but got 3"):
        work_precision(SYSTEM, end, {"x": 3}, reference=Motion(0.0, 0.0))
    with pytest.raises(TypeError, match="Argument `system`"):
        work_precision(gallery.StickSlip, end)
