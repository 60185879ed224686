"""Friction at its bound: at the start, at the end, at a loose tolerance, and where it may break at several places."""

import functools
from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from models import itinerary, Motion, pid, times

import nsjax
from nsjax import gallery, RESULTS, solve


STICKS = {
    "2.4": (gallery.FallingStickSlip(), 1.0),
    "3.4 without static point": (gallery.StickSlip(F_stick=1.0), 1.0),
    "3.4": (gallery.StickSlip(), 2.0),
}


@pytest.mark.parametrize("key", STICKS)
def test_start_at_the_bound(key):
    """Pitfalls 2, 13: λ = -x equals its bound b at x = -b, and falls as the belt moves on: it sticks. At x = b it grows
    beyond."""
    system, b = STICKS[key]
    sol = solve(system, 0.0, 4.0, Motion(-b, 0.2), stepsize_controller=pid(1e-8))
    assert sol.result == RESULTS.successful and len(sol.events) == 0 and sol.mode1 == 0
    np.testing.assert_allclose(sol.y1, [0.8 - b, 0.2], rtol=1e-14)
    sol = solve(system, 0.0, 1.0, Motion(b, 0.2), stepsize_controller=pid(1e-8))
    assert sol.mode1 == -1 and sol.y1.v < 0.2
    assert [float(e.t) for e in sol.events] in ([], [0.0])


def test_load_that_stays_at_the_bound():
    """Pitfall 13: with λ = 1 all the time it neither leaves nor chatters."""

    class Pushed(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, 0.3 - 0.3 * s.ground)

        @nsjax.sgn
        def ground(self, t, y):
            return y.v

    sol = solve(Pushed(), 0.0, 10.0, Motion(0.0, 0.0))
    assert sol.result == RESULTS.successful and len(sol.events) == 0 and sol.mode1 == 0


@pytest.mark.parametrize("ahead", [1e-6, 1e-9, 1e-12])
def test_end_right_after_leaving(ahead):
    """Pitfall 9: what h rises to until the end is far below rounding."""
    sol = solve(gallery.FallingStickSlip(), 0.0, 10.0, Motion(ahead - 1, 0.2), stepsize_controller=pid(1e-8))
    assert sol.result == RESULTS.successful and itinerary(sol) == [("belt", 0, -1)]
    np.testing.assert_allclose(times(sol), [10 - 5 * ahead], rtol=1e-14)


@pytest.mark.parametrize("tol", [1e-3, 1e-5])
def test_leaving_at_a_loose_tolerance(tol):
    """Pitfalls 3, 14: the step to the end of a stick drifts off the surface, and ends on it all the same."""
    sol = solve(gallery.FallingStickSlip(), 0.0, 40.0, Motion(0.0, 0.2), stepsize_controller=pid(tol))
    assert len(sol.events) == 6
    np.testing.assert_allclose(times(sol)[::2], 5.0 + 12.001031294823495 * np.arange(3), atol=20 * tol)
    for e in sol.events:
        if e.mode_before["belt"] == 0:
            assert abs(e.y_before.v - 0.2) < 1e-16


class Plates(nsjax.System):
    """Three plates above each other, each with a spring, friction between neighbours, and a force on the top one."""

    F: Array
    b: float = 1.4

    def vector_field(self, t, y, s):
        friction = self.F * jnp.stack([s.f0, s.f1, s.f2])
        return Motion(y.v, -y.x - friction + jnp.append(friction[1:], 2.0 * jnp.cos(0.4 * t)))

    @property
    def switches(self):
        return _interfaces()


@functools.cache
def _interfaces():
    def interface(i):
        switch = nsjax.sgn(lambda self, t, y: y.v[i] - (y.v[i - 1] if i else 0.0), name=f"f{i}")
        return switch.breakaway(lambda self: self.b)

    return tuple(interface(i) for i in range(3))


@pytest.mark.slow
def test_what_sticks_goes_on_sticking():
    """With static points there may be several solutions: where the top plate turns round, the interface below it could
    break instead. Those that stuck are kept, and `unique` is False."""
    zero = jnp.zeros(3)
    sol = solve(Plates(jnp.full(3, 0.5)), 0.0, 7.5, Motion(zero, zero), stepsize_controller=pid(1e-10))
    assert itinerary(sol)[-1] == ("f2", -1, 1)
    assert np.all(np.asarray(sol.mode1) == [0, 0, 1]) and np.all(np.asarray(sol.y1.v[:2]) == 0)
    assert not sol.unique
    assert solve(Plates(jnp.full(3, 0.5), b=1.0), 0.0, 7.5, Motion(zero, zero)).unique


def test_start_beside_the_surface():
    """What is held there forgets the component of its start off the surface."""

    def end(v, dt0):
        sol = solve(gallery.StickSlip(), 0.0, 3.0, Motion(0.5, v), mode={"belt": 0}, dt0=dt0)
        return jnp.stack(sol.y1)

    for dt0 in (1e-3, 1.0):
        assert np.all(np.abs(jax.jacfwd(end)(0.2, dt0)) < 1e-15)


@pytest.mark.slow
def test_derivative_with_an_implicit_solver():
    """In forward mode, as the solver comes."""
    run = dict(stepsize_controller=pid(1e-10), max_steps=20_000)

    def end(v, solver):
        return solve(gallery.StickSlip(v_dr=v), 0.0, 12.0, Motion(2.5, -0.5), solver=solver, **run).y1.x

    got, want = (jax.jacfwd(functools.partial(end, solver=s))(0.5) for s in (dfx.Kvaerno5(), dfx.Tsit5()))
    np.testing.assert_allclose(got, want, rtol=1e-7)


class Loaded(nsjax.System):
    """A system in which another one is a part."""

    inner: gallery.StickSlip
    traced: ClassVar[int] = 0

    def vector_field(self, t, y, s):
        Loaded.traced += 1
        return self.inner.vector_field(t, y, s)

    @property
    def switches(self):
        return (nsjax.sgn(_belt, name="belt"),)


def _belt(system, t, y):
    return y.v - system.inner.v_dr


def test_integers_among_the_numbers_of_a_part():
    """Pitfall 31: whole numbers do not become constants of the program."""
    solve(Loaded(gallery.StickSlip(k=1)), 0.0, 1.0, Motion(2.5, -0.5))
    first = Loaded.traced
    solve(Loaded(gallery.StickSlip(k=2)), 0.0, 1.0, Motion(2.5, -0.5))
    assert Loaded.traced == first > 0
