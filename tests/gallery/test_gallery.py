"""The gallery against the thesis's formulas, written down here once more, case by case as the thesis prints them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drillstring import drillstring, regions
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsjax
from nsjax import gallery
from nsjax.system._impact import impact


KEYS = tuple(gallery.THESIS)
C_3 = dict(m=1.0, c=0.05, k=1.0, x_c=1.0, k_f=4.0, c_f=0.5, f_0=0.2)
APPENDIX_C = {
    "2.4": dict(k=1.0, m=1.0, v_dr=0.2, F_s=1.0, delta=3.0),
    "3.4": dict(k=1.0, c=0.0, m=1.0, v_dr=0.2, F_slip=1.0, F_stick=2.0),
    "6.6": C_3,
    "6.7": dict(k=1.0, c=0.1, m=1.0, v_dr=0.2, F_slip=1.0, F_stick=2.0),
    "6.8": dict(m=1.0, c=0.01, k=1.0, f_0=2.5, F_slip=1.0, F_stick=2.0),
    "6.9": dict(m=1.0, k=1.0, v_dr=1.0, alpha_0=1.5, alpha_1=1.5, alpha_3=0.45, f_0=0.1),
}


def state(key, *values):
    return type(gallery.THESIS[key].y0)(*map(jnp.asarray, values))


def field(key, t, values, s=None):
    """The vector field as a numpy array; by default in the region of the state."""
    system = gallery.thesis(key)
    y = state(key, *values)
    if s is None:
        # The value of an impact is a force, zero between impacts.
        s = [
            0.0 if isinstance(k, impact) else jnp.sign(jnp.stack(k.components(system, t, y)).min())
            for k in system.switches
        ]
    return np.array(system.vector_field(jnp.asarray(t), y, system.values(tuple(map(jnp.asarray, s)))))


# The right-hand sides, with the numbers put in.


def elastic_support(t, x, v):
    return v, np.cos(t) - x - (4 * x if x > 0 else 0)


def dry_friction(t, x, v):
    return v, 2 * np.cos(0.5 * t) - x - (1 if v > 0 else -1)


def whirl_and_twist(t, *y, omega=3.05):  # (A.51)
    return drillstring(*y, omega, regions(*y, omega))


def whirl(t, *y):  # (A.16)
    return whirl_and_twist(t, *y, 0.0, 0.0, omega=2.6)[:3]


def twist(t, phi, w):  # (A.50)
    return w, -phi - 0.2 * np.sign(w + 2) / (1 + 0.3 * abs(w + 2))


def support(t, x, v):  # (3.53), (3.54)
    if x > 0 and 4 * x + 0.5 * v > 0:
        return v, -5 * x - 0.5 * v + np.cos(1.2 * t)
    return v, -x + np.cos(1.2 * t)


def arctan_abs(h):  # the smooth approximation of |h| in chapter 5
    return 2 / np.pi * np.arctan(10 * h) * h


def no_crossing(t, x1, x2):
    return x2, 1 - (5 if x1 > 0 else 1) * x1 - 2.5 * x2


def double_hopf_crossing(t, x1, x2, x3):  # the coefficients of the characteristic polynomial multiply x1
    a1, a2 = (1, 3) if x1 > 0 else (3, 1)
    return x2 - a1 * x1, x3 - a2 * x1, 1 - 3.36 * x1


def hopf(t, x1, x2):  # (5.27), (5.28), in the complex plane
    z = complex(x1, x2)
    rate = z * ((1 + 1j) + (-1 + 1j) * abs(z) ** 2)
    return rate.real, rate.imag


def discontinuous_hopf(t, x1, x2):  # (5.29), at μ = 1
    r = np.hypot(x1, x2)
    kinks = abs(r + 0.5) - abs(r - 0.5)
    return -x1 - x2 + x1 / r * kinks, x1 - x2 + x2 / r * kinks


def hopf_pitchfork(t, x1, x2, mu=-1.0, size=abs):  # (5.32), (5.40)
    kinks = size(x1 + mu) - size(x1 - mu) - size(x2 + mu) + size(x2 - mu)
    return x2, -x1 - x2 + kinks


def trilinear(t, x, v):  # (6.14)-(6.16)
    stiffness, damping = x, 0.05 * v
    if x > 1 and 4 * (x - 1) + 0.5 * v >= 0:
        stiffness, damping = x + 4 * (x - 1), 0.55 * v
    if x < -1 and 4 * (x + 1) + 0.5 * v <= 0:
        stiffness, damping = x + 4 * (x + 1), 0.55 * v
    return v, 0.2 * np.sin(1.15 * t) - stiffness - damping


def stick_slip(t, x, v, c=0.0):  # (3.33), (3.34)
    return v, -x - c * v - np.sign(v - 0.2)


def falling_stick_slip(t, x, v):  # (2.30), (2.31)
    return v, -x - np.sign(v - 0.2) / (1 + 3 * abs(v - 0.2))


def forced_friction(t, x, v):  # (6.25), (6.26)
    return v, -0.01 * v - x - np.sign(v) + 2.5 * np.cos(0.65 * t)


def forced_stick_slip(t, x, v):  # (6.27), (6.28)
    w = v - 1
    return v, -x - 1.5 * np.sign(w) + 1.5 * w - 0.45 * w**3 + 0.1 * np.cos(1.65 * t)


FIELDS = {
    "1.1(1)": elastic_support,
    "1.1(2)": dry_friction,
    "1.1(3)": lambda t, x, v: (v, -9.81),
    "(2.3)": lambda t, x: (3.0 if x < 0 else -1.0,),
    "example 2.1": lambda t, x1, x2: (6, -2) if x2 > 1 else (2, -6),
    "example 2.2": lambda t, x1, x2: (6, -2) if x2 > 1 else (2, 6),
    "example 2.3": lambda t, x1, x2: (-6, 2) if x2 > 1 else (-2, -6),
    "example 2.4": lambda t, x: (1.0 if x > 0 else -1.0,),
    "example 2.5": lambda t, x: (3.0 if x > 0 else 1.0,),
    "(2.26)": lambda t, v: (0.75 - 2 / np.pi * np.arctan(1e3 * v) * (0.5 / (1 + 3 * abs(v)) + 0.5),),
    "(2.28)": lambda t, v: (0.75 - np.sign(v) * (0.5 / (1 + 3 * abs(v)) + 0.5),),
    "(2.29)": lambda t, v: (0.75 - np.sign(v) * 0.5,),
    "2.4": falling_stick_slip,
    "3.4": stick_slip,
    "3.5": support,
    "5.2": no_crossing,
    "figure 5.3": double_hopf_crossing,
    "(5.7)": lambda t, x: (1 - x * x,),
    "(5.8)": lambda t, x: (1 - abs(x),),
    "(5.10)": lambda t, x: ((1 - x) * x,),
    "(5.11)": lambda t, x: (0.5 - abs(x - 0.5),),
    "(5.15)": lambda t, x: (arctan_abs(0.5) + 0.1 - arctan_abs(x - 0.5),),
    "(5.17)": lambda t, x: (x * (1 - x * x),),
    "(5.18)": lambda t, x: (-x + abs(x + 0.5) - abs(x - 0.5),),
    "(5.22)": lambda t, x: (x + abs(x - 0.5) - abs(x + 0.5),),
    "(5.23)": lambda t, x: (-x + arctan_abs(x + 0.5) + 0.1 - arctan_abs(x - 0.5),),
    "(5.25)": hopf,
    "(5.29)": discontinuous_hopf,
    "(5.30)": lambda t, r, theta: (-r + abs(r + 0.5) - abs(r - 0.5), 1.0),
    "5.7": hopf_pitchfork,
    "(5.40)": lambda t, x1, x2: hopf_pitchfork(t, x1, x2, size=arctan_abs),
    "6.6": trilinear,
    "6.7": lambda t, x, v: stick_slip(t, x, v, c=0.1),
    "6.8": forced_friction,
    "6.9": forced_stick_slip,
    "A.7": whirl,
    "A.8": twist,
    "A.9": whirl_and_twist,
}

# The mechanical reading of dry friction: belt velocity, F_ex(t, x) in stick, largest static friction force.
STICK = {
    "1.1(2)": (0.0, lambda t, x: x - 2 * np.cos(0.5 * t), 1.0),
    "2.4": (0.2, lambda t, x: x, 1.0),
    "3.4": (0.2, lambda t, x: x, 2.0),
    "6.7": (0.2, lambda t, x: x + 0.1 * 0.2, 2.0),
    "6.8": (0.0, lambda t, x: x - 2.5 * np.cos(0.65 * t), 2.0),
    "6.9": (1.0, lambda t, x: x - 0.1 * np.cos(1.65 * t), 1.5),
}


@pytest.mark.parametrize("key", KEYS)
def test_structure_at_every_value_of_the_switches(key):
    entry = gallery.THESIS[key]
    system = gallery.thesis(key)
    y = jax.tree.map(jnp.asarray, entry.y0)
    for s in itertools.product((-1.0, 0.0, 1.0), repeat=len(system.switches)):
        out = system.vector_field(jnp.asarray(entry.t0), y, system.values(tuple(map(jnp.asarray, s))))
        assert jax.tree.structure(out) == jax.tree.structure(y)
        assert all(jnp.shape(leaf) == () and jnp.isfinite(leaf) for leaf in out)
    assert entry.t1 > entry.t0
    assert "\n" not in entry.title
    assert type(system).__doc__ and ("eq. (" in type(system).__doc__ or "1.1" in key or "2.5" in key)


@pytest.mark.parametrize("key", KEYS)
def test_fields_in_each_region(key):
    rng = np.random.default_rng(0)
    dimension = len(gallery.THESIS[key].y0)
    found = set()
    for _ in range(100):
        t, y = rng.uniform(0, 10), rng.uniform(-2, 2, dimension)
        expected = FIELDS[key](t, *y)
        np.testing.assert_allclose(field(key, t, y), expected, rtol=1e-13, atol=1e-13)
        system = gallery.thesis(key)
        h = [min(map(float, k.components(system, t, state(key, *y)))) for k in system.switches]
        found.add(tuple(np.sign(h)))
    # μ has one sign in (5.11), r > -μ/2 in (5.29), and the lines of 5.7 make a grid; rotor and bit turn forwards in A.7
    # to A.9.
    some = {"(5.11)": 2, "(5.29)": 2, "5.7": 9, "A.7": 2, "A.8": 1, "A.9": 2}
    assert len(found) == some.get(key, len(system.switches) + 1)


@pytest.mark.parametrize("key", KEYS)
def test_affine_in_each_switch_value(key):
    t, y = 0.3, np.array([1.3, 0.7, -0.4, 0.2, 0.5])[: len(gallery.THESIS[key].y0)]
    n = len(gallery.thesis(key).switches)
    for i in range(n):
        at = [field(key, t, y, [value if j == i else 0.6 for j in range(n)]) for value in (-1.0, 0.5, 1.0)]
        np.testing.assert_allclose(at[1], 0.25 * at[0] + 0.75 * at[2], atol=1e-13)


@pytest.mark.parametrize("key", STICK)
def test_stick_balances_the_applied_force(key):
    v_dr, F_ex, F_stick = STICK[key]
    system = gallery.thesis(key)
    (switch,) = system.switches
    slip_force = {"6.9": 1.5}.get(key, 1.0)
    assert float(switch.bound(system)) * slip_force == F_stick
    t, x = 0.7, 0.4
    s = -F_ex(t, x) / slip_force
    np.testing.assert_allclose(field(key, t, [x, v_dr], [s]), [v_dr, 0], atol=1e-14)


def test_sliding_modes_of_chapter_2():
    assert field("(2.3)", 0.0, [0.0], [0.5]) == 0  # (2.7)
    np.testing.assert_allclose(field("example 2.2", 0.0, [0.0, 1.0], [0.5]), [5, 0])  # (2.19), (2.20)
    np.testing.assert_allclose(field("example 2.3", 0.0, [0.0, 1.0], [0.5]), [-5, 0])
    assert field("example 2.4", 0.0, [0.0], [0.0]) == 0
    point = gallery.thesis("example 2.5")
    assert field("example 2.5", 0.0, [0.0], [-2.0]) == 0
    assert point.switches[0].bound(point) == 3
    assert gallery.thesis("example 2.4").switches[0].bound(point) == 1  # the shared surface is as it was
    for key, bound in (("(2.28)", 1.0), ("(2.29)", 2.0)):
        block = gallery.thesis(key)
        assert float(block.switches[0].bound(block)) == bound
        force = block.F_s if key == "(2.28)" else block.F_d
        np.testing.assert_allclose(field(key, 0.0, [0.0], [0.75 / force]), 0, atol=1e-15)


@pytest.mark.parametrize("key, v", [("2.4", 0.2), ("(2.28)", 0.0)])
@pytest.mark.parametrize("s", [-1.0, 1.0])
def test_derivative_on_the_surface_is_that_of_the_region(key, v, s):
    # At an event the sign of v_rel is rounding noise; the derivative must not depend on it.
    system = gallery.thesis(key)
    zero = [0.0] * (len(gallery.THESIS[key].y0) - 1)
    weight = 3.0 if key == "2.4" else 3.0 * 0.5  # -F' = s δ (F_s - F_d) at v_rel = 0 and |v_rel|' = s
    for noise in (-1e-16, 0.0, 1e-16):
        slope = jax.jacfwd(
            lambda v: system.vector_field(0.0, state(key, *zero, v), system.values((jnp.asarray(s),))).v
        )(jnp.asarray(v + noise))
        np.testing.assert_allclose(slope, weight, rtol=1e-12)


@pytest.mark.parametrize("key", ["(2.28)", "2.4"])
def test_falling_friction_far_from_the_surface(key):
    # Velocities about 1/δ, where the continuation of the other region's characteristic has its pole.
    system = gallery.thesis(key)
    zero = [0.0] * (len(gallery.THESIS[key].y0) - 1)
    v_dr = 0.2 if key == "2.4" else 0.0
    for v_rel in (-1 / 3, 1 / 3, -1 / 6, 1 / 6, 1e6, -1e6):
        np.testing.assert_allclose(field(key, 0.0, [*zero, v_dr + v_rel]), FIELDS[key](0.0, *zero, v_dr + v_rel))
        s = system.values((jnp.sign(jnp.asarray(v_rel)),))
        slope = jax.grad(lambda v, s: system.vector_field(0.0, state(key, *zero, v), s).v)(v_dr + v_rel, s)
        size = 1.0 if key == "2.4" else 0.5
        np.testing.assert_allclose(slope, size * 3 / (1 + 3 * abs(v_rel)) ** 2, rtol=1e-9)


@pytest.mark.parametrize("key", ["6.6", "6.8"])
def test_symmetry(key):  # (6.24)
    half = gallery.thesis(key).period / 2
    for t, x, v in ((0.1, 0.3, 0.2), (2.0, 1.4, 0.5), (3.0, -1.2, 0.1), (1.0, -1.3, -0.7)):
        np.testing.assert_allclose(field(key, t, [x, v]), -field(key, t + half, [-x, -v]), rtol=1e-12)


def test_supports_touch_where_the_contact_force_pushes():
    for key, x_c in (("3.5", 0.0), ("6.6", 1.0)):
        system = gallery.thesis(key)
        switch = system.switches[0]
        gap, force = switch.components(system, 0.0, state(key, x_c + 0.1, -1.0))
        np.testing.assert_allclose([gap, force], [0.1, 4 * 0.1 - 0.5])  # (3.46), (3.47), (6.17): about to leave
    system = gallery.thesis("6.6")
    gap, force = system.switches[1].components(system, 0.0, state("6.6", -1.1, 1.0))
    np.testing.assert_allclose([gap, force], [0.1, 4 * 0.1 - 0.5])


def test_ball_feels_the_floor():
    system = gallery.thesis("1.1(3)", m=2.0)
    (switch,) = system.switches
    assert isinstance(switch, impact) and switch.restitution_fn(system) == 0.8
    y = gallery.Motion(jnp.asarray(0.0), jnp.asarray(0.0))
    resting = system.vector_field(0.0, y, system.values((jnp.asarray(2.0 * 9.81),)))
    assert resting.v == 0


@pytest.mark.parametrize("key", APPENDIX_C)
def test_values_of_appendix_c(key):
    system = gallery.thesis(key)
    assert {name: getattr(system, name) for name in APPENDIX_C[key]} == APPENDIX_C[key]


@pytest.mark.parametrize("key", KEYS)
def test_period(key):
    system = gallery.thesis(key)
    if not hasattr(system, "omega") or key in (
        "(5.25)",
        "(5.29)",
        "(5.30)",
        "A.7",
        "A.8",
        "A.9",
    ):  # there it is not that of a force
        assert system.period is None
        return
    np.testing.assert_allclose(system.period, 2 * np.pi / system.omega)
    np.testing.assert_allclose(gallery.thesis(key, omega=0.5).period, 4 * np.pi)
    y = [0.3, 0.4]
    np.testing.assert_allclose(field(key, 0.2, y), field(key, 0.2 + system.period, y), rtol=1e-12)


# Chapter 5: fixed points, and what jumps there.


def flow(system, y, s=None):
    """The vector field in the region of the state, or of the signs `s`."""
    if s is None:
        s = [float(jnp.sign(jnp.asarray(*k.components(system, 0.0, y)))) for k in system.switches]
    return jnp.stack(system.vector_field(0.0, y, system.values(tuple(map(jnp.asarray, s)))))


def matrix(system, y, s=None):
    """∂f/∂y there."""
    return np.array(jax.jacfwd(lambda y: flow(system, y, s))(y)).T


FIXED_POINTS = {  # by key, and by the value of the parameter μ if no others are given: the point and its eigenvalues
    ("5.2", -1.0): [([-1, 0], [-0.5, -2])],
    ("5.2", 1.0): [([0.2, 0], [-1.25 - 1.8540497j, -1.25 + 1.8540497j])],
    ("figure 5.3", -1.0): [([-1 / 3.36, -3 / 3.36, -1 / 3.36], np.roots([1, 3, 1, 3.36]))],
    ("figure 5.3", 1.0): [([1 / 3.36, 1 / 3.36, 3 / 3.36], np.roots([1, 1, 3, 3.36]))],
    ("(5.7)", 0.25): [([0.5], [-1]), ([-0.5], [1])],
    ("(5.8)", 0.25): [([0.25], [-1]), ([-0.25], [1])],
    ("(5.8)", -0.25): [],
    ("(5.10)", 0.5): [([0], [0.5]), ([0.5], [-0.5])],
    ("(5.10)", -0.5): [([0], [-0.5]), ([-0.5], [0.5])],
    ("(5.11)", 0.5): [([0], [1]), ([0.5], [-1])],
    ("(5.11)", -0.5): [([0], [-1]), ([-0.5], [1])],
    ("(5.17)", 0.25): [([0], [0.25]), ([0.5], [-0.5]), ([-0.5], [-0.5])],
    ("(5.17)", -0.25): [([0], [-0.25])],
    ("(5.17)", -0.25, 1.0): [([0], [-0.25]), ([0.5], [0.5]), ([-0.5], [0.5])],
    ("(5.17)", 0.25, 1.0): [([0], [0.25])],
    ("(5.18)", 0.5): [([0], [1]), ([0.5], [-1]), ([-0.5], [-1])],
    ("(5.18)", -0.5): [([0], [-3])],
    ("(5.22)", 0.5): [([0], [3])],
    ("(5.22)", -0.5): [([0], [-1]), ([0.5], [1]), ([-0.5], [1])],
    ("(5.25)", 0.3): [([0, 0], [0.3 - 1j, 0.3 + 1j])],
    ("(5.29)", -0.3): [([0, 0], [-3 - 1j, -3 + 1j])],
    ("(5.29)", 0.3): [([0, 0], [1 - 1j, 1 + 1j])],
    ("5.7", -0.5): [([0, 0], [0.5 - np.sqrt(11) / 2 * 1j, 0.5 + np.sqrt(11) / 2 * 1j])],  # (5.33)
    ("5.7", 0.5): [([0, 0], [-1.5 + np.sqrt(13) / 2, -1.5 - np.sqrt(13) / 2])]  # (5.34)
    + [([x, 0], [-1.5 + np.sqrt(5) / 2, -1.5 - np.sqrt(5) / 2]) for x in (1, -1)],  # (5.35)
}


@pytest.mark.parametrize("case", FIXED_POINTS, ids=str)
def test_fixed_points(case):
    key, *values = case
    system = gallery.thesis(key, **dict(zip(("mu", "alpha"), values)))
    for values, eigenvalues in FIXED_POINTS[case]:
        y = state(key, *map(float, values))
        np.testing.assert_allclose(flow(system, y), 0, atol=1e-15)
        found = np.linalg.eigvals(matrix(system, y))
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(np.array(eigenvalues, complex)), atol=1e-7)
    if len(gallery.entry(key).y0) == 1:  # there are no others
        f = np.array([flow(system, state(key, x)) for x in np.linspace(-2, 2, 202)])
        assert np.sum(f[1:] * f[:-1] < 0) == len(FIXED_POINTS[case])


CROSSINGS = {  # at μ = 0: the signs before and after, and at which q an eigenvalue is where on the imaginary axis
    "5.2": ([-1], [1], []),
    "figure 5.3": ([-1], [1], [(0.1, np.sqrt(1.2)), (0.9, np.sqrt(2.8))]),
    "(5.8)": ([-1], [1], [(1 / 2, 0)]),  # (5.9)
    "(5.11)": ([-1, 1], [1, 1], [(1 / 2, 0)]),  # (5.12)
    "(5.18)": ([-1, 1], [1, -1], [(3 / 4, 0)]),  # of the way from x = 0, μ < 0 to x = 0, μ > 0
    "(5.22)": ([-1, 1], [1, -1], [(1 / 4, 0)]),
    "(5.29)": ([-1, 1], [1, -1], [(3 / 4, 1)]),
    "5.7": ([-1, 1, -1, 1], [1, -1, 1, -1], [(1 / 4, np.sqrt(2)), (3 / 4, 0)]),  # (5.36), Fig. 5.13
}


@pytest.mark.parametrize("key", CROSSINGS)
def test_set_valued_eigenvalues(key):
    *sides, crossings = CROSSINGS[key]
    system = gallery.thesis(key, mu=0.0)
    zero = state(key, *np.zeros(len(gallery.entry(key).y0)))
    before, after = (matrix(system, zero, np.array(s, float)) for s in sides)
    for q, omega in crossings:
        roots = np.linalg.eigvals((1 - q) * before + q * after)
        np.testing.assert_allclose(np.min(abs(roots - 1j * omega)), 0, atol=1e-12)
    # There are no other crossings: on the way so many eigenvalues change their sides.
    path = [np.linalg.eigvals((1 - q) * before + q * after) for q in np.linspace(0, 1, 1002)]
    unstable = np.array([np.sum(roots.real > 0) for roots in path])
    assert np.abs(np.diff(unstable)).sum() == sum(2 if omega else 1 for _, omega in crossings)
    if key == "figure 5.3":
        assert unstable[0] == unstable[-1] == 2 and unstable[500] == 0
        assert np.linalg.matrix_rank(after - before) == 1


@pytest.mark.parametrize("key", ["(5.11)", "(5.18)"])
def test_change_of_the_field_with_the_parameter(key):  # (5.13), (5.20)
    for s in itertools.product((-1.0, 1.0), repeat=2):
        slope = jax.jacfwd(lambda mu, s=s: flow(gallery.thesis(key, mu=mu), state(key, 0.0), s))(0.0)
        assert slope == sum(s) / 2


@pytest.mark.parametrize("key", CROSSINGS)
def test_size_in_proportion_to_mu(key):  # (5.37)
    y = np.array([0.7, -0.4, 0.3])[: len(gallery.entry(key).y0)]
    for mu in (-1.0, 1.0):
        one, other = (flow(gallery.thesis(key, mu=k * mu), state(key, *k * y)) for k in (1.0, 3.0))
        np.testing.assert_allclose(other, 3 * one, rtol=1e-14)


@pytest.mark.parametrize("mu", [-0.3, 0.2])
def test_smooth_approximations(mu):  # (5.15), (5.23), (5.40)
    for key, smooth, added in (("(5.11)", "(5.15)", 0.1), ("(5.18)", "(5.23)", 0.1), ("5.7", "(5.40)", 0.0)):
        rough, system = nsjax.smoothed(gallery.thesis(key, mu=mu), 10.0), gallery.thesis(smooth, mu=mu, epsilon=10.0)
        for values in ([0.3, -0.2], [-0.05, 0.4], [0.0, 0.0]):
            y = state(key, *values[: len(gallery.entry(key).y0)])
            np.testing.assert_allclose(flow(system, y), flow(rough, y) + added, atol=1e-15)


def test_bifurcations_of_the_smooth_approximations():
    z = brentq(lambda z: np.arctan(z) + z / (1 + z * z) - np.pi / 4, 0, 1)  # where (2/π) arctan(z) z has the slope 1/2
    np.testing.assert_allclose([2 * z, z], [0.8832, 0.4416], atol=5e-5)
    for eps in (10.0, 1e3):
        for key, mu, want in (
            ("(5.18)", 2 * z / eps, [0]),
            ("(5.30)", 2 * z / eps, [0, 0]),
            ("(5.29)", 2 / np.sqrt(eps), [-1j, 1j]),
            ("5.7", -z / eps, [-1j * np.sqrt(2), 1j * np.sqrt(2)]),
            ("5.7", z / eps, [-2, 0]),
        ):
            origin = state(key, *np.zeros(len(gallery.entry(key).y0)))
            roots = np.linalg.eigvals(matrix(nsjax.smoothed(gallery.thesis(key, mu=mu), eps), origin))
            np.testing.assert_allclose(np.sort_complex(roots), np.array(want, complex), atol=1e-12)
    fold, x = gallery.thesis("(5.23)", mu=3.23475692 / 50, epsilon=50.0), state("(5.23)", -1.60848606 / 50)
    np.testing.assert_allclose(flow(fold, x), 0, atol=1e-9)
    np.testing.assert_allclose(matrix(fold, x), 0, atol=1e-7)
    for mu in (-0.1, 0.0, 0.1):  # no bifurcation
        f = [flow(gallery.thesis("(5.15)", mu=mu), state("(5.15)", x)) for x in np.linspace(-1, 1, 102)]
        assert np.sum(np.diff(np.sign(f), axis=0) != 0) == 2
    np.testing.assert_allclose(flow(gallery.thesis("(5.15)", mu=0.0, epsilon=50.0), state("(5.15)", 0.0)), 1 / 50)


def test_polar_coordinates():  # (5.26)-(5.28), (5.30), (5.31)
    for r, theta in ((0.2, 0.3), (0.8, 4.0)):
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        polar = field("(5.30)", 0.0, [r, theta])
        x = turn @ [r, 0]
        np.testing.assert_allclose(field("(5.29)", 0.0, x), turn @ [polar[0], r * polar[1]], rtol=1e-14)
        np.testing.assert_allclose(field("(5.25)", 0.0, x), turn @ [r - r**3, r * (1 + r**2)], rtol=1e-14)


def outside_flow(key, y, t1):
    """scipy on the formulas above; dry friction by its mechanical reading."""
    if key not in STICK:
        return solve_ivp(lambda t, y: FIELDS[key](t, *y), (0, t1), y, rtol=1e-8, atol=1e-10, max_step=0.2).y[:, -1]
    v_dr, F_ex, F_stick = STICK[key]

    def slip(t, y, side):  # the field of this side, also where a trial step has gone over to the other
        return FIELDS[key](t, y[0], v_dr + side * max(side * (y[1] - v_dr), 1e-12))

    def stick(t, y, side):
        return v_dr, 0.0

    def end_of_slip(t, y, side):
        return side * (y[1] - v_dr)

    def end_of_stick(t, y, side):
        return F_stick - abs(F_ex(t, y[0]))

    for event in (end_of_slip, end_of_stick):
        event.terminal, event.direction = True, -1
    t, sticks, side = 0.0, False, np.sign(y[1] - v_dr)
    while t < t1:
        rhs, event = (stick, end_of_stick) if sticks else (slip, end_of_slip)
        arc = solve_ivp(rhs, (t, t1), y, events=event, args=(side,), rtol=1e-8, atol=1e-10, max_step=0.2)
        t, y = arc.t[-1], arc.y[:, -1]
        if arc.status == 1:
            y[1] = v_dr
            sticks = not sticks and abs(F_ex(t, y[0])) <= F_stick
            side = -np.sign(F_ex(t, y[0]))
    return y


@pytest.mark.parametrize("key", [key for key, entry in gallery.THESIS.items() if entry.orbit is not None])
def test_orbit_guess_returns_to_itself(key):
    guess = gallery.THESIS[key].orbit
    period = gallery.thesis(key).period
    time = guess.period if period is None else guess.order * float(period)
    assert (guess.period is None) == (period is not None)
    np.testing.assert_allclose(outside_flow(key, np.array(guess.y0), time), guess.y0, atol=5e-3)
    if guess.order == 2:
        assert np.linalg.norm(outside_flow(key, np.array(guess.y0), time / 2) - guess.y0) > 0.1


def test_period_of_3_4():
    entry = gallery.entry("3.4")
    assert abs(entry.orbit.period - (10 + np.pi + 2 * np.arctan(1 / 5))) < 5e-3
    np.testing.assert_allclose(entry.orbit.y0.x, 1 + np.sqrt(1.04), atol=1e-3)


@pytest.mark.parametrize(
    "spelling, key",
    [
        ("Example 2.1", "example 2.1"),
        ("ex. 2.4", "example 2.4"),
        ("eq 2.3", "(2.3)"),
        ("2.3", "(2.3)"),
        ("Equation (2.28)", "(2.28)"),
        ("1.1.1", "1.1(1)"),
        ("Table 1.1 (3)", "1.1(3)"),
        ("2.4", "2.4"),
        ("Section 6.6", "6.6"),
        ("§6.9", "6.9"),
        ("5.7", "5.7"),  # a section before an equation
        ("Section 5.7", "5.7"),
        ("eq. 5.7", "(5.7)"),
        ("(5.7)", "(5.7)"),
        ("eq. (5.32)", "5.7"),
        ("5.32", "5.7"),
        ("(5.31)", "(5.30)"),
        ("5.8", "(5.8)"),
        ("Fig. 5.3", "figure 5.3"),
        ("a.7", "A.7"),
        ("Section A.8", "A.8"),
        ("eq. A.51", "A.9"),
        ("(A.15)", "A.7"),
    ],
)
def test_spellings(spelling, key):
    assert gallery.entry(spelling) is gallery.THESIS[key]


@pytest.mark.parametrize(
    "key", ["2.1", "2.1e", "(2.4)", "section 2.3", "example 2.6", "1.1", "1.1(4)", "5.3", "(5.2)", "6.66", "A.1", ""]
)
def test_unknown_key(key):
    with pytest.raises(ValueError, match="Argument `key` must be one of '1.1\\(1\\)'.*'neuron', but got") as error:
        gallery.thesis(key)
    assert "\n" not in str(error.value)


def test_parameters():
    assert gallery.thesis("6.7").c == 0.1
    assert gallery.thesis("6.7", c=0.2, v_dr=1.0).c == 0.2
    assert gallery.thesis("3.4").c == 0.0
    with pytest.raises(ValueError, match="Argument `zeta` must be a parameter of '6.6' \\(m, c, k,"):
        gallery.thesis("6.6", zeta=0.1)


def test_entries_are_frozen_and_ordered():
    assert KEYS[0] == "1.1(1)" and KEYS[-1] == "A.9" and len(KEYS) == 38
    with pytest.raises(TypeError):
        gallery.THESIS["6.6"] = None
    with pytest.raises(AttributeError):
        gallery.THESIS["6.6"].key = "6.7"
