"""Branches of periodic orbits of systems that are not the thesis's, with answers that are known otherwise."""

import dataclasses
from typing import Any

import branch_reference
import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from branches import continue_orbit, orbit_of, same_multipliers, stability_agrees, the
from models import Heat, Motion, Support, Thermostat
from scipy.optimize import fsolve

import nsjax


mp: Any = reference.mp


class BumperReference:
    """The orbits with one contact, in 50 digits. The monodromy depends on the contact's duration alone, and so the
    duration at a fold or flip is the root of one function."""

    def __init__(self, omega, c_f=0, c=0.1, k_f=4.0):
        self.omega, self.c, self.k_f = (mp.mpf(p) for p in (omega, c, k_f))
        self.c_f = mp.mpf(c_f)
        self.period = 2 * mp.pi / self.omega

    def gain(self, c, k):
        return 1 / mp.mpc(k - self.omega**2, c * self.omega)

    def transition(self, t, c, k):
        d = c / 2
        w = mp.sqrt(k - d * d)
        e, cos, sin = mp.exp(-d * t), mp.cos(w * t), mp.sin(w * t) / w
        return mp.matrix([[e * (cos + d * sin), e * sin], [-e * k * sin, e * (cos - d * sin)]])

    def flow(self, begin, y, end, stiff, x_c):
        c, k = (self.c + self.c_f, 1 + self.k_f) if stiff else (self.c, mp.mpf(1))
        forced = [self.gain(c, k) * mp.expj(self.omega * t) for t in (begin, end)]
        rest = self.k_f * x_c / k if stiff else mp.mpf(0)
        a, b = (mp.matrix([rest + z.real, (mp.j * self.omega * z).real]) for z in forced)
        return b + self.transition(end - begin, c, k) * (y - a)

    def monodromy(self, contact):
        """With the saltation at the beginning, where the damper's force jumps; at the end it is zero."""
        free = self.transition(self.period - contact, self.c, mp.mpf(1))
        stiff = self.transition(contact, self.c + self.c_f, 1 + self.k_f)
        return free * stiff * mp.matrix([[1, 0], [-self.c_f, 1]])

    def multipliers(self, touched):
        free = self.transition(self.period, self.c, mp.mpf(1))
        m = self.monodromy(mp.mpf(0)) if touched else free
        return np.linalg.eigvals(np.array(m.tolist(), float))

    @property
    def corner(self):
        return abs(self.gain(self.c, 1))

    def critical(self, sign):
        """The damper with which the multiplier of an orbit that has just touched is `sign`."""
        d = self.c / 2
        w = mp.sqrt(1 - d * d)
        e, angle = mp.exp(-d * self.period), w * self.period
        return (2 * e * mp.cos(angle) - sign * (1 + e * e)) * w / (e * mp.sin(angle))

    def smooth(self, sign):
        """x_c where the multiplier of orbits with contact is `sign`, next to the corner."""

        def condition(contact):
            m = self.monodromy(contact)
            return 1 - sign * (m[0, 0] + m[1, 1]) + m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]

        contact = mp.findroot(condition, (mp.mpf("1e-3"), mp.mpf("2e-2")))

        def off(begin, x_c, v):
            y = self.flow(begin, mp.matrix([x_c, v]), begin + contact, True, x_c)
            z = self.flow(begin + contact, y, begin + self.period, False, x_c)
            return self.k_f * (y[0] - x_c) + self.c_f * y[1], z[0] - x_c, z[1] - v

        def state(begin):  # x_c and v are the solution of linear equations
            zero, by_x, by_v = off(begin, 0, 0), off(begin, 1, 0), off(begin, 0, 1)
            m = mp.matrix([[by_x[i] - zero[i], by_v[i] - zero[i]] for i in (1, 2)])
            return mp.lu_solve(m, -mp.matrix(zero[1:]))

        top = -mp.arg(self.gain(self.c, 1)) / self.omega
        guess = top - contact
        with mp.workdps(50):
            begin = mp.findroot(lambda t: off(t, *state(t))[0], (guess, guess * (1 + contact / 100)), tol=1e-40)
            return state(begin)[0]


def bumper(omega, sign, less, **options):
    """The branch from the orbit without contact, for a damper that is a little less than the critical one; and what
    there should be."""
    c_f = BumperReference(omega).critical(sign) - less
    known = BumperReference(omega, c_f)
    corner = float(known.corner)
    z = complex(known.gain(known.c, 1))
    system = Support(c_f=float(c_f), omega=omega, x_c=corner + 0.3)
    orbit = orbit_of(system, Motion(z.real, -z.imag * omega))
    return continue_orbit(system, orbit, "x_c", (corner - 0.5, corner + 0.5), **options), known


@pytest.mark.slow
@pytest.mark.parametrize("less, max_step", [(0.1, 0.02), (0.1, 0.2), (0.01, 0.02), (0.01, 0.2)])
def test_fold_beside_a_corner(less, max_step):
    """Pitfall 25: the fold is 6e-5 and 7e-8 away from the corner at which contact begins."""
    branch, known = bumper(1.14, 1, less, max_step=max_step)
    corner, fold = the(branch, float(known.corner), 1e-9), the(branch, float(known.smooth(1)), 1e-9)
    assert (corner.kind, corner.discontinuous, corner.count) == ("none", True, ((1,), (1,)))
    assert (fold.kind, fold.discontinuous, fold.count) == ("fold", False, ((), (1, 1)))
    same_multipliers(corner.multipliers, [known.multipliers(touched) for touched in (False, True)])
    assert len(branch.branches) == 1 and len(branch.special_points) == 2
    assert branch.values.min() == pytest.approx(fold.value, abs=1e-10)  # no orbit is beyond
    ends = sorted([branch.stable[0], branch.stable[-1]])
    assert ends == [False, True] and branch.values[[0, -1]] == pytest.approx(float(known.corner) + 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("less, max_step", [(0.1, 0.02), (0.1, 0.2), (0.01, 0.02)])
def test_flip_beside_a_corner(less, max_step):
    """Pitfall 25: the flip is 8e-4 and 9e-6 away from it."""
    branch, known = bumper(0.727, -1, less, max_step=max_step)
    corner, flip = the(branch, float(known.corner), 1e-9), the(branch, float(known.smooth(-1)), 1e-9)
    assert (corner.kind, corner.discontinuous, corner.count) == ("none", True, ((1,), (1,)))
    assert (flip.kind, flip.discontinuous) == ("flip", False)
    same_multipliers(corner.multipliers, [known.multipliers(touched) for touched in (False, True)])
    assert list(branch.values[[0, -1]]) == pytest.approx([float(known.corner) + s for s in (-0.5, 0.5)])
    if less == 0.1:  # what is born there ends at the other flip, after two corners of its own
        assert flip.count == ((1, 2), (1,)) and len(branch.others) == 1
        ends = branch.others[0].special
        assert [b.kind for b in ends] == ["flip", "none", "none", "flip"]
        assert stability_agrees(branch, 6, seed=3) > 4


class Filtered(nsjax.System):
    """Section 6.8, its force from a first-order filter that leaves amplitude and phase as they are: the bifurcations of
    section 6.8, and a multiplier exp(-T / τ) more."""

    tau: float = 2.0
    c: float = 0.01
    f_0: float = 2.5
    omega: float = 0.8

    def vector_field(self, t, y, s):
        phase = self.omega * t
        drive = self.f_0 * (jnp.cos(phase) - self.omega * self.tau * jnp.sin(phase))
        force = y["z"] - s.friction
        return {"x": y["v"], "v": force - self.c * y["v"] - y["x"], "z": (drive - y["z"]) / self.tau}

    @nsjax.sgn
    def friction(self, t, y):
        return y["v"]

    @friction.breakaway
    def friction(self):
        return 2.0

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Bilinear(nsjax.System):
    """x'' + c x' + x + k max(x, 0) = cos ωt: the field is continuous, and where an orbit grazes the surface nothing
    happens."""

    c: float = 0.1
    k: float = 4.0
    omega: float = 2.2

    def vector_field(self, t, y, s):
        spring = self.k * y.x * (1 + s.contact) / 2
        return Motion(y.v, jnp.cos(self.omega * t) - self.c * y.v - y.x - spring)

    @nsjax.sgn
    def contact(self, t, y):
        return y.x

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def bilinear_reference(guess, off):
    """Of an orbit with one contact: begin, duration, velocity, ..., and the frequency at which all of `off` vanishes."""
    return fsolve(lambda u: [float(x) for x in off(BumperReference(u[-1]), *u[:-1])], guess, xtol=1e-12)[-1]


def returns(known, begin, contact, v, laps=1):
    at = known.flow(begin, mp.matrix([0, v]), begin + contact, True, 0)
    back = known.flow(begin + contact, at, begin + laps * known.period, False, 0)
    return [at[0], back[0], back[1] - v]


def flips(known, begin, contact, v):
    m = known.monodromy(contact)
    det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    return [*returns(known, begin, contact, v), 1 + m[0, 0] + m[1, 1] + det]


def grazes(known, begin, contact, v, touch):
    return [*returns(known, begin, contact, v, 2), *known.flow(begin, mp.matrix([0, v]), touch, True, 0)]


@pytest.mark.slow
def test_grazing_of_a_continuous_field():
    """A bilinear oscillator: whether a branch comes to a grazing from the side with or without the contact, it goes on,
    though the equations with a contact of no duration are singular."""
    flip = bilinear_reference((0.8956, 0.9211, 0.6358, 2.2647), flips)
    corner = bilinear_reference((1.2503, 2.6861, 0.604, 2.5108, 2.4248), grazes)
    branch = continue_orbit(
        Bilinear(), orbit_of(Bilinear(), Motion(-0.7, 0.1)), "omega", (2.2, 2.6), solver=dfx.Tsit5()
    )
    assert the(branch, flip, 1e-10).count == ((1,), (1, 2))
    point = the(branch, corner, 1e-10)
    assert (point.kind, point.count, point.name) == ("none", ((1,), (1,)), "no bifurcation: the itinerary changes")
    assert len(branch.special_points) == 2 and len(branch.others) == 1
    assert branch.others[0].values.max() == pytest.approx(2.6) and branch.others[0].stable[2:].all()


@pytest.mark.slow
def test_isola_of_a_continuous_field():
    """Its orbits of period 3 at these frequencies are a closed curve, passed through two grazings from one side each."""
    orbit = orbit_of(Bilinear(omega=2.0), Motion(-1.2, 0.4), order=3)
    branch = continue_orbit(orbit.system, orbit, "omega", (1.5, 3.3))
    assert sorted(b.kind for b in branch.special_points) == ["fold", "fold", "none", "none"]
    assert not branch.others and branch.ends[1] == "the start: it is closed"
    decay = np.exp(-0.1 * branch.periods)
    assert np.prod(branch.multipliers, axis=1).real == pytest.approx(decay, rel=1e-6)
    assert stability_agrees(branch, 6, seed=1) > 3


class Ball(nsjax.System):
    """A ball that bounces on a table of acceleration -a g cos ωt, once a period."""

    a: float = 0.8
    r: float = 0.7
    g: float = 1.0
    omega: float = 2 * np.pi

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g + s.table)

    @nsjax.impact
    def table(self, t, y):
        return y.x - self.a * self.g / self.omega**2 * jnp.cos(self.omega * t)

    @table.restitution
    def table(self):
        return self.r

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_interval_begins_at_a_corner():
    """The branch ends there: what lies beyond the corner is outside."""
    known = BumperReference(1.14, 0.3)
    corner, z = float(known.corner), complex(known.gain(known.c, 1))
    system = Support(c_f=0.3, omega=1.14, x_c=corner)
    orbit = orbit_of(system, Motion(z.real, -z.imag * 1.14))
    for x_c in (corner, corner + 0.3):
        start = dataclasses.replace(orbit.system, x_c=jnp.asarray(x_c))
        branch = continue_orbit(start, orbit, "x_c", (corner, corner + 0.5))
        assert not branch.others
        np.testing.assert_allclose([branch.values.min(), branch.values.max()], [corner, corner + 0.5], atol=1e-10)
        (point,) = branch.special_points
        assert (point.kind, point.count) == ("none", ((1,), (1,)))


@pytest.mark.slow
def test_start_that_sticks():
    """The base point lies on the surface, apart from rounding: the orbit is as it is from elsewhere."""

    class Dry(nsjax.System):
        omega: float = 0.45

        def vector_field(self, t, y, s):
            return Motion(y.v, jnp.cos(self.omega * t) - 0.1 * y.v - y.x - 0.4 * s.friction)

        @nsjax.sgn
        def friction(self, t, y):
            return y.v

        @property
        def period(self):
            return 2 * jnp.pi / self.omega

    orbit = orbit_of(Dry(), Motion(1.0, 0.0))
    assert [e.mode_before["friction"] for e in orbit.events] == [0, -1, 0, 1] and int(orbit.mode[0]) == 0
    branch = continue_orbit(Dry(), orbit, "omega", (0.4, 0.6))
    assert [b.transition for b in branch.special_points] == ["sliding"]
    assert branch.ends == ("omega = 0.4", "omega = 0.6")


@pytest.mark.slow
def test_end_in_a_continuum():
    """Below A = 1 friction holds the mass for ever, at every |x| < 1 - A."""

    class Dry(nsjax.System):
        A: float = 1.3

        def vector_field(self, t, y, s):
            return Motion(y.v, self.A * jnp.cos(0.5 * t) - y.x - s.friction)

        @nsjax.sgn
        def friction(self, t, y):
            return y.v

        @property
        def period(self):
            return 4 * jnp.pi

    for start in (1.3, 1.27, 1.31):  # different steps onto an end at which the segments vanish by three test functions
        system = Dry(start)
        branch = continue_orbit(system, orbit_of(system, Motion(1.0, 0.0)), "A", (0.5, 1.6))
        (point,) = branch.special_points
        assert (point.kind, point.count, point.is_bifurcation) == ("continuum", ((), (1,)), True)
        assert point.value == pytest.approx(1, abs=1e-11)
        assert "end of the branch in a continuum of orbits" in branch.ends[0]


@pytest.mark.slow
def test_relay():
    """A thermostat: its period in closed form, from where the orbit shrinks to a point to where it takes for ever."""
    system = Thermostat()
    orbit = orbit_of(system, Heat(20.0), period=0.54)
    branch = continue_orbit(system, orbit, "T_high", (17.0, 40.0))
    t = branch.values
    apart = 35 - t > 1e-6  # beyond, T_high has too few digits to know the period by
    period = np.log(17 / (35 - t[apart])) + np.log((t[apart] - 5) / 13)
    np.testing.assert_allclose(branch.periods[apart], period, rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(t[[0, -1]], [18, 35], atol=1e-11)
    assert branch.periods[-1] > 28  # which 1e-11 before the end it is
    np.testing.assert_allclose(branch.multipliers[apart], np.ones((apart.sum(), 1)), atol=1e-6)  # a shift in time
    assert [b.kind for b in branch.special_points] == ["end", "end"]
    assert [b.count for b in branch.special_points] == [((), (1,)), ((1,), ())]


@pytest.mark.slow
def test_bouncing_ball():
    """Fold and flip are known in closed form: the table's velocity at the impact is (1 - r) / (1 + r) of the ball's after
    it, g T / 2; its acceleration there is 0 at the fold, and -2 g (1 + r²) / (1 + r)² at the flip."""
    r, T = 0.7, 1.0
    fold = np.pi * (1 - r) / (1 + r)
    flip = np.hypot(fold, 2 * (1 + r**2) / (1 + r) ** 2)
    phase = -np.arcsin(fold / 0.8) / (2 * np.pi)
    flight = -phase
    x = 0.8 / (2 * np.pi) ** 2 * np.cos(2 * np.pi * phase) + T / 2 * flight - flight**2 / 2
    branch = continue_orbit(Ball(), orbit_of(Ball(), Motion(x, T / 2 - flight)), "a", (0.4, 1.3))
    assert (the(branch, fold, 1e-10).kind, the(branch, flip, 1e-10).kind) == ("fold", "flip")
    assert len(branch.special_points) == 2 and len(branch.others) == 1
    once = [n == 1 for n in branch.orders]
    assert np.prod(branch.multipliers, axis=1)[once].real == pytest.approx(r**2)


@pytest.mark.slow
def test_three_states():
    """A third state, in a dictionary, and another solver."""
    orbit = orbit_of(Filtered(), dict(x=5.4, v=2.7, z=2.5))
    branch = continue_orbit(orbit.system, orbit, "omega", (0.5, 0.85))
    kinds = {"A": ("symmetry breaking", False), "B": ("symmetry breaking", True), "C": ("none", True)}
    for name, kind in kinds.items():
        want = branch_reference.POINTS[f"6.8 {name}"]
        point = the(branch, want.at, 1e-10)
        assert (point.kind, point.discontinuous) == kind
        more = np.exp(-want.period / orbit.system.tau)
        two = list(want.multipliers.values())[:2]
        same_multipliers(point.multipliers, [(*two[0], more), (*two[-1], more)])
    assert len(branch.branches) == 2 and len(branch.special_points) == 4  # C, and its image
