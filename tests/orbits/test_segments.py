"""Periodic orbits in segments: against shooting, closed forms, and 40-digit references."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from models import Motion, pid, TableBall

import nsjax
from nsjax import find_orbit, gallery, RESULTS, Segment


METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-13), max_steps=8192, max_events=16)
REPELS = [Segment(-1, 3.0), Segment({"belt": 0}, 1.0, free=True), Segment([-1], 2.5)]


def unstable(v_dr, segments=REPELS, y0=None, **change):
    system = gallery.StickSlip(**({"c": 0.1, "v_dr": v_dr} | change))
    return find_orbit(system, y0 or Motion(1.0, -1.15 * v_dr), segments=segments, throw=False, **METHOD)


@pytest.mark.slow  # (by default unstable orbits are found so, below)
def test_section_3_4():
    orbit = find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54, method="segments", **METHOD)
    exact = reference.stick_slip_orbit()
    np.testing.assert_allclose(orbit.period, exact.period, atol=1e-11)
    assert list(orbit.itinerary) == [{"belt": -1}, {"belt": 0}, {"belt": -1}]
    stick, slip = orbit.events
    np.testing.assert_allclose([stick.y_after.x, slip.y_after.x], [0, 2], atol=1e-11)
    np.testing.assert_allclose(float(slip.t - stick.t), 10, atol=1e-11)
    # The multiplier that vanishes because it sticks is no small number.
    assert orbit.structural_zeros == 1 and orbit.multipliers[1] == 0
    np.testing.assert_allclose(orbit.multipliers[0], 1, atol=1e-11)
    assert orbit.stable and orbit.admissible and orbit.violation == 0 and orbit.result == RESULTS.successful


@pytest.mark.parametrize("v_dr", [0.2, 0.5, 1.0])
def test_infinitely_unstable(v_dr):
    """Pitfall 24, section 6.7, in forward time: it slides on the side of the belt's surface that repels, and leaves it freely."""
    orbit = unstable(v_dr)
    slip, x, period = reference.infinitely_unstable_orbit(0.1, v_dr)
    np.testing.assert_allclose(orbit.period, period, atol=1e-11)
    onto, off = orbit.events
    np.testing.assert_allclose([onto.y_before.x, off.y_before.x], [1 - 0.1 * v_dr, x], atol=1e-11)
    np.testing.assert_allclose(float(off.t - onto.t), period - slip, atol=1e-11)
    assert onto.transversality < 1e-12  # tangentially
    np.testing.assert_allclose(orbit.multipliers[1], 1, atol=1e-10)
    assert np.isinf(orbit.multipliers[0]) and np.all(np.isinf(orbit.monodromy))
    assert orbit.admissible and not orbit.stable and orbit.result == RESULTS.successful
    assert "multipliers  inf" in str(orbit)


@pytest.mark.slow
@pytest.mark.parametrize("v_dr", [0.2, 0.5, 1.0])
def test_backward_shooting(v_dr):
    """The same orbits, from nothing but a start beside them and a period, in backward time."""
    orbit = backward(v_dr, 0.1)
    slip, x, period = reference.infinitely_unstable_orbit(0.1, v_dr)
    np.testing.assert_allclose(orbit.period, period, atol=1e-11)
    assert list(orbit.itinerary) == [{"belt": -1}, {"belt": 0}, {"belt": -1}]
    onto, off = orbit.events  # as it runs forwards
    assert 0 < onto.t < off.t < orbit.period
    np.testing.assert_allclose([*onto.y_before, *off.y_after], [1 - 0.1 * v_dr, v_dr, x, v_dr], atol=1e-11)
    np.testing.assert_allclose(float(off.t - onto.t), period - slip, atol=1e-11)
    np.testing.assert_allclose(orbit.multipliers[1], 1, atol=1e-10)
    assert np.isinf(orbit.multipliers[0]) and np.all(np.isinf(orbit.monodromy)) and not orbit.stable
    assert list(orbit.trivial) == [False, True] and orbit.structural_zeros == 0
    # By segments: where it comes onto the surface, and when it leaves.
    again = unstable(v_dr)
    for a, b in zip(orbit.events, again.events):
        np.testing.assert_allclose([*b.y_before, *b.y_after], [*a.y_before, *a.y_after], atol=1e-10)
    np.testing.assert_allclose(again.period, orbit.period, atol=1e-10)
    for o in orbit, again:
        path = o.path(9)
        length = (path.t[:, -1] - path.t[:, 0])[:3]
        np.testing.assert_allclose(length[1], period - slip, atol=1e-10)
        np.testing.assert_allclose(length.sum(), period, atol=1e-10)
        np.testing.assert_allclose(path.y.v[1], v_dr, atol=1e-11)
        np.testing.assert_allclose([path.y.x[2, -1], path.y.v[2, -1]], [o.y0.x, o.y0.v], atol=1e-10)
        np.testing.assert_allclose(path.y.x[1:3, 0], path.y.x[:2, -1], atol=1e-10)


def backward(v_dr, c):
    system = gallery.StickSlip(c=c, v_dr=v_dr)
    return find_orbit(system, Motion(1.0, -1.15 * v_dr), period=6.4, backward=True, throw=False, **METHOD)


@pytest.mark.slow
def test_derivative_of_backward_shooting():
    jacobian = jax.jacfwd(lambda p: jnp.stack([backward(*p).period, backward(*p).events.y_before.x[1]]))(
        jnp.array([0.5, 0.1])
    )
    lower, upper = (np.array(reference.infinitely_unstable_orbit(0.1 + d, 0.5)) for d in (-1e-6, 1e-6))
    exact = (upper - lower) / 2e-6
    _, x, _ = reference.infinitely_unstable_orbit(0.1, 0.5)
    np.testing.assert_allclose(jacobian, [[0, exact[2]], [(x - 1) / 0.5, exact[1]]], atol=1e-8)


@pytest.mark.slow
def test_derivative_of_an_unstable_orbit():
    """Its period does not depend on v_dr, and x where it leaves the belt does so linearly: there is one scale."""

    def of(v_dr, c):
        orbit = unstable(v_dr, c=c)
        return orbit.period, orbit.events.y_before.x[1]

    jacobian = jax.jacfwd(lambda p: jnp.stack(of(*p)))(jnp.array([0.5, 0.1]))
    (period_v, x_v), (period_c, x_c) = jacobian.T
    lower, upper = (np.array(reference.infinitely_unstable_orbit(0.1 + d, 0.5)) for d in (-1e-6, 1e-6))
    exact = (upper - lower) / 2e-6
    _, x, _ = reference.infinitely_unstable_orbit(0.1, 0.5)
    np.testing.assert_allclose([period_v, x_v], [0, (x - 1) / 0.5], atol=1e-9)
    np.testing.assert_allclose([period_c, x_c], [exact[2], exact[1]], rtol=1e-8)


def test_not_admissible():
    """It slips through the belt's velocity and slides backwards in time: told, with where and how much."""
    orbit = unstable(0.2, [Segment(-1, 4.0), Segment(0, 2.0, free=True), Segment(-1, 2.0)], Motion(0.3, 0.1))
    assert not orbit.admissible and orbit.violation > 0.01 and orbit.result == RESULTS.orbit_not_admissible
    assert orbit.t0 <= orbit.violation_t <= orbit.t0 + orbit.period
    assert f"leaves its modes by {float(orbit.violation):.3g}" in str(orbit)


ENTRIES = [pytest.param(k, marks=() if k == "6.8" else pytest.mark.slow) for k in ("2.4", "3.5", "6.6", "6.8", "6.9")]


@pytest.mark.slow
@pytest.mark.parametrize("key", ENTRIES)
def test_both_formulations_agree(key):
    """States, events, multipliers; singular monodromy matrices included (pitfall 23)."""
    entry = gallery.entry(key)
    guess = dict(order=entry.orbit.order) if entry.orbit.period is None else dict(period=entry.orbit.period)
    one, other = (
        find_orbit(entry.system(), entry.orbit.y0, method=m, **guess, **METHOD) for m in ("shooting", "segments")
    )
    assert list(one.itinerary) == list(other.itinerary)
    np.testing.assert_allclose(other.y0, one.y0, atol=1e-11)
    np.testing.assert_allclose(other.period, one.period, atol=1e-11)
    np.testing.assert_allclose(other.monodromy, one.monodromy, atol=1e-10)
    np.testing.assert_allclose(other.multipliers, one.multipliers, atol=1e-10)
    assert other.structural_zeros == one.structural_zeros == (1 if key in ("2.4", "6.8", "6.9") else 0)
    for a, b in zip(one.events, other.events, strict=True):
        np.testing.assert_allclose([b.t, *b.y_after], [a.t, *a.y_after], atol=1e-11)
        np.testing.assert_allclose(b.transversality, a.transversality, atol=1e-10)
    assert one.admissible and other.admissible and one.stable == other.stable


class Ball(TableBall):
    """Lands on a table, comes to rest in ever shorter bounces, and is thrown up again, once a period."""

    @property
    def period(self):
        return 2 * jnp.pi / self.w


@pytest.mark.slow
def test_rest():
    """The orbit of a body that rests forgets all: it is that of the 40-digit reference after its first lift-off."""
    method = METHOD | dict(max_events=32)
    one, other = (
        find_orbit(Ball(e=0.2), Motion(1.2, 0.0), t0=0.2, mode={"table": 0}, method=m, **method)
        for m in ("shooting", "segments")
    )
    exact = reference.ball_on_table(e=0.2)
    for orbit in one, other:
        assert orbit.structural_zeros == 2 and np.all(orbit.multipliers == 0) and orbit.stable and orbit.admissible
        impact, lift_off = orbit.events[0], orbit.events[-1]
        np.testing.assert_allclose(lift_off.t, float(exact.lift_off), atol=1e-10)
        np.testing.assert_allclose(impact.t + orbit.period, float(exact.next_impact), atol=1e-10)
        np.testing.assert_allclose(impact.y_before.v, float(exact.next_velocity), atol=1e-10)


@pytest.mark.slow
def test_lanes():
    """Under `vmap` rows are filled up, and each lane has its own result."""

    @jax.jit
    @jax.vmap
    def run(v_dr):
        system = gallery.StickSlip(v_dr=v_dr, c=0.1)
        guess, options = Motion(2.0 - v_dr, 0.0), METHOD | dict(max_events=4)
        orbit = find_orbit(system, guess, period=12.6, method="segments", throw=False, **options)
        return orbit.period, orbit.multipliers, orbit.admissible, orbit.result

    lanes = jnp.array([0.15, 0.2, 0.3, 1.5])
    period, multipliers, admissible, result = run(lanes)
    exact = [reference.stick_slip_orbit(c=0.1, v_dr=float(v)).period for v in lanes[:3]]
    np.testing.assert_allclose(period[:3], exact, atol=1e-11)
    np.testing.assert_allclose(multipliers[:3], [[1, 0]] * 3, atol=1e-11)
    assert list(result == RESULTS.successful) == [True, True, True, False] and list(admissible[:3]) == [True] * 3
    assert (result == RESULTS.orbit_is_equilibrium)[3]  # beyond the fold there is no orbit


@pytest.mark.slow
def test_symmetric():
    """Section 6.8 beside its stable asymmetric orbit: the unstable one of property (6.24), with two stick phases."""
    system = gallery.thesis("6.8")
    orbit = find_orbit(system, Motion(2.0, 1.0), symmetry="inversion", **METHOD)
    half = orbit.solve(saveat=dfx.SaveAt(ts=orbit.period[None] / 2)).ys
    np.testing.assert_allclose([*half.x, *half.v], [-orbit.y0.x, -orbit.y0.v], atol=1e-11)
    assert [int(e.mode_after["friction"]) for e in orbit.events] == [0, -1, 0, 1]
    down, up = orbit.events[1], orbit.events[3]  # breaks away
    guess = [float(up.t), float(up.y_before.x), float(orbit.events[0].t + orbit.period)]
    t_0, x, t, multiplier = reference.symmetric_friction_orbit(0.65, guess)
    found = [up.t, up.y_before.x, orbit.events[0].t + orbit.period, -down.y_before.x]
    np.testing.assert_allclose(found, [t_0, x, t, x], atol=1e-10)
    np.testing.assert_allclose(orbit.multipliers, [multiplier, 0], atol=1e-9)
    assert not orbit.stable
    again = find_orbit(system, orbit.y0, method="segments", **METHOD)
    np.testing.assert_allclose(again.y0, orbit.y0, atol=1e-11)
    np.testing.assert_allclose(again.multipliers, orbit.multipliers, atol=1e-10)
    # Where the fundamental matrix jumps: onto the surface, and off it where friction falls from F_stick to F_slip.
    jumps = orbit.monodromy_jumps[: len(orbit.events)]
    np.testing.assert_allclose(jumps[0::2, 1, 1], 0, atol=1e-12)
    np.testing.assert_allclose(jumps[1], jumps[3], atol=1e-11)


@pytest.mark.parametrize(
    "segments, message",
    [
        ([Segment(-1, 3.0), Segment(0, 1.0)], "must end in the mode in which it begins"),
        ([Segment(-1, 3.0), Segment(-1, 1.0)], "must say by `ends=` which switch ends segment 0"),
        ([Segment({"wall": 1}, 3.0)], "must name each of the switches"),
        ([Segment([1, 1], 3.0)], "must have a value for each of the switches"),
        ([], "at least one segment"),
        ([Segment(-1, 3.0, free=True), Segment(0, 1.0), Segment(-1, 1.0)], "must slide on what it leaves"),
    ],
)
def test_wrong_segments(segments, message):
    with pytest.raises(ValueError, match=message):
        unstable(0.2, segments)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(method="collocation"), "must be 'shooting' or 'segments'"),
        (dict(method="shooting", pieces=2), "are for `method='segments'`"),
        (dict(symmetry="mirror"), "`symmetry` must be a function or 'inversion'"),
        (dict(symmetry="inversion", method="segments"), "`symmetry` is for `method='shooting'`"),
        (dict(backward=True, pieces=2), "`backward` is for `method='shooting'`"),
        (dict(pieces=0), "`pieces` must be an integer from 1 to 64"),
    ],
)
def test_wrong_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54, **change)


class Saddle(nsjax.System):
    """x'' = 100 x + cos t, whose orbit x = -cos t / 101 no solution follows: errors grow by e^(20 π) in a period."""

    def vector_field(self, t, y, s):
        return Motion(y.v, 100 * y.x + jnp.cos(t))

    @property
    def period(self):
        return 2 * jnp.pi


@pytest.mark.parametrize("options", [dict(pieces=20), pytest.param(dict(), marks=pytest.mark.slow)])
def test_violently_unstable(options):
    """In pieces, which are tried too if nothing is said. The largest multiplier is 1.9e27, the smallest its reciprocal."""
    orbit = find_orbit(Saddle(), Motion(1.0, 0.0), **options, **METHOD)
    np.testing.assert_allclose(orbit.y0, [-1 / 101, 0], atol=1e-12)
    np.testing.assert_allclose(orbit.multipliers, np.exp([20 * np.pi, -20 * np.pi]), rtol=1e-8)
    assert not orbit.stable and orbit.admissible


class Ceiling(nsjax.System):
    """Forced at frequencies 1 and 0.97, below a ceiling beyond which something else would push."""

    top: jax.Array | float
    period = 200 * np.pi

    @nsjax.sgn
    def below(self, t, y):
        return self.top - y.x

    def vector_field(self, t, y, s):
        forcing = 0.1 * (jnp.cos(t) + jnp.cos(0.97 * t))
        return Motion(y.v, -y.x - 0.3 * y.v + forcing - 5 * (1 - s.below))


@pytest.mark.slow
def test_no_sample_decides_whether_an_orbit_is_admissible():
    """Pitfall 41: a surface is passed at one of a hundred peaks, between any 65 samples."""
    method = dict(stepsize_controller=pid(1e-12), max_steps=20000, max_events=1)
    ts = np.linspace(0, 200 * np.pi, 2_000_001)
    x = sum((0.1 * np.exp(1j * w * ts) / (1 - w**2 + 0.3j * w)).real for w in (1, 0.97))
    segments = [Segment((1,), 200 * np.pi)]
    for top in (0.66, 0.68):
        orbit = find_orbit(Ceiling(top), Motion(0.0, 0.3), segments=segments, throw=False, **method)
        assert orbit.residual < 1e-9 and orbit.path().y.x.max() < 0.65
        assert orbit.admissible == (x.max() < top)
        np.testing.assert_allclose(orbit.violation, max(0, x.max() - top), atol=1e-8)
        if not orbit.admissible:
            assert orbit.result == RESULTS.orbit_not_admissible
            np.testing.assert_allclose(orbit.violation_t, ts[np.argmax(x)], atol=1e-3)
