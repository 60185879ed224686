"""Fields written with `jnp.abs` and the like: as they were, but with a switch for each kink."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from models import flat, Heat, Motion, pid
from scipy.integrate import solve_ivp

import nsjax
from nsjax import gallery, mark_kinks, solve


class Written(nsjax.System):
    """x' = fn(x), elementwise."""

    fn: Callable = eqx.field(static=True)

    def vector_field(self, t, y, s):
        return self.fn(y)


def names(system):
    return [k.name for k in system.switches]


def in_its_region(system, y, t=0.0):
    """The field for the values that the switches have there."""
    s = system.values(tuple(jnp.sign(k.guard(system, t, y)) for k in system.switches))
    return system.vector_field(t, y, s)


LAWS: dict[str, tuple[Any, list[str], int]] = {  # names of switches, and how many are bent
    "abs": (lambda x: 2 * jnp.abs(x - 0.3), ["abs_1"], 0),
    "maximum": (lambda x: x + jnp.maximum(x**2, 1.0), ["max_1"], 0),
    "minimum": (lambda x: jnp.minimum(x, jnp.cos(x)), ["min_1"], 0),
    "relu": (jax.nn.relu, ["max_1"], 0),
    "clip": (lambda x: jnp.clip(x, -1, 1), ["max_1", "min_2"], 0),
    "clamp": (lambda x: lax.clamp(-1.0, x, 1.0), ["max_1", "min_2"], 0),
    "without a bound": (lambda x: jnp.clip(x, 0, jnp.inf), ["max_1"], 0),
    "nested": (lambda x: jnp.abs(jnp.abs(x) - 1), ["abs_1", "abs_2"], 0),
    "hat": (lambda x: jnp.maximum(0, 1 - jnp.abs(x)), ["abs_1", "max_2"], 0),
    "product": (lambda x: jnp.abs(x) * jnp.abs(x - 1), ["abs_1", "abs_2"], 0),
    "one surface": (
        lambda x: jnp.abs(x) + jax.nn.relu(x) + jnp.minimum(0, x) - jnp.abs(1.0 * x),
        ["abs_1", "abs_2"],
        0,
    ),
    "one surface, differences": (lambda x: jnp.abs(x - 1) + jnp.maximum(x, 1) + jnp.minimum(1.0, x), ["abs_1"], 0),
    "a constant": (lambda x: jnp.abs(-2.0) * jnp.abs(x), ["abs_1"], 0),
    "compiled": (jax.jit(lambda x: jax.jit(jnp.abs)(jnp.sin(x))), ["abs_1"], 0),
    "in steps": (lambda x: jnp.abs(jnp.mod(x, 2.0) - 1), ["abs_1"], 0),
    "smooth": (lambda x: jnp.abs(x) * jnp.hypot(x, 1.0) + jax.nn.softplus(x), ["abs_1"], 0),
    "squared": (lambda x: jnp.maximum(0, x) ** 2, ["max_1"], 1),
    "inside a function": (lambda x: jnp.exp(-jnp.abs(x)) / (1 + jax.nn.relu(x - 1)), ["abs_1", "max_2"], 2),
}


def with_derivatives(points, *functions):
    """Of two functions, value beside value and derivative beside derivative, at all points."""
    both = jax.jit(jax.vmap(lambda x: [(fn(x), jax.jacfwd(fn)(x)) for fn in functions]))
    return zip(*both(points))


@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize("law", LAWS)
def test_values(law, shape):
    """On every side the field is what it was, and so is its derivative; affine in the values of the switches."""
    fn, expected, bent = LAWS[law]
    system = mark_kinks(Written(fn), np.full(shape, 0.7))
    assert names(system) == [f"{n}{e}" for n in expected for e in (["_0", "_1"] if shape else [""])]
    assert len(system.bent) == bent * (2 if shape else 1)
    points = jnp.asarray(np.random.default_rng(0).uniform(-3, 3, (100, *shape)))
    for got, want in with_derivatives(points, functools.partial(in_its_region, system), fn):
        np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-13)

    n = len(system.switches)
    values = np.full((3, n, n), 0.4)  # at -1, 1/2, 1 of each switch
    values[:, range(n), range(n)] = np.array([[-1.0], [0.5], [1.0]])
    field = jax.jit(jax.vmap(jax.vmap(lambda s: system.vector_field(0.0, points[0], system.values(tuple(s))))))
    low, middle, high = field(values)
    np.testing.assert_allclose(middle, 0.25 * low + 0.75 * high, rtol=1e-13, atol=1e-15)


class Plain(nsjax.System):
    """`gallery.HopfPitchfork`, as one writes it."""

    mu: float = -1.0

    def vector_field(self, t, y, s):
        at_x1 = jnp.abs(y.x1 + self.mu) - jnp.abs(y.x1 - self.mu)
        return gallery.Plane(y.x2, -y.x1 + at_x1 - y.x2 - abs(y.x2 + self.mu) + abs(y.x2 - self.mu))


ORIGIN = gallery.Plane(0.0, 0.0)


@pytest.mark.slow
def test_section_5_7():
    """The generalized Jacobian of the gallery's text, and where its eigenvalues cross (5.36)."""
    sides = []
    for mu in (-1.0, 0.0, 1.0):
        found = nsjax.setvalued.generalized_jacobian(mark_kinks(Plain(mu), ORIGIN), ORIGIN, parameter="mu")
        known = nsjax.setvalued.generalized_jacobian(gallery.HopfPitchfork(mu), ORIGIN, parameter="mu")
        order = dict(zip(("left", "right", "below", "above"), ("abs_1", "abs_2", "abs_3", "abs_4")))
        assert found.surfaces == tuple(order[name] for name in known.surfaces)
        np.testing.assert_array_equal(found.vertices, known.vertices)
        np.testing.assert_array_equal(found.by_parameter, known.by_parameter)
        sides.append(found.vertices)
    np.testing.assert_allclose(
        [c.q for c in nsjax.setvalued.eigenvalue_crossings(sides[0], sides[2])], [0.25, 0.75], atol=1e-14
    )


def test_smoothed():
    """(5.40), and (5.15), in which |μ/2| is raised."""
    points = jnp.asarray(np.random.default_rng(1).uniform(-2, 2, (50, 3)))

    def ours(p):
        system = nsjax.smoothed(mark_kinks(Plain(p[2]), ORIGIN), 10.0)
        return jnp.stack(system.vector_field(0.0, gallery.Plane(p[0], p[1]), system.values(())))

    def theirs(p):
        system = gallery.SmoothHopfPitchfork(p[2], 10.0)
        return jnp.stack(system.vector_field(0.0, gallery.Plane(p[0], p[1]), system.values(())))

    for a, b in with_derivatives(points, ours, theirs):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)

    class Transcritical(nsjax.System):
        mu: Array

        def vector_field(self, t, y, s):
            return gallery.Line(jnp.abs(self.mu / 2) - jnp.abs(y.x - self.mu / 2))

    def raised(p):
        marked = mark_kinks(Transcritical(p[2]), gallery.Line(0.0))
        system = nsjax.smoothed(marked, 10.0, offset={"abs_1": 1.0})
        return system.vector_field(0.0, gallery.Line(p[0]), system.values(())).x

    def known(p):
        system = gallery.ImperfectTranscritical(p[2], 10.0)
        return system.vector_field(0.0, gallery.Line(p[0]), system.values(())).x

    points = jnp.concatenate([points, jnp.zeros((1, 3))])
    for a, b in with_derivatives(points, raised, known):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


class Support(nsjax.System):
    """A forced mass on a spring, with a stiff support to the right of x_w and a damper that acts when it moves left."""

    k: float = 4.0
    x_w: float = 0.5

    def vector_field(self, t, y, s):
        force = jnp.cos(t) - y.x - self.k * jnp.maximum(y.x - self.x_w, 0.0) - 0.2 * jnp.minimum(y.v, 0.0)
        return Motion(y.v, force)

    @property
    def period(self):
        return 2 * jnp.pi


Y0 = Motion(1.0, 0.0)


@functools.cache
def reference():
    """The plain field, by scipy, in steps as small as kinks demand."""

    def field(t, y):
        return [y[1], np.cos(t) - y[0] - 4 * max(y[0] - 0.5, 0) - 0.2 * min(y[1], 0)]

    plain = solve_ivp(field, (0, 20), Y0, method="DOP853", rtol=1e-12, atol=1e-12)
    return plain.y[:, -1], len(plain.t) - 1


@pytest.mark.parametrize("solver", [dfx.Dopri8(), pytest.param(nsjax.Taylor(), marks=pytest.mark.slow)])
def test_solve(solver):
    """The event-driven solution is that of the plain field, in fewer steps, with the kinks among its events."""
    system = mark_kinks(Support(), Y0)
    assert names(system) == ["max_1", "min_2"] and system.period == Support().period
    sol = solve(system, 0.0, 20.0, Y0, solver=solver, stepsize_controller=pid(1e-12))
    end, steps = reference()
    np.testing.assert_allclose(flat(sol.y1), end, atol=1e-10)
    assert int(sol.stats["num_steps"]) < 0.6 * steps
    assert {e.switch for e in sol.events} == {"max_1", "min_2"} and len(sol.events) >= 12
    for e in sol.events:
        np.testing.assert_allclose(e.y_before.x - 0.5 if e.switch == "max_1" else e.y_before.v, 0, atol=1e-12)
        assert e.mode_before[e.switch] == -e.mode_after[e.switch]


def test_derivatives_by_a_parameter():
    """Under `jit`, `vmap` and `jacfwd`, marked outside of them or inside."""
    system = mark_kinks(Support(), Y0)

    @jax.jit
    def both(k, x_w):
        def outside(k):
            model = eqx.tree_at(lambda m: (m.system.k, m.system.x_w), system, (k, x_w))
            return jnp.stack(model.vector_field(0.3, Y0, model.values((1.0, -1.0))))

        def inside(k):
            model = mark_kinks(Support(k, x_w), Y0)
            return jnp.stack(model.vector_field(0.3, Y0, model.values((1.0, -1.0))))

        return [(f(k), jax.jacfwd(f)(k)) for f in (outside, inside)]

    for value, slope in jax.vmap(both)(jnp.array([4.0, 3.0]), jnp.array([0.5, -0.5])):
        np.testing.assert_allclose(value[:, 1], np.cos(0.3) - 1 - np.array([4, 3]) * [0.5, 1.5])
        np.testing.assert_allclose(slope, [[0, -0.5], [0, -1.5]])


@pytest.mark.slow
def test_derivatives_of_the_flow():
    system = mark_kinks(Support(), Y0)

    @jax.jit
    def end(k):
        model = eqx.tree_at(lambda m: m.system.k, system, k)
        return jnp.stack(solve(model, 0.0, 10.0, Y0, stepsize_controller=pid(1e-11)).y1)

    value, slope = jax.vmap(lambda k: jax.jvp(end, (k,), (1.0,)))(jnp.array([4.0, 4.0 + 1e-5, 4.0 - 1e-5]))
    np.testing.assert_allclose(slope[0], (value[1] - value[2]) / 2e-5, atol=1e-6)


class Wet(nsjax.System):
    """Dry friction and a drag |v| v, with an end stop."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.3 * s.rub - jnp.abs(y.v) * y.v + s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return y.x + 0.1

    @wall.restitution
    def wall(self):
        return 0.5

    @nsjax.sgn
    def rub(self, t, y):
        return y.v


def test_own_switches_remain():
    """First, in their order, with all their functions."""
    system = mark_kinks(Wet(), Y0)
    assert [repr(k) for k in system.switches] == ["impact(wall)", "sgn(rub)", "sgn(abs_1)"]
    assert system.switches == mark_kinks(Wet(), Y0).switches  # no program is compiled again
    assert system.switches[0].restitution_fn(system) == 0.5


@pytest.mark.slow
def test_beside_friction_and_impacts():
    """It sticks and bounces as it did, though the kink is on the surface of the friction."""
    y0 = Motion(2.0, -3.0)
    system = mark_kinks(Wet(), y0)
    ours, plain = (solve(m, 0.0, 20.0, y0, stepsize_controller=pid(1e-11)) for m in (system, Wet()))
    np.testing.assert_allclose(flat(ours.y1), flat(plain.y1), atol=1e-9)
    assert {e.switch for e in ours.events} == {"wall", "rub", "abs_1"}


class Named(nsjax.System):
    def vector_field(self, t, y, s):
        return jnp.abs(y) + s.abs_1 * y

    @property
    def switches(self):
        return (ABS,)


ABS = nsjax.sgn(lambda self, t, y: y, name="abs_1")


def test_names_do_not_clash():
    assert names(mark_kinks(Named(), 0.5)) == ["abs_1", "abs_1_"]


class Nodes(NamedTuple):
    x: Array
    r: Array


class Contacts(nsjax.System):
    """Masses between walls of their own, that push each other where they touch."""

    gap: Array

    def vector_field(self, t, y, s):
        push = jnp.maximum(y.x[:-1] - y.x[1:] + self.gap, 0)
        return Nodes(-y.x + jnp.append(0.0, push) - jnp.append(push, 0.0), jnp.abs(y.r))


def test_arrays():
    """A switch for each entry."""
    system = mark_kinks(Contacts(jnp.full(2, 0.5)), Nodes(jnp.zeros(3), 1.0))
    assert names(system) == ["max_1_0", "max_1_1", "abs_2"]
    y = Nodes(jnp.array([0.3, 1.0, 0.1]), jnp.array(-2.0))
    heights = [k.guard(system, 0.0, y) for k in system.switches]
    np.testing.assert_allclose(heights, [-0.2, 1.4, -2])
    got, want = in_its_region(system, y), system.system.vector_field(0.0, y, None)
    np.testing.assert_allclose(got.x, want.x, rtol=1e-14)
    assert got.r == want.r
    with pytest.raises(ValueError, match="`Contacts.vector_field` has other kinks here than where"):
        system.vector_field(0.0, Nodes(jnp.zeros(3), jnp.ones(2)), system.values((1.0,) * 3))


@pytest.mark.slow
def test_single_precision():
    system = mark_kinks(Support(), Motion(jnp.float32(1.0), jnp.float32(0.0)))
    sol = solve(system, 0.0, 5.0, Motion(jnp.float32(1.0), jnp.float32(0.0)), solver=dfx.Heun())
    assert sol.y1.x.dtype == jnp.float32 and len(sol.events) > 1


class Valve(nsjax.System):
    def vector_field(self, t, y, s):
        return Heat(jnp.abs(y.T - s.heater))

    @nsjax.relay
    def heater(self, t, y):
        return 1 - y.T

    @heater.off
    def heater(self, t, y):
        return y.T - 2


def looped(x):
    return lax.fori_loop(0, 3, lambda i, x: jnp.abs(x) - 1, x)


def branched(x):
    return lax.cond(x > 0, jnp.abs, lambda x: x, x)


MISTAKES = [
    (Written(jnp.sin), 0.5, ValueError, "must have a kink to be marked, but `Written.vector_field` has no abs"),
    (Written(jnp.sign), 0.5, ValueError, "must have a kink to be marked"),
    (Written(looped), 0.5, ValueError, "inside `(scan|while)` cannot be marked"),
    (Written(jax.jit(branched)), 0.5, ValueError, "inside `cond` cannot be marked"),
    (
        Written(lambda x: jnp.exp(-jnp.abs(x))),
        np.ones(5),
        ValueError,
        "affine in all but 4 of its kinks, .* abs_1_0, abs_1_1",
    ),
    (Valve(), Heat(1.0), ValueError, "`Valve.vector_field` has a kink that depends on `s.heater`"),
    (Support, Motion(1.0, 0.0), TypeError, "Argument `system` must be an instance.*Call it"),
    (Support(), Motion(True, 0.5), TypeError, "Argument `y0` must hold floating point numbers"),
]


@pytest.mark.parametrize("system, y0, kind, words", MISTAKES)
def test_mistakes(system, y0, kind, words):
    with pytest.raises(kind, match=words):
        mark_kinks(system, y0)


def test_loops_without_kinks():
    """What has no kink is left as it is, integers inside it included."""

    def fn(x):
        y = lax.fori_loop(0, 3, lambda i, x: x / 2 + jnp.maximum(i, 1), x)
        return jnp.abs(y) + lax.cond(x > 0, jnp.sin, jnp.cos, x)

    system = mark_kinks(Written(fn), 0.5)
    assert names(system) == ["abs_1"]
    for x in (-9.0, 0.3):
        np.testing.assert_allclose(in_its_region(system, jnp.asarray(x)), fn(x), rtol=1e-14)
