"""Smoothing and the switch model against the event-driven solution: what they leave of it, and at what error."""

import functools
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jaxtyping import Array
from models import Bumper, flat, Motion, Pair, pid, Plane, Point, Puck

import nsjax
from nsjax import banded, gallery, smoothed, solve
from nsjax.regularise._regularise import Banded


STIFF = dfx.Kvaerno5()
METHODS = {
    "arctan": functools.partial(smoothed, kind="arctan"),
    "tanh": functools.partial(smoothed, kind="tanh"),
    "linear": functools.partial(smoothed, kind="linear"),
    "banded": lambda system, eps, rate=1.0: banded(system, 1 / eps, rate),
}


def run(system, y0, t1, tol=1e-9, **kwargs):
    """A regularised system needs many steps; it is stiff if smoothed."""
    solver = dfx.Tsit5() if isinstance(system, Banded) else STIFF
    return solve(system, 0.0, t1, y0, solver=solver, stepsize_controller=pid(tol), max_steps=100_000, **kwargs)


@functools.cache
def exact(key, t1, **parameters):
    entry = gallery.entry(key)
    return solve(entry.system(**parameters), 0.0, t1, entry.y0, stepsize_controller=pid(1e-12)).y1


def error(sol, end):
    return np.abs(flat(sol.y1) - flat(end)).reshape(-1, flat(end).size).max(-1)


SLOW = pytest.mark.slow


STIFFNESS = 10.0 ** np.arange(3, 7)


@functools.cache
def falling(name):
    """Section 2.4 with each stiffness, at tolerances that do not show beside it; and once more with the first one at a
    looser tolerance. (Not at 1e-7, where the errors of the steps make a twentieth.)"""
    entry = gallery.entry("2.4")
    lanes = jnp.asarray([*STIFFNESS, STIFFNESS[0]]), jnp.asarray([1e-10, 1e-9, 1e-10, 1e-11, 1e-8])
    sol = jax.vmap(lambda e, tol: run(METHODS[name](entry.system(), e), entry.y0, 30.0, tol))(*lanes)
    return error(sol, exact("2.4", 30.0)), np.asarray(sol.stats["num_steps"])


@pytest.mark.parametrize(
    "name, order",
    [
        pytest.param("arctan", 0.6, marks=SLOW),
        pytest.param("tanh", 0.9, marks=SLOW),
        pytest.param("linear", 1, marks=SLOW),
        ("banded", 1),
    ],
)
def test_order_on_falling_friction(name, order):
    """Section 2.4. First order, but for the tails of the arctangent: where a stick ends with h ~ t² they pull the
    solution off a time of order ε^(-1/3) too early, which makes the order 2/3."""
    slope, _ = np.polyfit(np.log(STIFFNESS), np.log(falling(name)[0][:4]), 1)
    assert abs(-slope - order) < 0.06


@pytest.mark.parametrize("name", ["linear", "banded"])
def test_error_does_not_depend_on_the_tolerance(name):
    errors, steps = falling(name)
    assert errors[0] > 1e-3 and abs(errors[4] / errors[0] - 1) < 0.01
    assert steps[0] > 1.5 * steps[4]


def test_static_friction_point():
    """Section 3.4, b = 2. The error is what the stick drifts while it is pulled to the middle, η / rate."""
    entry, t1 = gallery.entry("3.4"), 40.0
    grid = [jnp.array(x) for x in ([1e3, 1e4, 1e5, 1e5], [1.0, 1.0, 1.0, 10.0])]
    sol = jax.vmap(lambda e, r: run(banded(entry.system(), 1 / e, r), entry.y0, t1, 1e-10))(*grid)
    errors = error(sol, Motion(*reference.floats(reference.simulate(reference.StickSlip(), t1, entry.y0).y)))
    np.testing.assert_allclose(errors / errors[2], [100, 10, 1, 0.1], rtol=0.05)
    assert max(sol.stats["num_steps"]) < 1000  # as many whatever η


def test_values_of_the_switch_model():
    """Slip outside the band; in it stick, with dh/dt = -rate h, or the slip value in the direction of the force."""
    system = banded(gallery.StickSlip(c=0.3), 1e-2, 7.0)  # λ = -(x + c v), b = 2, belt at v = 0.2

    @jax.jit
    def value(x, v):
        y = Motion(x, v)
        return system.put(jnp.zeros(()), y, system.values(()))["belt"], system.vector_field(0.0, y, system.values(())).v

    table = [(0.0, 0.22, 1), (0.0, 0.18, -1), (5.0, 0.22, 1), (-2.2, 0.195, 1), (2.2, 0.205, -1)]
    for x, v, s in table:
        assert value(x, v)[0] == s
    for x, v in ((1.5, 0.205), (-1.5, 0.205), (0.3, 0.191)):
        np.testing.assert_allclose(value(x, v)[1], -7 * (v - 0.2), rtol=1e-12)

    # Both are beyond their bound; λ = (2, 1.2) until the first is released, (11/3, 10/3) and then (1, 2).
    @jax.jit
    def both(t, g):
        pair = banded(Pair(w=1.0, g=g, c=-1.0), 1e-2)
        s = pair.put(t, Plane(0.0, 0.0), pair.values(()))
        return s["a"], s["b"]

    for t, g, expected in ((2.8, 0.4, [1, 0.7]), (4.0, 3.0, [1, 1])):
        np.testing.assert_allclose(both(t, g), expected, rtol=1e-12)


@pytest.mark.parametrize("key", ["example 2.3", "example 2.5", "3.5", "1.1(1)"])
def test_surfaces_without_a_band(key):
    """One that repels is left to the side on which it is, one on which the value does not act is crossed; at the tip of
    the support, where ∂h'/∂s vanishes, nothing is infinite, nor are derivatives."""
    plain = gallery.thesis(key)
    system, (k,) = banded(plain, 0.5), plain.switches
    none = system.values(())

    @jax.jit
    @jax.vmap
    def look(y):
        field = functools.partial(system.vector_field, jnp.zeros(()), s=none)
        h = functools.reduce(jnp.minimum, k.components(plain, jnp.zeros(()), y))
        return h, system.put(jnp.zeros(()), y, none)[k.name], (jax.jacfwd(field)(y), jax.jacrev(field)(y))

    h, value, derivatives = look(jax.tree.map(lambda x: jnp.array([x, 0.0, 1e-3, -1e-3]), gallery.entry(key).y0))
    assert key == "3.5" or (value == jnp.where(h >= 0, 1, -1)).all()
    assert (abs(value) <= 1).all() and all(np.isfinite(x).all() for x in jax.tree.leaves(derivatives))


class Plates(nsjax.System):
    """A stack of plates on a floor, with springs to the wall and friction between neighbours; the top one is forced."""

    F: Array  # friction forces
    b: float = 1.0
    f_0: float = 2.0
    omega: float = 0.4

    def vector_field(self, t, y, s):
        friction = self.F * jnp.stack([s[k.name] for k in self.switches])
        force = -y.x - friction + jnp.append(friction[1:], self.f_0 * jnp.cos(self.omega * t))
        return Motion(y.v, force)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    @property
    def switches(self):
        return _interfaces(self.F.size)


@functools.cache
def _interfaces(n):
    def interface(i):
        switch = nsjax.sgn(lambda self, t, y: y.v[i] - (y.v[i - 1] if i else 0.0), name=f"f{i}")
        return switch.breakaway(lambda self: self.b)

    return tuple(interface(i) for i in range(n))


@pytest.mark.slow
@pytest.mark.parametrize("name, b", [pytest.param("banded", 1.4, marks=SLOW), ("linear", 1.0)])
def test_several_switches(name, b):
    """Three coupled interfaces, forced: they stick alone and in pairs, and a release changes the others' multipliers."""
    plates = Plates(jnp.array([0.4, 0.6, 0.8]), b)
    y0 = Motion(jnp.array([0.5, -0.2, 1.0]), jnp.zeros(3))
    truth = solve(plates, 0.0, 20.0, y0, stepsize_controller=pid(1e-12))
    held = {tuple(e.mode_after[f"f{i}"] == 0 for i in range(3)) for e in truth.events}
    assert len(held) >= 5
    assert METHODS[name](plates, 1e3).period == plates.period

    sol = jax.vmap(lambda e: run(METHODS[name](plates, e), y0, 20.0, 1e-8))(jnp.array([1e3, 1e4, 1e5]))
    errors = np.abs(np.concatenate([np.asarray(sol.y1.x - truth.y1.x), np.asarray(sol.y1.v - truth.y1.v)], 1)).max(1)
    assert errors[0] < 5e-3 and all(errors[1:] < 0.2 * errors[:-1])


class Skid(NamedTuple):
    x: Array
    v: Array
    u: Array


class Table(nsjax.System):
    """A puck dropped on a table: it bounces, rests, and the friction of the contact force stops it sliding."""

    mu: float = 0.3
    e: float = 0.3

    def vector_field(self, t, y, s):
        return Skid(y.v, s.floor - 1.0, 0.2 * jnp.sin(t) - self.mu * s.floor * s.slide)

    @nsjax.sgn
    def slide(self, t, y):
        return y.u

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @floor.restitution
    def floor(self):
        return self.e


@pytest.mark.slow
@pytest.mark.parametrize("name, bound", [("banded", 1e-7), ("linear", 1e-3)])
def test_contact_beside_friction(name, bound):
    """Impacts, their accumulation and the resting contact remain events; friction is none any more."""
    y0 = Skid(0.5, 0.0, 1.0)
    truth = solve(Table(), 0.0, 12.0, y0, stepsize_controller=pid(1e-12))
    sol = run(METHODS[name](Table(), 1e4), y0, 12.0)
    assert error(sol, truth.y1) < bound
    contact = [e for e in truth.events if e.switch == "floor"]
    assert len(truth.events) > len(contact) == len(sol.events) > 10
    for ours, theirs in zip(sol.events, contact):
        np.testing.assert_allclose(ours.t, theirs.t, atol=1e-8)
        assert ours.mode_after == {"floor": theirs.mode_after["floor"]}


def test_relays_and_impacts_remain():
    """In their order, with all their functions, wherever they stand among the others."""
    system, y = Bumper(order=(2, 0, 3, 4, 1)), Puck(0.3, 2.0, 0.0)
    for outer in (smoothed(system, 1e3), banded(system, 1e-3)):
        ours, theirs = outer.switches, [system.switches[i] for i in (1, 2, 4)]
        assert [repr(k) for k in ours] == ["impact(left)", "relay(motor)", "impact(right)"]
        assert outer.switches == ours  # a program is not compiled again for switches that are the same
        for k, inner in zip(ours, theirs):
            assert k.guard(outer, 0.0, y) == inner.guard(system, 0.0, y)
        assert ours[0].restitution_fn(outer) == system.e and ours[0].reset_fn is None
        assert ours[1].off_guard(outer, 0.0, y) == theirs[1].off_guard(system, 0.0, y)
        s = outer.values(tuple(jnp.array(x) for x in (0.5, 1.0, 0.25)))
        np.testing.assert_allclose(outer.vector_field(jnp.zeros(()), y, s), [2.0, -0.1 + 0.25, 1.0], atol=1e-4)


def test_derivatives():
    """Those of a smoothed system converge to those of the event-driven flow, which jump; those of a banded one are
    finite."""
    y0, t1 = gallery.entry("2.4").y0, 10.0

    def derivative(make, tol):
        return jax.jacfwd(lambda v: jnp.stack(run(make(gallery.FallingStickSlip(v_dr=v)), y0, t1, tol).y1))(0.2)

    ends = [flat(exact("2.4", t1, v_dr=0.2 + d)) for d in (1e-4, -1e-4)]
    truth = (ends[0] - ends[1]) / 2e-4
    errors = np.abs(jax.vmap(lambda e: derivative(lambda s: smoothed(s, e), 1e-9))(jnp.array([1e3, 1e5])) - truth)
    assert errors[0].max() < 0.2 and errors[1].max() < 2e-3
    assert np.isfinite(derivative(lambda s: banded(s, 1e-4), 1e-8)).all()


@pytest.mark.slow
@pytest.mark.parametrize("key", gallery.THESIS)
@pytest.mark.parametrize("name", ["linear", "banded"])
def test_gallery(key, name):
    """Every system in the forms that it can have. (Where it repels no solution is expected to be followed for long.)"""
    entry = gallery.entry(key)
    system = entry.system()
    t1 = min(20.0, entry.t1)
    kinds = [isinstance(k, nsjax.sgn) for k in system.switches]
    static = any(k.bound(system) > 1 for k in system.switches if isinstance(k, nsjax.sgn))
    if not any(kinds) or (static and name == "linear"):
        with pytest.raises(ValueError, match="Argument `system` must"):
            METHODS[name](system, 1e4)
        return
    sol = run(METHODS[name](system, 1e5), entry.y0, t1, 1e-8)
    assert error(sol, exact(key, t1)) < 1e-3


def test_single_precision():
    y0 = Motion(jnp.float32(1.1), jnp.float32(0.0))
    sol = run(banded(gallery.FallingStickSlip(), 1e-3), y0, 10.0, 1e-5)
    assert sol.y1.x.dtype == jnp.float32 and error(sol, exact("2.4", 10.0)) < 2e-2


def test_it_prints_its_numbers():
    assert repr(banded(gallery.StickSlip(c=0.5), 1e-6)) == "Banded(system=StickSlip(c=0.5), eta=1e-06, rate=1.0)"
    assert "eps=1000.0, kind='tanh'" in repr(smoothed(gallery.FallingStickSlip(), 1000, "tanh"))


LOPSIDED = {
    "(5.15)": (gallery.DiscontinuousTranscritical, gallery.ImperfectTranscritical, "parameter"),
    "(5.23)": (gallery.DiscontinuousPitchfork, gallery.ImperfectPitchfork, "left"),
}
KINKS = np.array([[0.3, -0.7], [0, 0], [0.5, 1], [-0.5, 1], [0.5, 1 - 1e-12], [-1e-9, 2e-9], [0, 1e-200], [2, -3]])


def derivatives(field):
    """Values with first and second derivatives, for many points."""
    return jax.jit(jax.vmap(lambda p: (field(p), jax.jacfwd(field)(p), jax.jacfwd(jax.jacfwd(field))(p))))


@pytest.mark.parametrize("key", LOPSIDED)
def test_offset(key):
    """Smoothed lopsidedly, a kink whose surface a parameter alone decides as well; on the surface and beside it."""
    model, truth, name = LOPSIDED[key]

    def ours(p):
        system = smoothed(model(p[1]), p[2], offset={name: p[3]})
        return system.vector_field(0.0, gallery.Line(p[0]), system.values(())).x

    def theirs(p):
        system = truth(p[1], p[2])
        return system.vector_field(0.0, gallery.Line(p[0]), system.values(())).x + (p[3] - 1) / p[2]

    points = jnp.array([[x, mu, eps, c] for x, mu in KINKS for eps, c in ((10.0, 1.0), (1e3, -2.0))])
    for have, want in zip(derivatives(ours)(points), derivatives(theirs)(points)):
        np.testing.assert_allclose(have, want, rtol=1e-12, atol=1e-14)


class Bend(nsjax.System):
    """A field with a kink on a circle, x' = y + |h| (exp(x) + r y²) and, written as two laws, y' = 2 - |h| cos(3t + y);
    `raised`: as it is with |h| smoothed and raised by 0.7/ε, ε = 10."""

    r: float = 1.0
    raised: bool = False

    def vector_field(self, t, y, s):
        h = y.x**2 + y.y**2 - self.r
        up, down = jnp.exp(y.x) + self.r * y.y**2, -jnp.cos(3 * t + y.y)
        if self.raised:
            size = 2 / jnp.pi * jnp.arctan(10 * h) * h + 0.07
            return Plane(y.y + size * up, 2 + size * down)
        laws = 0.5 * (1 + s.circle) * (2 + down * h) + 0.5 * (1 - s.circle) * (2 - down * h)
        return Plane(y.y + s.circle * h * up, laws)

    @nsjax.sgn
    def circle(self, t, y):
        return y.x**2 + y.y**2 - self.r


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype, bounds", [(jnp.float64, (1e-14, 1e-12, 1e-9)), pytest.param(jnp.float32, (1e-5, 1e-4, 1e-3), marks=SLOW)]
)
def test_offset_of_a_curved_surface(dtype, bounds):
    """What multiplies |h| varies, off the surface too, and at any distance its derivatives are right. (Far off they are
    those of a quotient, of which rounding takes a part 1/h².)"""

    def field(raised, p):
        system = Bend(p[2], raised) if raised else smoothed(Bend(p[2]), 10.0, offset={"circle": 0.7})
        return jnp.stack(system.vector_field(p[3], Plane(p[0], p[1]), system.values(())))

    off = np.array([0, *10.0 ** np.arange(-17, 1), -1e-15, -1e-5, -0.3])
    points = np.stack([np.cos(0.7) * (1 + off), np.sin(0.7) * (1 + off), 0 * off + 1, 0 * off + 0.4], -1)
    have, want = (derivatives(functools.partial(field, raised))(jnp.asarray(points, dtype)) for raised in (False, True))
    for a, b, bound in zip(have, want, bounds):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=bound, atol=10 * bound)


def test_offset_costs_nothing_unless_given():
    def program(**kwargs):
        system = smoothed(gallery.DiscontinuousTranscritical(), 10.0, **kwargs)
        return str(jax.make_jaxpr(lambda y: system.vector_field(0.0, y, system.values(())))(gallery.Line(0.3)))

    assert program() == program(offset=None) == program(offset={})


def test_offset_loses_the_bifurcation():
    """Two fixed points for every μ, where they met: μ/2 ± about √(π/2)/ε (5.16)."""
    for mu in (-1e-3, 0.0, 1e-3):
        system = smoothed(gallery.DiscontinuousTranscritical(mu), 10.0, offset={"parameter": 1.0})
        upper, lower = (nsjax.find_equilibrium(system, gallery.Line(x)) for x in (0.2, -0.2))
        np.testing.assert_allclose(upper.y.x + lower.y.x, mu, atol=1e-12)
        assert upper.y.x - mu / 2 > 0.1


class Drag(nsjax.System):
    """Friction that falls with speed: the field jumps."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.belt / (1 + (y.v - 0.2) ** 2))

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - 0.2


@pytest.mark.parametrize("v", [0.2, 0.2 + 1e-9, 0.23])
def test_offset_where_the_field_jumps(v):
    system = smoothed(Drag(), 10.0, offset={"belt": 1.0})
    with pytest.raises(RuntimeError, match="`Drag.vector_field` jumps on that of `belt`"):
        system.vector_field(0.0, Motion(1.0, v), system.values(()))


class Squared(nsjax.System):
    def vector_field(self, t, y, s):
        return Point(-s.side - s.side**2)

    @nsjax.sgn
    def side(self, t, y):
        return y.x


STICK_SLIP, FALLING = gallery.StickSlip(), gallery.FallingStickSlip()
MISTAKES = [
    (lambda: smoothed(FALLING, 0.0), ValueError, "Argument `eps` must be positive, but got 0.0"),
    (lambda: banded(FALLING, float("nan")), ValueError, "Argument `eta` must be positive, but got nan"),
    (lambda: banded(FALLING, 1e-6, -1), ValueError, "Argument `rate` must be positive, but got -1"),
    (lambda: smoothed(FALLING, "tanh"), TypeError, "Argument `eps` must be a positive number, but got 'tanh'"),
    (lambda: smoothed(FALLING, np.ones(2)), ValueError, "`eps` must be a scalar.*use `jax.vmap`"),
    (lambda: smoothed(FALLING, 1e3, "erf"), ValueError, "one of 'arctan', 'tanh', 'linear', but got 'erf'"),
    (
        lambda: smoothed(FALLING, 1e3, offset={"wall": 1.0}),
        ValueError,
        "must name `sgn` switches.*`belt`, but got `wall`",
    ),
    (
        lambda: smoothed(FALLING, 1e3, offset={"belt": "1"}),
        TypeError,
        r"`offset\['belt'\]` must be a number, but got '1'",
    ),
    (lambda: banded(gallery.StickSlip, 1e-6), TypeError, "Argument `system` must be an instance.*Call it"),
    (lambda: banded(gallery.BouncingBall(), 1e-6), ValueError, "`BouncingBall` has only `floor`"),
    (lambda: smoothed(gallery.SmoothBlock(), 1e3), ValueError, "must have a `sgn` switch.*has no switch"),
    (lambda: smoothed(STICK_SLIP, 1e3), ValueError, "`StickSlip.belt.breakaway` is greater than 1.*`nsjax.banded`"),
    (lambda: solve(banded(Squared(), 1e-6), 0.0, 1.0, Point(1.0)), ValueError, "`Squared.* must be affine in `s.side`"),
]


@pytest.mark.parametrize("mistake, kind, words", MISTAKES)
def test_mistakes(mistake, kind, words):
    with pytest.raises(kind, match=words):
        mistake()


def test_mistakes_found_at_run_time():
    field = eqx.filter_jit(lambda eps, F: smoothed(gallery.StickSlip(F_stick=F), eps).eps)
    assert field(jnp.array(2.0), jnp.array(1.0)) == 2
    with pytest.raises(RuntimeError, match="`eps` must be positive"):
        field(jnp.array(-2.0), jnp.array(1.0))
    with pytest.raises(RuntimeError, match="must have no static friction point"):
        field(jnp.array(2.0), jnp.array(1.5))


def test_a_static_friction_point_of_one_is_none():
    """Parameters may make the breakaway bound 1, of a model that declares one."""
    assert smoothed(gallery.StickSlip(F_stick=1.0), 1e3).switches == ()
