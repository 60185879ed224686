"""The flow of affine models from event to event."""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import test_fuzz
from exact import Shape
from jaxtyping import Array
from models import flat, itinerary, Motion, times
from programs import count
from trajectory import share, told_but_ambiguous

import nsjax
from nsjax import Affine, Exponential, gallery, RESULTS, solve
from nsjax.flow.affine import _exact


SHAPES = {
    "friction": Shape(2, 1, 0, 0, forced=True, moving=True),
    "bounce": Shape(2, 0, 0, 1, forced=True, moving=True),
    "three states": Shape(3, 1, 0, 0, forced=False, moving=False),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_random_systems(name, monkeypatch):
    """Against exact solutions; with derivatives where that is compiled soon."""
    monkeypatch.setitem(test_fuzz.SHAPES, name, (SHAPES[name], Affine()))
    tally, wrong = test_fuzz.fuzz(name, 120, 3, derive=name == "friction")
    assert not wrong
    assert share(tally, "sensitive") <= 0.02
    assert told_but_ambiguous(tally) == 0 and share(tally, "needlessly told") <= 0.1


class Linear(nsjax.System):
    """y' = A y + b + a cos ωt."""

    A: Array
    b: Array
    a: Array
    w: float = 1.0

    def vector_field(self, t, y, s):
        return self.A @ y + self.b + self.a * jnp.cos(self.w * t)


def linear(A, b=0, a=0, w=1.0):
    """Of three states, so that all are one program: what comes after those of A stands still. Forces act on A's last."""
    n = len(A)
    matrix, forces = np.zeros((3, 3)), np.zeros((2, 3))
    matrix[:n, :n], forces[:, n - 1] = A, (b, a)
    return Linear(matrix, *forces, np.asarray(w))


SOLUTIONS = {
    # model, and x(t) from rest at 0
    "nilpotent": (linear([[0.0, 1.0], [0.0, 0.0]], b=1.0), lambda t: t**2 / 2),
    "harmonic": (linear([[0.0, 1.0], [0.0, 0.0]], a=1.0, w=2.0), lambda t: (1 - np.cos(2 * t)) / 4),
    "resonance": (linear([[0.0, 1.0], [-1.0, 0.0]], a=1.0), lambda t: t * np.sin(t) / 2),
    "defective": (linear([[0.0, 1.0], [-1.0, -2.0]], b=1.0), lambda t: 1 - (1 + t) * np.exp(-t)),
}


TS = np.array([0.0, 1.3, 3.0])


@jax.jit
def watched(system, t1, ts, y0):
    return solve(system, 0.0, t1, y0, solver=Affine(), saveat=dfx.SaveAt(ts=ts, dense=True))


@pytest.mark.parametrize(
    "name, sign",
    [pytest.param(n, s, marks=[pytest.mark.slow] * (s < 0 and n != "harmonic")) for n in SOLUTIONS for s in (1, -1)],
)
def test_against_closed_forms(name, sign):
    """The end, both ways in time, dense output and saved times."""
    system, exact = SOLUTIONS[name]
    span = 40.0 if sign > 0 or name != "defective" else 4.0
    sol = watched(system, sign * span, sign * TS, jnp.zeros(3))
    t = sign * np.linspace(0, span, 401)
    size = abs(exact(t)).max()
    np.testing.assert_allclose(sol.y1[0], exact(sign * span), rtol=0, atol=2e-13 * size)
    np.testing.assert_allclose(jax.vmap(sol.evaluate)(t)[:, 0], exact(t), rtol=0, atol=2e-11 * size)
    np.testing.assert_allclose(sol.ys[:, 0], exact(sol.ts), rtol=0, atol=2e-11 * size)


def test_stiff():
    """A mode that decays within 1e-6 beside a slow one: its steps are those of the general flow."""
    system = linear([[-1e6, 1e6, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    sol = watched(system, 100.0, TS, jnp.array([3.0, 1.0, 0.0]))
    lag = (1e12 * np.cos(100.0) + 1e6 * np.sin(100.0)) / (1e12 + 1)
    np.testing.assert_allclose(sol.y1, [lag, np.cos(100.0), -np.sin(100.0)], atol=1e-11)
    assert sol.stats["num_steps"] < 200


# With events.


def slider(v, y0=Motion(2.5, -0.5), t1=100.0, solver=Affine(), **options):
    return solve(gallery.StickSlip(v_dr=v), 0.0, t1, y0, solver=solver, **options)


V = np.linspace(0.1, 1.0, 40)


@pytest.fixture(scope="module")
def swept():
    return jax.jit(jax.vmap(slider))(V)


def test_stick_slip(swept):
    """A sweep, one step from event to event, against closed forms."""
    np.testing.assert_allclose(jnp.stack(swept.y1, 1), reference.stick_slip_final(V, 100.0), atol=1e-12)
    assert np.all(swept.stats["num_steps"] < 2 * swept.events.num + 20)
    assert np.all(swept.unique) and np.all(swept.result == RESULTS.successful)
    for i in range(0, len(V), 8):
        log = list(jax.tree.map(lambda x, i=i: x[i], swept.events))
        assert len(log) >= 8 and all(abs(event.y_before.v - V[i]) < 1e-12 for event in log)
        changes = [(event.switch, event.mode_before["belt"], event.mode_after["belt"]) for event in log]
        assert changes == ([("belt", -1, 0), ("belt", 0, -1)] * len(changes))[: len(changes)]


@pytest.mark.slow
def test_log_of_stick_slip(swept):
    """Every column, against the general flow."""
    got, want = swept, jax.jit(jax.vmap(lambda v: slider(v, solver=Exponential())))(V)
    assert np.array_equal(got.unique, want.unique)
    for name in ("switch", "mode_before", "mode_after", "num"):
        assert np.array_equal(getattr(got.events, name), getattr(want.events, name))
    for name in ("t", "y_before", "y_after", "transversality"):
        a, b = (flat(getattr(each.events, name)) for each in (got, want))
        finite = np.isfinite(b)
        assert np.array_equal(np.isfinite(a), finite)
        np.testing.assert_allclose(a[finite], b[finite], atol=1e-9 if name == "transversality" else 1e-11)


@pytest.mark.slow
def test_saved_steps_and_backwards():
    """Steps are saved at events, before and after; what runs backwards does what it does in the general flow."""
    sol = slider(0.5, t1=20.0, saveat=dfx.SaveAt(t0=True, t1=True, steps=True))
    t = np.asarray(sol.ts)
    for at in times(sol):
        assert np.sum(t == at) == 2
    path = reference.stick_slip_final
    for time, x in list(zip(t, sol.ys.x))[:12]:
        if time > 0:
            np.testing.assert_allclose(x, path(np.array([0.5]), float(time))[0, 0], atol=1e-12)
    for system, start, back in (
        (gallery.StickSlip(v_dr=0.5), Motion(-1.0, 0.1), -6.0),
        (Ball(), Motion(0.5, 0.6), -3.0),
    ):
        got, want = (solve(system, 0.0, back, start, solver=m, throw=False) for m in (Affine(), Exponential()))
        assert got.result == want.result and itinerary(got) == itinerary(want)
        assert bool(got.unique) == bool(want.unique)
        np.testing.assert_allclose(times(got), times(want), atol=1e-11)
        np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-10)


def end_of_slider(p, **options):
    return jnp.stack(slider(p[2], Motion(p[0], p[1]), **options).y1)


AT = np.array([2.5, -0.5, 0.5])


@pytest.mark.slow
def test_derivatives_of_stick_slip():
    """Through all events, against forty digits."""
    want = reference.solution(reference.StickSlip, 100.0, (2.5, -0.5), wrt=("v_dr",), v_dr=0.5).derivative
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end_of_slider))(AT), np.asarray(want, float), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_of_stick_slip():
    """Against differences of the first ones; and these backwards, by `DirectAdjoint`."""
    end, at = end_of_slider, AT
    second = jax.jit(jax.jacfwd(jax.jacfwd(lambda p: end(p, t1=9.0))))(at)
    short = jax.jit(jax.jacfwd(lambda p: end(p, t1=9.0)))
    for i, e in enumerate(1e-5 * np.eye(3)):
        np.testing.assert_allclose(second[:, :, i], (short(at + e) - short(at - e)) / 2e-5, atol=1e-7)
    pulled = jax.jit(jax.jacrev(lambda p: end(p, t1=9.0, adjoint=dfx.DirectAdjoint())))(at)
    np.testing.assert_allclose(pulled, short(at), atol=1e-12)


class Ball(nsjax.System):
    """A ball on a floor."""

    e: float = 0.7
    g: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g + s.floor)

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @floor.restitution
    def floor(self):
        return self.e


def bounced(p):
    """In closed form, after the first impact."""
    x0, v0, e, g, t = p
    until = (v0 + jnp.sqrt(v0**2 + 2 * g * x0)) / g
    up, rest = e * jnp.sqrt(v0**2 + 2 * g * x0), t - until
    return jnp.stack([up * rest - g * rest**2 / 2, up - g * rest])


@pytest.mark.slow
def test_derivatives_of_an_impact():
    """First and second, by all arguments and the time, against those of the closed form. (Third ones are right too, but
    take minutes to compile.)"""

    def end(p):
        x0, v0, e, g, t = p
        return jnp.stack(solve(Ball(e, g), 0.0, t, Motion(x0, v0), solver=Affine()).y1)

    at = jnp.array([1.0, 0.3, 0.7, 1.1, 2.5])

    def all_of(f):
        slope = jax.jacfwd(f)
        return f(at), slope(at), jax.jacfwd(slope)(at)

    for got, want in zip(jax.jit(lambda: all_of(end))(), all_of(bounced)):
        np.testing.assert_allclose(got, want, atol=1e-12 * np.abs(want).max())


@pytest.mark.slow
def test_bounces_to_rest():
    """Accumulating impacts end at rest, as in the general flow, whose they are once flights are brief."""
    got, want = (
        solve(Ball(0.5), 0.0, 8.0, Motion(1.0, 0.0), solver=m, max_events=80) for m in (Affine(), Exponential())
    )
    assert itinerary(got) == itinerary(want) and int(got.mode1[0]) == 1
    np.testing.assert_allclose(times(got), times(want), atol=1e-12)
    np.testing.assert_allclose(flat(got.y1), 0, atol=1e-12)
    assert got.unique


@pytest.mark.slow
def test_bounds_and_one_bad_lane():
    """Limits are kept to; a lane that fails does so alone."""
    for name in ("max_events", "max_steps"):
        sol = slider(0.5, throw=False, **{name: 4})
        assert sol.result == getattr(RESULTS, f"{name}_reached")
        assert int(sol.events.num if name == "max_events" else sol.stats["num_steps"]) == 4
    v = np.array([0.3, np.nan, 0.5])
    sol = jax.jit(jax.vmap(lambda v: slider(v, throw=False)))(v)
    assert np.array_equal(sol.result == RESULTS.successful, [True, False, True])
    want = reference.stick_slip_final(v[[0, 2]], 100.0)
    np.testing.assert_allclose(jnp.stack(sol.y1, 1)[np.array([0, 2])], want, atol=1e-12)


@pytest.mark.slow
def test_float32():
    v = jnp.float32(0.5)
    sol = slider(v, Motion(jnp.float32(2.5), jnp.float32(-0.5)), jnp.float32(20))
    assert sol.y1.x.dtype == jnp.float32
    np.testing.assert_allclose(flat(sol.y1), reference.stick_slip_final(np.array([0.5]), 20.0)[0], atol=2e-5)


@pytest.mark.slow
def test_many_lanes_together(monkeypatch):
    """As on other devices than a CPU: the number of lanes that go together is no matter for what comes out."""
    v = np.linspace(0.2, 0.9, 300)
    monkeypatch.setattr(_exact, "_IN_CACHE", _exact._IN_MEMORY)
    many = jax.jit(jax.vmap(lambda v: jnp.stack(slider(v, t1=20.0).y1)))(v)
    np.testing.assert_allclose(many, reference.stick_slip_final(v, 20.0), atol=1e-12)


@pytest.mark.slow
def test_lanes_of_lanes():
    """Batches within batches, more lanes than are run at a time, and a batch of directions within one of lanes."""
    v, x = np.linspace(0.2, 0.9, 150), np.array([2.0, 2.5])
    many = jax.jit(
        jax.vmap(jax.vmap(lambda v, x: jnp.stack(slider(v, Motion(x, -0.5), 20.0).y1), (0, None)), (None, 0))
    )
    np.testing.assert_allclose(many(v, x)[1], reference.stick_slip_final(v, 20.0), atol=1e-12)

    def slope(v):
        return jax.jacfwd(lambda v: jnp.stack(slider(v, t1=20.0).y1))(v)

    np.testing.assert_allclose(jax.jit(jax.vmap(slope))(v[:3])[1], jax.jit(slope)(v[1]), atol=1e-12)


class Chain(nsjax.System):
    """Blocks on a belt, tied by springs to their neighbours."""

    n: int

    @property
    def switches(self):
        return tuple(_contact(i) for i in range(self.n))

    def vector_field(self, t, y, s):
        force = jnp.diff(jnp.pad(y.x, 1), 2) - jnp.stack([s[f"belt{i}"] for i in range(self.n)])
        return Motion(y.v, force)


@functools.cache
def _contact(i):
    return nsjax.sgn(lambda self, t, y: y.v[i] - 0.2, name=f"belt{i}")


@pytest.mark.slow
def test_chain_of_blocks():
    """Ten blocks: twenty states, ten switches, whose modes do not fit into the tables that are kept. To t = 9: at 9.4
    and 13.9 one meets its belt tangentially, a period after it has left it, and rounding decides."""
    y0 = Motion(jnp.linspace(-1.3, 1.7, 10) ** 3, jnp.zeros(10))
    got, want = (solve(Chain(10), 0.0, 9.0, y0, solver=m) for m in (Affine(), Exponential()))
    assert itinerary(got) == itinerary(want) and len(itinerary(got)) > 10
    np.testing.assert_allclose(times(got), times(want), atol=1e-11)
    np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-11)


class Pulled(nsjax.System):
    """A block on a belt, and by a spring another one in front of a wall."""

    v_dr: float = 0.3

    def vector_field(self, t, y, s):
        force = jnp.stack([-y.x[0] - s.belt, jnp.cos(1.7 * t) - s.wall]) + 0.4 * jnp.stack([1.0, -1.0]) * (
            y.x[1] - y.x[0]
        )
        return Motion(y.v, force)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v[0] - self.v_dr

    @belt.breakaway
    def belt(self):
        return 1.4

    @nsjax.impact
    def wall(self, t, y):
        return 0.6 - y.x[1]

    @wall.restitution
    def wall(self):
        return 0.7


@pytest.mark.slow
def test_two_switches():
    """Friction and impacts of two bodies: a sweep against the general flow, almost all of it from event to event."""
    v = np.linspace(0.1, 0.9, 24)
    got, want = (
        jax.jit(jax.vmap(lambda v, m=m: solve(Pulled(v), 0.0, 20.0, Motion(jnp.zeros(2), jnp.ones(2)), solver=m)))(v)
        for m in (Affine(), Exponential())
    )
    assert np.array_equal(got.events.num, want.events.num) and np.array_equal(got.unique, want.unique)
    assert np.array_equal(got.events.switch, want.events.switch)
    assert np.array_equal(got.events.mode_after, want.events.mode_after)
    np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-10)
    assert np.median(got.stats["num_steps"]) < 0.5 * np.median(want.stats["num_steps"])


class Ticking(nsjax.System):
    """A clock, for which there is no such flow."""

    def vector_field(self, t, y, s):
        return jnp.floor(t) - 0.1 * y

    @nsjax.clock
    def beat(self):
        return 1.0


def test_what_is_left_to_the_general_flow():
    """Models with other switches are solved by the program of `Exponential`; two frequencies are told."""
    sizes = [
        count(jax.make_jaxpr(lambda m=m: solve(Ticking(), 0.0, 5.0, jnp.asarray(0.0), solver=m).y1)())
        for m in (Affine(), Exponential())
    ]
    assert sizes[0] == sizes[1]

    class Beats(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x + jnp.cos(t) + jnp.cos(1.5 * t))

    with pytest.raises(ValueError, match="harmonic of one frequency .*, but that of `Beats` is not"):
        solve(Beats(), 0.0, 5.0, Motion(1.0, 0.0), solver=Affine())
    with pytest.raises(ValueError, match="affine in the state, but"):
        entry = gallery.THESIS["2.4"]
        solve(entry.system(), entry.t0, entry.t1, entry.y0, solver=Affine())
