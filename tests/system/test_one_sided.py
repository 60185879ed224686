"""Friction that is written with |v_rel|: in a mode the field is smooth on both sides of its surface."""

import functools

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
from branches import continue_orbit, orbit_of, QUICK
from models import Motion
from scipy.integrate import solve_ivp

import nsjax
from nsjax.system._mode import ModeState, OFF
from nsjax.system._model import SwitchedSystem
from nsjax.system._one_sided import Side, Sides


class Belt(nsjax.System):
    """A mass on a spring that hardens, and on a belt whose friction falls with the sliding velocity."""

    v_dr: float = 0.2
    k_3: float = 0.3
    delta: float = 3.0

    def friction(self, y, s):
        raise NotImplementedError

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - self.k_3 * y.x**3 + self.friction(y, s))

    @nsjax.sgn
    def belt(self, t, y):
        return self.v_dr - y.v


class Written(Belt):
    """Each law by itself."""

    def friction(self, y, s):
        h = self.delta * (self.v_dr - y.v)
        return 0.5 * (1 + s.belt) / (1 + h) - 0.5 * (1 - s.belt) / (1 - h)


class Same(Belt):
    def friction(self, y, s):
        return s.belt / (1 + self.delta * jnp.abs(self.v_dr - y.v))


class Turned(Belt):
    def friction(self, y, s):
        return s.belt / (1 + self.delta * jnp.abs(y.v - self.v_dr))


class Negative(Belt):
    def friction(self, y, s):
        return s.belt / (1 + self.delta * jnp.abs(-(self.v_dr - y.v)))


class Greater(Belt):
    """|h| as max(h, -h), by way of `jnp.maximum(h, 0)`."""

    def friction(self, y, s):
        h = self.v_dr - y.v
        return s.belt / (1 + self.delta * (2 * jnp.maximum(h, 0.0) - h))


class Scaled(Belt):
    """As by a velocity that is characteristic of the law."""

    def friction(self, y, s):
        return s.belt / (1 + jnp.abs((y.v - self.v_dr) / (-1 / self.delta)))


class Twice(Belt):
    def friction(self, y, s):
        return s.belt / (1 + jnp.abs(self.delta * (2.0 * -(self.v_dr - y.v)) * 0.5))


class Elsewhere(Belt):
    """A kink that is on no surface, beside one that is."""

    def friction(self, y, s):
        return s.belt / (1 + self.delta * jnp.abs(self.v_dr - y.v)) + 0 * jnp.abs(y.x - self.v_dr)


class Alike(Belt):
    """Another number of the same value, which is not the velocity of the belt."""

    v_0: float = 0.2

    def friction(self, y, s):
        return s.belt / (1 + self.delta * jnp.abs(self.v_0 - y.v))


class Looped(Belt):
    def friction(self, y, s):
        return s.belt / (1 + lax.fori_loop(0, 3, lambda i, w: w + jnp.abs(self.v_dr - y.v), jnp.zeros_like(y.v)))


SMOOTH = [Same(), Turned(), Negative(), Greater(), Scaled(), Twice(), Elsewhere()]


def model_of(system, smooth=True):
    return SwitchedSystem.forwards(system, jnp.zeros(()), Motion(jnp.ones(()), jnp.ones(())), smooth)


@pytest.mark.parametrize(
    "system, way",
    [
        (Same(), ()),
        (Turned(), (-1,)),
        (Negative(), (-1,)),
        (Greater(), ()),
        (Scaled(), (0, -1)),
        (Twice(), (0, 1, 1, -1)),
        (Elsewhere(), ()),
        (Alike(), None),
        (Looped(), None),
        (Written(), None),
    ],
    ids=lambda x: type(x).__name__,
)
def test_told_by_the_operations(system, way):
    want = None if way is None else Sides((Side(0, 0, 0, way, sign=1, idle=False),), partial=False)
    assert model_of(system).sides == want
    assert model_of(system, smooth=False).sides is None
    seen = []
    jax.eval_shape(lambda v_dr: seen.append(model_of(type(system)(v_dr=v_dr)).sides), 0.3)
    assert seen == [want]


@functools.partial(jax.jit, static_argnums=0)  # one program a law, for all modes and places
def field_of(kind, mode, z):
    """Of (x, v, v_dr, delta), with its derivatives."""

    def of(z):
        state = ModeState.of([mode], [None])
        f = model_of(kind(v_dr=z[2], delta=z[3])).flow(jnp.zeros(()), Motion(z[0], z[1]), state)
        return (jnp.stack([f.x, f.v]),) * 2

    return jax.jacfwd(of, has_aux=True)(z)


@pytest.mark.parametrize("system", SMOOTH, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("mode", [-1, 0, 1])
def test_flow_of_a_mode_is_smooth_beyond_its_surface(system, mode):
    """On both sides and on the surface, with derivatives by state and parameters, as of the laws one by one."""
    mode = jnp.asarray(mode, jnp.int32)
    for v in [0.2] if mode == 0 else [0.2, 0.25, 0.15, 0.2 + 1e-17]:  # what holds is on the surface
        z = jnp.asarray([0.4, v, 0.2, 3.0])
        for got, want in zip(field_of(type(system), mode, z), field_of(Written, mode, z)):
            np.testing.assert_allclose(got, want, atol=1e-14)


class Blocks(nsjax.System):
    """Two on a belt, coupled by springs, with velocities in one array; a third number there is on no surface."""

    v_dr: float = 0.2
    delta: float = 3.0

    def sizes(self, v, s):
        return jnp.abs(jnp.flip(v) - self.v_dr)[::-1]

    def vector_field(self, t, y, s):
        friction = jnp.stack([s.first, s.second, 1.0]) / (1 + self.delta * self.sizes(y.v, s))
        return Motion(y.v, -jnp.array([[2.0, -1.0, 0.0], [-1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]) @ y.x + friction)

    @nsjax.sgn
    def first(self, t, y):
        return self.v_dr - y.v[0]

    @nsjax.sgn
    def second(self, t, y):
        return -2 * (y.v[1] - self.v_dr) / 3


class BlocksWritten(Blocks):
    def sizes(self, v, s):
        h = self.v_dr - v
        return jnp.stack([h[0] * s.first, h[1] * s.second, jnp.abs(v[2] - self.v_dr)])


BLOCKS = Motion(np.array([0.4, -0.3, 0.1]), np.array([0.2, 0.2, 0.25]))


@functools.partial(jax.jit, static_argnums=0)
def field_of_blocks(kind, mode, z):
    """Of (v_dr, delta, *v), with its derivatives."""

    def of(z):
        zero, state = jnp.zeros(()), ModeState.of(mode, [None, None])
        model = SwitchedSystem.forwards(kind(v_dr=z[0], delta=z[1]), zero, BLOCKS, True)
        f = model.flow(zero, Motion(BLOCKS.x, z[2:]), state)
        return (jnp.concatenate([f.x, f.v]),) * 2

    return jax.jacfwd(of, has_aux=True)(z)


@pytest.mark.parametrize("mode", [(1, 1), (1, -1), (-1, 1)])
def test_kinks_that_are_entries_of_an_array(mode):
    sides = [SwitchedSystem.forwards(kind(), jnp.zeros(()), BLOCKS, True).sides for kind in (Blocks, BlocksWritten)]
    assert sides[1] is None and [(side.at, side.switch) for side in sides[0].kinks] == [(1, 1), (2, 0)]
    mode = jnp.asarray(mode, jnp.int32)
    for v in ([0.2, 0.2, 0.3], [0.25, 0.1, 0.1], [0.1, 0.25, 0.2 + 1e-17]):
        z = jnp.asarray([0.2, 3.0, *v])
        for got, want in zip(field_of_blocks(Blocks, mode, z), field_of_blocks(BlocksWritten, mode, z)):
            np.testing.assert_allclose(got, want, atol=1e-14)


class Rubbing(nsjax.System):
    """A wheel that drives a mass while they touch, with friction that falls; air slows it by its relative velocity,
    touching or not."""

    def vector_field(self, t, y, s):
        w = jnp.abs(y.v - 0.2)
        return Motion(y.v, -y.x + s.rub / (1 + 3 * w) - w)

    @nsjax.sgn
    def touching(self, t, y):
        return -y.x

    @nsjax.sgn
    def rub(self, t, y):
        return 0.2 - y.v

    rub = rub.while_("touching")


@pytest.mark.parametrize("touching, rub, v, want", [
    (1, 1, 0.3, 1 / 0.7 + 0.1),  # beyond its surface: -|h| = h
    (1, -1, 0.1, -1 / 0.7 + 0.1),
    (1, 1, 0.1, 1 / 1.3 - 0.1),
    (-1, OFF, 0.3, -0.1),
    (-1, OFF, 0.1, -0.1),
])  # fmt: skip
def test_a_switch_that_may_be_off_has_no_sign_then(touching, rub, v, want):
    model = model_of(Rubbing())
    assert [side.idle for side in model.sides.kinks] == [True]
    state = ModeState.of(jnp.asarray([touching, rub], jnp.int32), [None, None])
    f = model.flow(jnp.zeros(()), Motion(jnp.asarray(0.5), jnp.asarray(v)), state)
    np.testing.assert_allclose(f.v, want - 0.5, atol=1e-14)


class Ball(nsjax.System):
    """On a floor as of Hertz."""

    n: float = 1.5

    def vector_field(self, t, y, s):
        return Motion(y.v, 100.0 * jnp.maximum(-y.x, 0.0) ** self.n - 1.0 + 0.0 * s.floor)

    @nsjax.sgn
    def floor(self, t, y):
        return -y.x


def test_a_power_is_left_as_it_is_where_it_has_no_value():
    model = model_of(Ball())
    assert model.sides == Sides((Side(0, 0, 0, (-1,), sign=-1, idle=False),), partial=True)
    state = ModeState.of([jnp.asarray(1, jnp.int32)], [None])

    def pull(x):
        return model.flow(jnp.zeros(()), Motion(x, 0.0 * x), state).v

    for x, want, slope in ((-0.04, -0.2, -30.0), (0.0, -1.0, 0.0), (1e-17, -1.0, 0.0)):
        np.testing.assert_allclose(pull(x), want, atol=1e-14)
        np.testing.assert_allclose(jax.jvp(pull, (x,), (1.0,))[1], slope, atol=1e-12)
    np.testing.assert_allclose(pull(0.5), -1.0, atol=1e-14)


def period_of(v_dr, k_3=0.3, delta=3.0):
    """It sticks until the spring is as strong as friction, slips until it is as fast as the belt, and sticks again."""
    x = np.real(next(r for r in np.roots([k_3, 0, 1, -1]) if abs(r.imag) < 1e-12))

    def slip(t, y):
        return [y[1], -y[0] - k_3 * y[0] ** 3 + 1 / (1 + delta * (v_dr - y[1]))]

    def caught(t, y):
        return y[1] - v_dr if t > 0.5 else -1.0

    caught.terminal = True
    end = solve_ivp(slip, (0, 50), [x, v_dr], "DOP853", rtol=1e-12, atol=1e-12, events=caught)
    return end.t[-1] + (x - end.y[0, -1]) / v_dr


@pytest.fixture(scope="module")
def turned():
    return orbit_of(Turned(), Motion(1.0, 0.2), period=12.0)


@pytest.mark.slow
def test_a_branch_with_falling_friction(turned):
    """It ended after a millionth of the interval, as Newton's method came to both sides of the surface."""
    branch = continue_orbit(Turned(), turned, "v_dr", (0.19, 0.21), max_branches=1, max_step=0.1)
    assert len(branch) < 30 and np.all(branch.stable)
    np.testing.assert_allclose([branch.values[0], branch.values[-1]], [0.19, 0.21], atol=1e-12)
    np.testing.assert_allclose(branch.multipliers, np.tile([1.0, 0.0], (len(branch), 1)), atol=1e-11)
    for i in (0, -1):
        np.testing.assert_allclose(branch.periods[i], period_of(branch.values[i]), rtol=1e-11)


@pytest.mark.slow
def test_a_continuation_that_is_kept_knows_them(turned, tmp_path):
    """In its equations, before it is written and when it is read."""
    system = Turned()
    growth = nsjax.OrbitContinuation(system, turned, "v_dr", (0.19, 0.21), **QUICK)
    growth.save(tmp_path / "growth")
    again = nsjax.OrbitContinuation.load(tmp_path / "growth", system, **QUICK)
    sides = [one._explorer.tracer.curve.model.sides for one in (growth, again)]
    assert sides[0] == sides[1] == model_of(system).sides


@pytest.mark.slow
def test_a_point_without_derivatives_is_none():
    """With the kink in a loop the derivatives are not numbers on an orbit here and there. One was called unstable."""
    system = Looped()
    orbit = orbit_of(system, Motion(1.0, 0.2), period=12.0)
    branch = continue_orbit(system, orbit, "v_dr", (0.15, 0.25), max_branches=1, max_step=0.1)
    assert np.all(np.isfinite(branch.multipliers)) and np.all(branch.stable)
    np.testing.assert_allclose(branch.values[-1], 0.25, atol=1e-12)


class Pair(nsjax.System):
    """Two coupled blocks on a belt, with velocities in one array."""

    v_dr: float = 0.2
    delta: float = 3.0

    def vector_field(self, t, y, s):
        friction = jnp.stack([s.first, 1.3 * s.second]) / (1 + self.delta * jnp.abs(y.v - self.v_dr))
        return Motion(y.v, friction - jnp.array([[2.0, -1.0], [-1.0, 2.2]]) @ y.x)

    @nsjax.sgn
    def first(self, t, y):
        return self.v_dr - y.v[0]

    @nsjax.sgn
    def second(self, t, y):
        return self.v_dr - y.v[1]


@pytest.mark.slow
def test_a_branch_of_two_blocks():
    """Next to its first orbit none was found."""
    system = Pair()
    rest = Motion(jnp.array([1.0, 1.0]), jnp.array([0.2, 0.2]))
    orbit = nsjax.find_orbit(system, nsjax.solve(system, 0.0, 150.0, rest, max_steps=100_000).y1)
    branch = continue_orbit(system, orbit, "v_dr", (0.195, 0.2), max_branches=1, max_step=0.1)
    other = nsjax.find_orbit(Pair(v_dr=branch.values[0]), branch.orbit(0).y0)
    np.testing.assert_allclose(branch.values[0], 0.195, atol=1e-12)
    np.testing.assert_allclose(branch.periods[0], other.period, rtol=1e-11)
    np.testing.assert_allclose(branch.multipliers[0], other.multipliers, atol=1e-9)
