"""Dense output and save times."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import gallery, RESULTS
from nsjax.flow._save import times_between, times_in_order


BELT = gallery.StickSlip(v_dr=0.2, F_slip=1.0, F_stick=2.0)


@pytest.fixture(scope="module")
def sol():
    return nsjax.solve(BELT, 0.0, 40.0, Motion(2.5, 0.0), saveat=dfx.SaveAt(dense=True))


def test_arrays_of_times(sol):
    """Pitfall 42: one state a time, as if asked for one by one; also for tables of times and for none."""
    ts = np.array([0.0, 3.0, 17.5, 40.0])
    one_by_one = [sol(t) for t in ts]
    np.testing.assert_array_equal(sol(ts).x, [y.x for y in one_by_one])
    np.testing.assert_array_equal(sol(ts.reshape(2, 2)).v, np.reshape([y.v for y in one_by_one], (2, 2)))
    assert sol(np.zeros((0,))).x.shape == (0,)
    event = sol.events[0].t
    before, after = sol(jnp.stack([event, event])), sol(jnp.stack([event, event]), left=False)
    np.testing.assert_allclose(before.x, after.x, atol=1e-12)


def test_times_between_two():
    """Pitfall 42: times that a program makes for itself lie within, whatever its compiler makes of their rounding."""

    @jax.jit
    def within(first, last):
        a, b = jnp.sin(first) * 0.7 + 0.1, jnp.sin(last) * 0.7 + 0.1
        a, b, ts = times_between(a, b, np.linspace(0, 1, 33))
        return times_in_order(ts, a, b) & (ts[0] == a)

    pairs = np.random.default_rng(0).uniform(-3, 3, (2000, 2))
    assert jax.vmap(within)(*pairs.T).all()


def test_outside(sol):
    """Pitfall 42: there is no state outside of the solution; times that rounding alone puts there are meant inside."""
    with pytest.raises(ValueError, match="must lie between t0 = 0 and t1 = 40, but got 41"):
        sol(41.0)
    with pytest.raises(ValueError, match="but got -1 and 1 other times outside"):
        sol([-1.0, 3.0, np.nan])
    assert sol(np.nextafter(40.0, 50.0)) == sol(40.0)
    ys = jax.jit(lambda sol, ts: sol(ts))(sol, jnp.asarray([-1.0, 3.0, 40.0, 41.0, jnp.nan]))
    np.testing.assert_array_equal(np.isnan(ys.x), [True, False, False, True, True])
    assert np.isnan(jax.jacfwd(lambda t: sol(t).x)(1e3))  # where it is traced


def test_derivatives_at_the_ends(sol):
    """The state moves with the time, at the ends of the solution too."""
    for t in (0.0, 40.0):
        np.testing.assert_allclose(jax.jacfwd(lambda t: sol(t).x)(t), sol(t).v, atol=1e-8)


@pytest.mark.slow
def test_batches_are_evaluated_lane_by_lane():
    sols = jax.vmap(lambda x: nsjax.solve(BELT, 0.0, 4.0, Motion(x, 0.0 * x), saveat=dfx.SaveAt(dense=True)))(
        jnp.asarray([2.0, 2.5])
    )
    with pytest.raises(ValueError, match=r"jax.vmap\(lambda sol: sol\(t\)\)"):
        sols(1.0)
    ts = jnp.asarray([0.0, 4.0])
    ys = jax.vmap(lambda sol: sol(ts))(sols)
    np.testing.assert_allclose(ys.x[:, 1], sols.y1.x, atol=1e-12)


@pytest.mark.parametrize(
    "t1, ts, what",
    [
        (4.0, [3.0, 1.0], "in another order; sort them"),
        (4.0, [-1.0, 2.0], "but got -1.0"),
        (4.0, [1.0, 5.0], "but got 5.0"),
        (4.0, [1.0, np.nan], "but got nan"),
        (-4.0, [-3.0, -1.0], "in another order"),
        (-4.0, [-1.0, 1.0], "but got 1.0"),
    ],
)
def test_save_times(t1, ts, what):
    """Pitfall 42: refused where they are known, told by status where they are traced."""
    with pytest.raises(ValueError, match=f"`saveat` must have times `ts`.*{what}"):
        nsjax.solve(BELT, 0.0, t1, Motion(2.5, 0.0), saveat=dfx.SaveAt(ts=jnp.asarray(ts)))
    assert _traced(jnp.asarray(ts), t1) == RESULTS.wrong_save_times
    assert _traced(t1 * jnp.asarray([0.0, 1.0])[: len(ts)], t1) == RESULTS.successful


class Drift(nsjax.System):
    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x)


@jax.jit
def _traced(ts, t1):
    return nsjax.solve(Drift(), 0.0, t1, Motion(2.5, 0.0), saveat=dfx.SaveAt(ts=ts), throw=False).result


class Ramp(nsjax.System):
    """x' = 1 up to the surface, from where it is 3/4 of that."""

    def vector_field(self, t, y, s):
        return Motion(1 - 0.125 * (1 + s.knee), 0.0 * y.v)

    @nsjax.sgn
    def knee(self, t, y):
        return y.x - 1.0


@pytest.mark.parametrize(
    "solver",
    [
        dfx.Tsit5(),
        *(pytest.param(s, marks=pytest.mark.slow) for s in (dfx.Dopri8(), nsjax.Taylor(), nsjax.Exponential())),
    ],
)
def test_events_at_the_end(solver):
    """Pitfall 9: an event exactly at the end is logged, and the end moves with the time that is asked for."""

    def ends(t1):
        sol = nsjax.solve(Ramp(), 0.1, t1, Motion(0.1, 0.0), solver=solver)
        return sol.y1.x, (sol.events.num, sol.mode1, sol.t1)

    run = jax.jit(jax.jacfwd(ends, has_aux=True))
    slope, (num, mode, t1) = run(1.0)
    assert (num, mode, t1) == (1, 1, 1.0)
    np.testing.assert_allclose(slope, 0.75, rtol=1e-12)
    early = run(1.0 - 1e-12)[1]
    assert early[0] == 0 and early[1] == -1


@pytest.mark.slow
def test_orbit_based_on_an_event():
    """Pitfall 44: with its base point exactly where it stops sticking, an orbit has the multipliers that it
    has elsewhere."""
    exact = 10 + np.pi + 2 * np.arctan(0.2)
    orbit = nsjax.find_orbit(BELT, Motion(2.0, 0.2), period=exact, solver=dfx.Tsit5())
    np.testing.assert_allclose(orbit.period, exact, rtol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(orbit.multipliers)), [0, 1], atol=1e-10)


@pytest.mark.slow
def test_forced_orbit_based_on_an_event():
    """The same where time says where the base point is: at the end of a stick phase, an ulp before it, and after it."""
    system = gallery.thesis("6.8")
    free = nsjax.find_orbit(system, gallery.entry("6.8").y0, solver=dfx.Tsit5())
    release = next(e for e in free.events if e.mode_before["friction"] == 0)
    for t0 in (float(release.t), np.nextafter(float(release.t), 0), float(release.t) + 1e-13):
        orbit = nsjax.find_orbit(system, release.y_after, t0=t0, solver=dfx.Tsit5())
        np.testing.assert_allclose(orbit.multipliers, free.multipliers, atol=1e-9)


class Near(nsjax.System):
    """x = -0.3 + cos t beside a wall at -1.3 - gap."""

    gap: float = 1e-3

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.3 * s.wall)

    @nsjax.sgn
    def wall(self, t, y):
        return y.x + 1.3 + self.gap


def test_margin():
    """Pitfall 45: how near the solution came to an event that did not happen, in units of the tolerance."""
    run = jax.jit(lambda gap: nsjax.solve(Near(gap=gap), 0.0, 10.0, Motion(0.7, 0.0)))
    for gap in (1e-4, 1e-6, 1e-7):
        np.testing.assert_allclose(run(gap).margin, gap / (1e-8 * (1 + 1.3)), rtol=0.1)
    assert run(1e-9).margin < 1 and "tolerances: whether a surface was met" in str(run(1e-9))
    assert run(1.0).margin == np.inf and "tolerances" not in str(run(1.0))
    assert len(run(-1e-3).events) == 4 and run(-1e-3).margin > 100


def test_margin_beside_an_event():
    """Also where another surface is met in the same step, before or behind."""

    class Two(nsjax.System):
        at: float = 1.2

        def vector_field(self, t, y, s):
            return Motion(2 * (y.v - 1) + 0 * s.near, 1.0 + 0 * s.other)

        @nsjax.sgn
        def near(self, t, y):
            return y.x

        @nsjax.sgn
        def other(self, t, y):
            return y.v - self.at

    run = jax.jit(lambda at: nsjax.solve(Two(at=at), 0.0, 3.0, Motion(1 + 1e-9, 0.0)))
    for at in (0.9, 1.01, 1.2):
        sol = run(at)
        assert len(sol.events) == 1 and 0.02 < sol.margin < 0.2
