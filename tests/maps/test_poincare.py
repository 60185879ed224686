"""Poincaré maps of sections and of the forcing's phase, reduced maps, and brute-force diagrams, against closed forms."""

import branch_reference
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import orbit_reference
import pytest
from jax import Array
from models import flat, Hammer, Heat, Motion, pid, Thermostat
from programs import compilations
from scipy.linalg import expm
from scipy.optimize import brentq

import nsjax
from nsjax import brute_force, gallery, plot, poincare_map, reduced_map, RESULTS, stroboscopic_map


TIGHT = dict(stepsize_controller=pid(1e-11))
ZETA = 0.1
OMEGA = np.sqrt(1 - ZETA**2)
FREE = np.array([[0, 1], [-1, -2 * ZETA]])
TURN = np.exp(-2 * np.pi * ZETA / OMEGA)  # from one maximum of the damped oscillator to the next


class Oscillator(nsjax.System):
    """x'' + 2 ζ x' + x = f cos ωt: no switch at all. Without a force it is autonomous."""

    zeta: float = ZETA
    f: float = 0.0
    omega: float = 1.3
    forced: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, y, s):
        return Motion(y.v, self.f * jnp.cos(self.omega * t) - 2 * self.zeta * y.v - y.x)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega if self.forced else None


def rest(t, y):
    return y.v


def tops(system, x, **options):
    """The map from one maximum of x to the next; sections that the tests share, as each is a program of its own."""
    return poincare_map(system, rest, Motion(x, jnp.zeros_like(x)), direction=-1, max_time=60.0, **(TIGHT | options))


def loose_tops(v_dr, x):
    return tops(gallery.StickSlip(c=0.1, v_dr=v_dr), x, throw=False, stepsize_controller=pid(1e-8))


# Sections.


@pytest.mark.slow
def test_oscillator_from_maximum_to_maximum():
    """Pitfalls 1, 2: a start on the section is no return, and no iterate is found twice."""
    many = tops(Oscillator(), 2.0, iterates=5)
    n = np.arange(1, 6)
    np.testing.assert_allclose(many.t, 2 * np.pi / OMEGA * n, rtol=1e-9)
    np.testing.assert_allclose(many.y.x, 2 * TURN**n, rtol=1e-9)
    np.testing.assert_allclose(many.y.v, 0, atol=1e-12)
    third = tops(Oscillator(), 2.0, number=3)
    np.testing.assert_allclose([third.t, third.y.x], [many.t[2], many.y.x[2]], rtol=1e-12)
    assert third.result == RESULTS.successful and third.mode.shape == (0,)


@pytest.mark.parametrize("v", [0.0, 1e-9, -1e-9, 1e-12, -1e-16])
def test_start_beside_the_section(v):
    """Pitfall 3: what lies as near the section as the end of a computation does is on it, on either side."""
    found = poincare_map(Oscillator(), rest, Motion(2.0, v), direction=-1, max_time=60.0, **TIGHT)
    np.testing.assert_allclose([found.t, found.y.x], [2 * np.pi / OMEGA, 2 * TURN], rtol=1e-8)


def test_start_off_the_section_and_directions():
    half = -2 * np.sqrt(TURN)
    for direction, v, t, x in ((1, 0.0, np.pi / OMEGA, half), (0, 0.0, np.pi / OMEGA, half)):
        found = poincare_map(Oscillator(), rest, Motion(2.0, v), direction=direction, max_time=60.0, **TIGHT)
        np.testing.assert_allclose([found.t, found.y.x], [t, x], rtol=1e-9)
    # From on the way up the first maximum is the same motion's, a little later.
    early = expm(-0.5 * FREE) @ [2.0, 0.0]
    found = poincare_map(Oscillator(), rest, Motion(*early), direction=-1, max_time=60.0, t0=7.0, **TIGHT)
    np.testing.assert_allclose([found.t, found.y.x], [7.5, 2.0], rtol=1e-9)


class Through(eqx.Module):
    """The section n . (y - y0) = 0: one with parameters, which may be traced."""

    normal: Array
    y0: Array

    def __call__(self, t, y):
        return self.normal @ (jnp.stack(y) - self.y0)


@pytest.fixture(scope="module")
def orbit():
    guess = gallery.entry("figure 5.3")
    return nsjax.find_orbit(
        guess.system(), guess.orbit.y0, period=guess.orbit.period, solver=dfx.Tsit5(), max_events=8,
        stepsize_controller=pid(1e-12), max_steps=8192,
    )  # fmt: skip


@pytest.mark.slow
def test_derivative_is_6_7(orbit):
    """On a section through an orbit, not perpendicular to it; by the flow's derivatives, by (6.7), and by finite
    differences. The return time's derivative is the row that (6.7) projects out, -nᵀΦ / (nᵀf)."""
    normal = jnp.asarray([1.0, 0.3, -0.2])
    y0 = jnp.stack(orbit.y0)
    f = jnp.stack(orbit.system.vector_field(0.0, orbit.y0, orbit.system.values(tuple(map(float, orbit.mode)))))
    direction = int(jnp.sign(normal @ f))

    def back(x):
        found = poincare_map(
            orbit.system, Through(normal, y0), type(orbit.y0)(*x), direction=direction, max_time=20.0, **TIGHT
        )
        there = jnp.stack(found.y), found.t
        return there, there

    slopes = jax.jit(jax.jacfwd(back, has_aux=True))
    (by_y, by_t), (here, time) = slopes(y0)
    np.testing.assert_allclose(here, y0, atol=1e-9)
    np.testing.assert_allclose(time, orbit.period, rtol=1e-9)
    np.testing.assert_allclose(by_y, orbit.poincare_derivative(type(orbit.y0)(*normal)), atol=1e-7)
    np.testing.assert_allclose(by_t, -(normal @ orbit.monodromy) / (normal @ f), atol=1e-7)
    for i in range(3):
        # Beyond the section: what starts before it crosses it at once.
        h = 1e-4 * np.sign(normal[i]) * direction * np.eye(3)[i]
        (near, soon), (far, late) = slopes(y0 + h)[1], slopes(y0 + 2 * h)[1]
        np.testing.assert_allclose((4 * near - 3 * here - far) / (2 * h[i]), by_y[:, i], atol=1e-5)
        np.testing.assert_allclose((4 * soon - 3 * time - late) / (2 * h[i]), by_t[i], atol=1e-5)


@pytest.mark.slow
def test_gradient():
    def image(x, zeta):
        return tops(Oscillator(zeta=zeta), x, number=2, adjoint=dfx.DirectAdjoint()).y.x

    found = jax.grad(image, (0, 1))(2.0, ZETA)
    slope = 2 * TURN**2 * (-4 * np.pi) / OMEGA**3
    np.testing.assert_allclose(found, [TURN**2, slope], rtol=1e-8)


@pytest.mark.parametrize(
    "system, middle",
    [
        (Oscillator(zeta=0.05), 0.0),
        pytest.param(gallery.StickSlip(c=0.1, v_dr=0.5), 1.0, marks=pytest.mark.slow),
    ],
    ids=["smooth", "stick-slip"],
)
def test_one_bad_lane_harms_no_other(system, middle):
    """Pitfalls 17, 18: one lane sits on the equilibrium, one is no number, one lacks the time to return."""

    @jax.jit
    @jax.vmap
    def lanes(x, max_time):
        def image(x):
            found = poincare_map(
                system, rest, Motion(x, 0 * x), direction=-1, max_time=max_time, throw=False, iterates=2
            )
            return found.y.x, (found.result, found.y.x)

        _, slope, found = jax.jvp(image, (x,), (jnp.ones_like(x),), has_aux=True)
        return slope, found

    x = middle + jnp.asarray([0.2, 0.0, jnp.nan, 1.5, 0.4])
    slope, (result, image) = lanes(x, jnp.asarray([60.0, 60.0, 60.0, 6.2, 60.0]))
    first, second = jax.tree.map(lambda x: x[:, 0], result), jax.tree.map(lambda x: x[:, 1], result)
    assert (first == RESULTS.no_return).tolist() == [False, True, False, True, False]
    assert (first == RESULTS.nonfinite_field).tolist() == [False, False, True, False, False]
    assert jnp.all(first == second)  # what has failed stays failed
    assert np.isnan(image[1:4]).all() and np.isnan(slope[1:4]).all()
    turn = np.exp(-2 * np.pi * 0.05 / np.sqrt(1 - 0.05**2))
    for i in (0, 4):
        np.testing.assert_allclose(image[i], middle + (x[i] - middle) * np.array([turn, turn**2]), rtol=1e-6)
        np.testing.assert_allclose(slope[i], [turn, turn**2], rtol=1e-6)
    with pytest.raises(Exception, match="did not come back to the section"):
        tops(Oscillator(zeta=1.5), 1.0, throw=True)


def test_float32():
    x = jnp.asarray(2.0, jnp.float32)
    found = tops(Oscillator(), x, iterates=4, stepsize_controller=None)
    assert found.y.x.dtype == found.t.dtype == jnp.float32
    np.testing.assert_allclose(found.y.x, 2 * TURN ** np.arange(1, 5), rtol=1e-3)


# The stick-slip system of section 6.7.


def slip(x, v, v_dr, c=0.1):
    """x(t), v(t) in slip below the belt's velocity: x'' + c x' + x = 1."""
    d, w = c / 2, np.sqrt(1 - c**2 / 4)

    def at(t):
        a, b = x - 1, (v + d * (x - 1)) / w
        swing, turn = a * np.cos(w * t) + b * np.sin(w * t), -a * np.sin(w * t) + b * np.cos(w * t)
        return 1 + np.exp(-d * t) * swing, np.exp(-d * t) * (w * turn - d * swing)

    return at


def plateau(v_dr):
    """The maximum of x after sticking, which ends at x + c v_dr = F_stick."""
    arc = slip(2 - 0.1 * v_dr, v_dr, v_dr)
    return arc(brentq(lambda t: arc(t)[1], 0, 2.5))[0]


def edge(v_dr):
    """The maximum of x from which the solution meets the belt's velocity tangentially, at x + c v_dr = F_slip."""
    arc = slip(1 - 0.1 * v_dr, v_dr, v_dr)
    return arc(brentq(lambda t: arc(t)[1], -6, -3))[0]


LIMB = np.exp(-2 * np.pi * 0.05 / np.sqrt(1 - 0.05**2))


@pytest.mark.slow
@pytest.mark.parametrize("v_dr, orbits", [(0.5, 2), (1.05, 2), (1.3, 0)])
def test_figure_6_16(v_dr, orbits):
    """The map spirals in below the unstable orbit and forgets where it came from above it, so that its slope is 0 at
    the stable one and infinite at the other."""
    step, top = edge(v_dr), plateau(v_dr)
    some, x = np.array([1.0, 1.2, step - 1e-5, step + 1e-5, 2.8, 3.0]), np.linspace(1.0, 3.0, 201)
    found = nsjax.sweep(loose_tops, v_dr, np.append(some, x))
    want = np.where(some < step, 1 + LIMB * (some - 1), top)
    np.testing.assert_allclose(found.y.x[1:6], want[1:], rtol=1e-6)
    assert (found.result == RESULTS.no_return)[0]  # the equilibrium, a fixed point as the limit of the map
    assert (top > step) == (orbits == 2)
    image = np.array(found.y.x[6:])
    image[0] = 1.0
    ax = plot.poincare_map(x, image, labels={"x": "$x_n$ [m]", "image": "$x_{n+1}$ [m]"})
    dots = {
        (round(float(line.get_xdata()[0]), 2), line.get_markerfacecolor())
        for line in ax.get_lines()
        if line.get_marker() == "o"
    }
    fixed = {(1.0, "black"), (round(top, 2), "black")}
    assert {d for d in dots if d[1] == "black"} == (fixed if orbits else {(1.0, "black")})
    hollow = [place for place, face in dots if face == "white"]
    assert len(hollow) == (orbits == 2) and all(abs(place - step) < 0.01 for place in hollow)
    plt.close("all")


# Sections that are switches.


def test_impacts_are_a_section():
    """The ball's speed after an impact falls by e; it comes to rest, and returns no more."""
    found = poincare_map(gallery.thesis("1.1(3)"), "floor", Motion(1.0, 0.0), max_time=2.0, iterates=200, throw=False)
    fall, n = np.sqrt(2 / 9.81), np.arange(4)
    assert found.y.x.shape == (200,) and np.all((found.result == RESULTS.successful)[:4])
    np.testing.assert_allclose(found.t[:4], fall * (1 + 2 * np.cumsum(0.8**n) - 2), rtol=1e-9)
    np.testing.assert_allclose(found.y.v[:4], 0.8 ** (n + 1) * 9.81 * fall, rtol=1e-9)
    assert (found.result == RESULTS.no_return)[-1] and np.isnan(found.y.x[-1])


def test_a_section_is_not_crossed_by_an_impact():
    """Pitfall 35: the impact carries v from below zero to above it; v falls through zero only at the top."""
    found = poincare_map(gallery.thesis("1.1(3)"), rest, Motion(1.0, 0.0), direction=-1, max_time=5.0, iterates=3)
    np.testing.assert_allclose(found.y.x, 0.64 ** np.arange(1, 4), rtol=1e-7)


def support(t, y):
    return y.x


@pytest.mark.slow
@pytest.mark.parametrize("section", ["support", support])
def test_a_surface_through_the_origin_is_a_section(section):
    """Pitfall 3: rounding of the state at the event is more than that of h itself, and iterates go on all the same.
    So they do where a function happens to be the surface of a switch."""
    system = gallery.DiscontinuousSupport()
    events = nsjax.solve(system, 0.0, 40.0, Motion(0.5, 0.0)).events
    closes = [float(event.t) for event in events if event.mode_after["support"] == 1]
    assert len(closes) > 4
    found = poincare_map(system, section, Motion(0.5, 0.0), iterates=4)
    np.testing.assert_allclose(found.t, closes[:4], rtol=1e-7)
    assert found.mode[:, 0].tolist() == [1, 1, 1, 1]


@pytest.mark.slow
def test_sticking_and_relays_are_sections():
    """Where the stick-slip oscillation of section 3.4 is let go: its period; the thermostat's switching on."""
    off = poincare_map(gallery.StickSlip(), "belt", Motion(2.5, 0.0), direction=-1, max_time=60.0, iterates=2)
    np.testing.assert_allclose(off.t[1] - off.t[0], 10 + np.pi + 2 * np.arctan(0.2), rtol=1e-7)
    np.testing.assert_allclose(off.y.x, 2, rtol=1e-7)
    assert off.mode.tolist() == [[-1], [-1]]
    every = poincare_map(gallery.StickSlip(), "belt", Motion(2.5, 0.0), direction=0, max_time=60.0, iterates=4)
    assert every.mode[:, 0].tolist() == [0, -1, 0, -1]
    on = poincare_map(Thermostat(), "heater", Heat(20.0), max_time=10.0, iterates=2)
    period = np.log((35 - 18) / (35 - 22)) + np.log((22 - 5) / (18 - 5))
    np.testing.assert_allclose(np.diff(on.t), period, rtol=1e-7)
    np.testing.assert_allclose(on.y.T, 18, rtol=1e-7)


# The forcing's phase.


def steady(omega, f=1.0, t=0.0, zeta=ZETA):
    z = f / (1 - omega**2 + 2j * zeta * omega) * np.exp(1j * omega * t)
    return np.array([z.real, (1j * omega * z).real])


def test_stroboscopic_map_of_a_linear_oscillator():
    """P(y) = y_s + exp(A T) (y - y_s); its derivative is the fundamental matrix."""
    system, y0 = Oscillator(f=1.0, forced=True), jnp.asarray([2.0, -1.0])
    y_s = steady(1.3, t=0.4)

    @jax.jit
    def step(x):
        found = stroboscopic_map(system, Motion(*x), t0=0.4, order=2, iterates=3, **TIGHT)
        return jnp.stack(found.y, axis=-1), found.t

    points, t = step(y0)
    np.testing.assert_allclose(t, 0.4 + 4 * np.pi / 1.3 * np.arange(1, 4), rtol=1e-14)
    slope, _ = jax.jit(jax.jacfwd(step))(y0)
    for n in range(3):
        phi = expm(FREE * 4 * np.pi / 1.3 * (n + 1))
        np.testing.assert_allclose(points[n], y_s + phi @ (y0 - y_s), atol=1e-8)
        np.testing.assert_allclose(slope[n], phi, atol=1e-8)


class ForcedHammer(Hammer):
    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_impact_oscillator():
    """Iterates go on from one to the next as one solution does, from the wall too."""
    system, y0 = ForcedHammer(), Motion(1.0, 0.0)
    found = stroboscopic_map(system, y0, iterates=4, **TIGHT)
    period = 2 * np.pi / system.omega
    sol = nsjax.solve(system, 0.0, 4 * period, y0, saveat=dfx.SaveAt(ts=period * jnp.arange(1.0, 5.0)), **TIGHT)
    np.testing.assert_allclose(flat(found.y), flat(sol.ys), atol=1e-6)
    hits = poincare_map(system, "wall", y0, mode=jnp.zeros(1, int), t0=0.0, iterates=5, **TIGHT)
    np.testing.assert_allclose(hits.t, sol.events.t[:5], rtol=1e-8)
    assert np.all(hits.y.v > 0)
    # From an iterate on, in its mode, come the ones that followed it.
    later = poincare_map(
        system, "wall", jax.tree.map(lambda x: x[1], hits.y), mode=hits.mode[1], t0=hits.t[1], iterates=5, **TIGHT
    )
    np.testing.assert_allclose(later.t[:3], hits.t[2:], rtol=1e-8)


def phase(t, y):
    return jnp.sin(0.8 * t)


@pytest.mark.parametrize(
    "e, b", [pytest.param(0.8, 0.0, marks=pytest.mark.slow), pytest.param(0.0, -2.0, marks=pytest.mark.slow)]
)
def test_a_phase_of_the_forcing_is_a_section(e, b):
    """Also of a mass that rests on the wall all the time, in its mode."""
    system, y0 = ForcedHammer(e=e, b=b), Motion(1.0, 0.0)
    found = poincare_map(system, phase, y0, iterates=4, **TIGHT)
    want = stroboscopic_map(system, y0, iterates=4, **TIGHT)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


# Section 6.9.


BELT = gallery.ForcedStickSlip(omega=1.68)
QUICK = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-11))


@eqx.filter_jit
def reduced(system, x, v):
    return reduced_map(system, x, "x", guess=Motion(0.0, v), order=2, throw=False, tol=1e-9, **QUICK)


@eqx.filter_jit
def reduced_with_slope(system, x, v):
    def image(x):
        found = reduced(system, x, v)
        return found.value, found

    _, slope, found = jax.jvp(image, (x,), (jnp.ones_like(x),), has_aux=True)
    return found, slope


@pytest.mark.slow
@pytest.mark.parametrize("branch", ["I", "IV", "V"])
def test_reduced_map_meets_the_diagonal_at_orbits(branch):
    exact = orbit_reference.forced_stick_slip_orbit(branch)
    x, v = exact.y0
    found, slope = reduced_with_slope(BELT, jnp.asarray(x), jnp.asarray(v + 1e-2))
    np.testing.assert_allclose([found.value, found.y.x, found.y.v], [x, x, v], atol=1e-7)
    assert found.result == RESULTS.successful
    # By the implicit function theorem, from the exact monodromy matrix.
    (a, b), (c, d) = exact.monodromy
    np.testing.assert_allclose(slope, a + b * c / (1 - d), rtol=1e-5)


@pytest.mark.slow
def test_reduced_map_is_a_tent_at_b():
    """At point B its tip is on the diagonal; its limbs there are those of the exact monodromy matrices, with stick to the
    left, which is approached like a square root, and without. Both are steeper than 1."""
    point = branch_reference.POINTS["6.9 B"]
    x, v = point.y0
    slip, stick = (a + b * c / (1 - d) for (a, b), (c, d) in branch_reference.belt_touch_monodromies("B"))
    found, slopes = jax.vmap(reduced_with_slope, (None, 0, None))(
        BELT.__class__(omega=point.at), x + 1e-6 * jnp.array([-16.0, -4.0, -1.0, 0.0, 1.0, 4.0]), jnp.asarray(v)
    )
    assert np.all(found.result == RESULTS.successful)
    np.testing.assert_allclose(found.value[3], x, atol=1e-9)
    near = 2 * slopes[1:3] - slopes[:2]
    np.testing.assert_allclose((4 * near[1] - near[0]) / 3, stick, rtol=1e-4)
    np.testing.assert_allclose(slopes[4:], slip, rtol=1e-5)
    assert stick > 1 and slip < -1


@pytest.fixture(scope="module")
def figure_6_23():
    system, x = BELT.__class__(omega=1.67587), jnp.linspace(1.4, 2.5, 111)
    return x, nsjax.sweep(lambda x: reduced(system, x, -0.5), x)


@pytest.mark.slow
def test_figure_6_23(figure_6_23):
    """Three fixed points, with the peak between those of branches V and IV; the orbits that `find_orbit` finds."""
    x, found = figure_6_23
    assert np.all(found.result == RESULTS.successful)
    assert 2.1 < x[np.argmax(found.value)] < 2.15
    ax = plot.poincare_map(x, found.value)
    places = [float(line.get_xdata()[0]) for line in ax.get_lines() if line.get_marker() == "o"]
    plt.close("all")
    system = BELT.__class__(omega=1.67587)
    starts = Motion(jnp.asarray(places), jnp.interp(jnp.asarray(places), x, found.y.v))
    orbits = nsjax.find_orbits(system, starts, order=2, max_events=8, **QUICK)
    multipliers = {round(float(o.y0.x), 2): complex(o.multipliers[0]).real for o in orbits}
    assert len(places) == len(orbits) == 3
    np.testing.assert_allclose(sorted(float(o.y0.x) for o in orbits), places, atol=1e-3)
    (_, one), (_, five), (_, four) = sorted(multipliers.items())
    assert abs(one) < 1 and five > 1 and four < -1


def test_reduced_map_says_where_there_is_none():
    """Of v' = 1 + x² no solution is periodic, whatever x."""

    class Runaway(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(-y.x, 1.0 + y.x**2 + 0 * y.v)

        @property
        def period(self):
            return 1.0

    found = reduced_map(Runaway(), 0.5, "x", guess=Motion(0.0, 0.0), throw=False, **QUICK)
    assert found.result == RESULTS.reduced_map_not_found and np.isnan(found.value)
    with pytest.raises(Exception, match="other components are periodic"):
        reduced_map(Runaway(), 0.5, "x", guess=Motion(0.0, 0.0), **QUICK)


# Brute force.


TWO = Motion(np.asarray([2.0, -1.0]), np.asarray([0.0, 3.0]))


def settled(omega, starts=TWO, zeta=ZETA, **options):
    """Five values and two starts: one program, which the tests share."""
    system = Oscillator(zeta=zeta, f=1.0, forced=True)
    return brute_force(system, "omega", omega, starts, transient=40, keep=8, **options)


def test_brute_force_finds_the_steady_state():
    """Pitfall 31: other values are no other program."""
    for first, last in ((0.5, 1.5), (0.6, 1.6)):
        with compilations() as compiled:
            found = settled(jnp.linspace(first, last, 5))
        assert found.ys.x.shape == found.ts.shape == (5, 2, 8)
        assert (found.result == RESULTS.successful).shape == (5, 2)
        want = np.stack([steady(w) for w in np.asarray(found.values)])
        np.testing.assert_allclose(flat(found.ys), np.broadcast_to(want[:, None, None], (5, 2, 8, 2)), atol=1e-5)
        np.testing.assert_allclose(found.ts[:, 0, 0], 41 * 2 * np.pi / found.values, rtol=1e-12)
        assert np.all(found.periods() == 1) and found.parameter == "omega"
    assert not compiled


@pytest.mark.parametrize("how", [dict(), dict(carry=True, solver=dfx.Tsit5())], ids=["apart", "carried"])
def test_brute_force_in_a_folder(how, tmp_path, monkeypatch):
    """On devices of its own choice, kept and read again, and the same."""
    values = jnp.linspace(0.5, 1.5, 5)
    plain, kept = settled(values, **how), settled(values, path=tmp_path, devices=1, **how)
    monkeypatch.setattr("nsjax.sweeps._piece.Piece.run", lambda *_: pytest.fail("computed once more"))
    again = settled(values, path=tmp_path, **how)
    np.testing.assert_allclose(flat(kept.ys), flat(plain.ys), atol=1e-13)
    np.testing.assert_array_equal(flat(kept.ys), flat(again.ys))


def test_what_has_not_settled_gets_no_period():
    """Pitfall 46: after a fixed time, 40 periods, a motion that decays by 6 % a period is on its way still. It is not
    taken for the attractor that is near, on which another one is, but left undecided."""
    x, v = steady(1.3, zeta=0.013)
    starts = Motion(jnp.asarray([5.0, x]), jnp.asarray([0.0, v]))
    found = settled(jnp.linspace(1.2, 1.4, 5), starts, zeta=0.013)
    assert found.periods()[2].tolist() == [0, 1] and np.all(found.periods()[:, 0] == 0)


@pytest.fixture(scope="module")
def belt_diagram():
    return brute_force(BELT, "omega", jnp.asarray([1.65, 1.68, 1.69, 1.8]), Motion(1.0, 0.0), transient=300, keep=40)


@pytest.mark.slow
def test_brute_force_in_section_6_9(belt_diagram):
    """Period 2 on the branches I and III, and the chaos between B and C; the points are those of the exact orbit."""
    assert belt_diagram.periods()[:, 0].tolist() == [2, 2, 0, 2]
    exact = orbit_reference.forced_stick_slip_orbit("I").y0
    points = flat(belt_diagram.ys)[1, 0]
    assert np.abs(points - exact).max(axis=1).min() < 1e-6
    ax = plot.brute_force(belt_diagram, labels={"omega": "ω [rad/s]", "x": "x [m]"})
    (dots,) = ax.get_lines()
    assert len(dots.get_xdata()) == 160 and (ax.get_xlabel(), ax.get_ylabel()) == ("ω [rad/s]", "x [m]")
    plot.brute_force(belt_diagram, lambda y: y.x**2 + y.v**2, ax=ax)
    assert len(ax.get_lines()) == 2 and ax.get_ylabel() == "measure"
    plt.close("all")


@pytest.mark.slow
def test_hysteresis():
    """Below the fold of branches I and V, at ω = 1.683, and above B, at 1.668, there are two attractors."""
    values = jnp.linspace(1.66, 1.70, 9)
    x0 = Motion(1.0, 0.0)
    up = brute_force(BELT, "omega", values, x0, transient=200, keep=20, carry=True)
    down = brute_force(BELT, "omega", values[::-1], x0, transient=200, keep=20, carry=True)
    rising, falling = up.periods()[:, 0], down.periods()[::-1, 0]
    assert rising[3] == 2 and falling[3] == 0  # ω = 1.675
    assert rising[0] == falling[0] == 2
    assert up.ys.x.shape == (9, 1, 20)


@pytest.mark.slow
def test_brute_force_with_a_section():
    """The stable orbit's maximum, the equilibrium, from which there is no return, and a value that fails: it harms no
    other, and what follows it begins at the start again."""
    v_dr = jnp.asarray([0.5, jnp.nan, 0.8, 1.3, 0.6])
    options = dict(section=rest, direction=-1, max_time=60.0, transient=3, keep=3)
    starts = Motion(jnp.asarray([1.0, 3.0]), jnp.asarray([0.0, 0.0]))  # the first is the equilibrium
    apart, carried = (brute_force(gallery.StickSlip(c=0.1), "v_dr", v_dr, starts, carry=c, **options) for c in (0, 1))
    for found, settles in ((apart, (0, 2, 4)), (carried, (0, 2))):
        assert np.all((found.result == RESULTS.no_return)[(0, 2, 3, 4), 0]) and np.all(found.periods()[:, 0] == -1)
        assert np.isnan(found.ys.x[1]).all() and np.all((found.result == RESULTS.nonfinite_field)[1])
        for i in settles:
            np.testing.assert_allclose(found.ys.x[i, 1], plateau(float(v_dr[i])), rtol=1e-6)
    # Above the fold the solution spirals in; what goes on from there has come into the equilibrium's basin.
    for found, last in ((apart, 3), (carried, 4)):
        x = np.asarray(found.ys.x)[last, 1]
        np.testing.assert_allclose((x[1:] - 1) / (x[:-1] - 1), LIMB, rtol=1e-6)


# Pictures and mistakes.


def test_cobweb():
    x = np.linspace(0, 1, 51)
    iterates = [0.1]
    for _ in range(5):
        iterates.append(0.5 * iterates[-1] + 0.3)
    ax = plot.poincare_map(x, 0.5 * x + 0.3, cobweb=iterates)
    web = next(line for line in ax.get_lines() if line.get_label() == "iterates")
    assert len(web.get_xdata()) == 11 and web.get_ydata()[0] == 0.1 and web.get_ydata()[-1] == iterates[-1]
    (dot,) = [line for line in ax.get_lines() if line.get_marker() == "o"]
    np.testing.assert_allclose([dot.get_xdata()[0], dot.get_ydata()[0]], 0.6, atol=1e-12)
    assert ax.get_aspect() == 1.0 and ax.get_xlim() == ax.get_ylim()
    with pytest.raises(ValueError, match="`x` must rise"):
        plot.poincare_map(x[::-1], x)
    with pytest.raises(ValueError, match="vectors of one length"):
        plot.poincare_map(x, x[1:])
    plt.close("all")


def test_mistakes_are_told():
    system, y0 = gallery.StickSlip(), Motion(2.5, 0.0)
    with pytest.raises(ValueError, match="`max_time` must be given, because `StickSlip` is autonomous"):
        poincare_map(system, rest, y0)
    with pytest.raises(ValueError, match="name of a switch of `StickSlip` .`belt`., but got 'wall'"):
        poincare_map(system, "wall", y0, max_time=9.0)
    with pytest.raises(TypeError, match="`section` must be a function"):
        poincare_map(system, 3.0, y0, max_time=9.0)
    with pytest.raises(ValueError, match="`section` must return a scalar .* but returned"):
        poincare_map(system, lambda t, y: (y.x, y.v), y0, max_time=9.0)
    with pytest.raises(ValueError, match="`direction` must be 1, -1 or 0"):
        poincare_map(system, rest, y0, direction=2, max_time=9.0)
    with pytest.raises(ValueError, match="`direction` must be 1 or 0 for the impact `wall`"):
        poincare_map(ForcedHammer(), "wall", y0, direction=-1)
    for name in ("number", "iterates"):
        with pytest.raises(ValueError, match=f"`{name}` must be a positive integer"):
            poincare_map(system, rest, y0, max_time=9.0, **{name: 0})
    with pytest.raises(ValueError, match="`system` must be forced"):
        stroboscopic_map(system, y0)
    with pytest.raises(ValueError, match="`component` must be one of x, v, but got 'z'"):
        reduced_map(BELT, 1.0, "z", guess=y0)
    with pytest.raises(ValueError, match="`x` must be a scalar"):
        reduced_map(BELT, jnp.ones(3), "x", guess=y0)
    with pytest.raises(ValueError, match="`transient` must be a positive integer"):
        brute_force(BELT, "omega", [1.6], y0, transient=-1)
    with pytest.raises(ValueError, match="`values` must be a vector"):
        brute_force(BELT, "omega", 1.6, y0)
    with pytest.raises(ValueError, match="one leading axis of the same length"):
        brute_force(BELT, "omega", [1.6], Motion(jnp.ones(2), jnp.ones(3)))
    with pytest.raises(ValueError, match="`parameter` must be one of"):
        brute_force(BELT, "speed", [1.6], y0)
