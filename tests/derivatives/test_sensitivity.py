"""Derivatives with the itinerary to which they belong, and solutions that are not the only ones."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import CHEAP, Circle, flat, impact, Motion, pid, Plane, Touch

import nsjax
from nsjax import gallery, RESULTS, sensitivity, solve


LINE = type(gallery.THESIS["(2.3)"].y0)
PLANE = type(gallery.THESIS["example 2.3"].y0)


@jax.jit
def touch(system):
    """State at t = 3, without a wall (cos t, -sin t); the wall is touched if `gap` <= 0."""

    def end(system):
        options = dict(stepsize_controller=pid(1e-12), throw=False)
        sol = solve(system, -np.pi, 3.0, Motion(-1.0, 0.0), **options)
        return jnp.stack(sol.y1), sol

    return sensitivity(end, system)


@pytest.mark.slow
def test_a_walk_over_a_grazing_is_seen():
    """Pitfall 21: on one side of it the derivative is that of an impact, on the other there is none."""
    gaps = (-0.1, -0.01, 0.01, 0.1)
    found = [touch(Touch(gap)) for gap in gaps]
    for gap, s in zip(gaps, found):
        hits = gap < 0
        want = jax.jacfwd(impact)(gap) if hits else np.zeros(2)
        np.testing.assert_allclose(s.value, impact(gap) if hits else [np.cos(3), -np.sin(3)], atol=1e-9)
        np.testing.assert_allclose(s.jacobian.gap, want, rtol=1e-8, atol=1e-9)
        assert s.defined and s.result == RESULTS.successful
        assert str(s.itinerary) == ("wall +0 -> wall +0" if hits else "wall +0")
    same = [[bool(a.itinerary.same_as(b.itinerary)) for a in found] for b in found]
    np.testing.assert_array_equal(same, np.kron(np.eye(2), np.ones((2, 2))))
    grazing = touch(Touch(-1e-12))
    assert not grazing.defined and grazing.result == RESULTS.tangential_event


@pytest.mark.slow
def test_itineraries_of_many():
    """In a batch, and with logs of different sizes."""

    def path(v, max_events):
        sol = solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5), max_events=max_events, **CHEAP)
        return sol.itinerary

    v = jnp.asarray([0.3, 0.31, 0.9])
    few, many = jax.vmap(lambda v: path(v, 16))(v), path(0.3, 32)
    np.testing.assert_array_equal(few.same_as(many), [True, True, False])
    assert len(set(map(len, map(list, [many, path(0.9, 32)])))) == 2
    other = solve(gallery.SlidingPoint(), 0.0, 1.0, LINE(2.0)).itinerary
    with pytest.raises(ValueError, match="different systems"):
        other.same_as(many)


@pytest.mark.slow
def test_reverse():
    """By `reverse=True`, for a scalar of many parameters."""

    def end(p):
        sol = solve(
            gallery.StickSlip(v_dr=p["v"], k=p["k"]), 0.0, 9.0, Motion(2.5, -0.5), adjoint=dfx.DirectAdjoint(),
            solver=dfx.Heun(), stepsize_controller=pid(1e-4),
        )  # fmt: skip
        return sol.y1.x, sol

    p = {"v": 0.3, "k": 1.1}
    forward, backward = sensitivity(end, p), sensitivity(end, p, reverse=True)
    assert forward.itinerary.same_as(backward.itinerary)
    np.testing.assert_allclose(jax.tree.leaves(backward.jacobian), jax.tree.leaves(forward.jacobian), rtol=1e-12)


# Solutions that are not unique.


class Example(nsjax.System):
    """x1' = a1 + b1 s, x2' = a2 + b2 s, s in Sgn(x2 - 1), and |s| <= bound for what stays on x2 = 1."""

    a1: float = 0.0
    b1: float = 0.0
    a2: float = 0.0
    b2: float = -1.0
    bound: float = 1.0

    def vector_field(self, t, y, s):
        return Plane(self.a1 + self.b1 * s.surface, self.a2 + self.b2 * s.surface)

    @nsjax.sgn
    def surface(self, t, y):
        return y.y - 1

    @surface.breakaway
    def surface(self):
        return self.bound


POINT, STICKING = Example(), Example(a2=2.0, b2=1.0, bound=3.0)  # (2.3), example 2.5
ATTRACTION, REPULSION = Example(4.0, 2.0, 2.0, -4.0), Example(-4.0, -2.0, -2.0, 4.0)  # examples 2.2, 2.3


ONE_STEP = dict(solver=dfx.Euler(), stepsize_controller=dfx.ConstantStepSize(), dt0=1000.0)  # exact for these


@pytest.mark.parametrize(
    "system, t1, height, mode, unique",
    [
        (POINT, 3.0, 2.0, None, True),
        (STICKING, 2.0, -1.0, None, False),  # it crosses, but might stay on the surface
        (STICKING, 2.0, 0.0, 0, False),
        (STICKING, 2.0, 0.0, 1, False),
        (STICKING, 2.0, 1.0, None, True),
        (REPULSION, 1.0, 0.25, None, True),
        (REPULSION, 1.0, 0.0, 0, False),
        (REPULSION, 1.0, 0.0, -1, False),
        (REPULSION, -1.0, 0.25, None, False),  # backwards it enters repulsion sliding
        (ATTRACTION, 1.0, 0.25, None, True),
        (ATTRACTION, -1.0, 0.0, 0, False),
    ],
)
def test_unique(system, t1, height, mode, unique):
    """Section 2.4, examples 2.2 to 2.5: `Solution.unique` tells that `solve` or the user has chosen among several."""
    y0, mode = Plane(0.0, 1.0 + height), None if mode is None else {"surface": jnp.asarray(mode)}
    assert solve(system, 0.0, t1, y0, mode=mode, **ONE_STEP).unique == unique


def test_friction_law_c_as_an_inclusion():
    """(2.29): at rest under a force between F_slip and F_stick the block may stay or slide; it stays unless told to."""
    system = gallery.StickSlip()  # (3.33): slides with the force 1, rests up to 2

    def run(x, mode=None):
        sol = solve(system, 0.0, 1.0, Motion(x, 0.2), mode=None if mode is None else {"belt": jnp.asarray(mode)})
        return sol.unique, int(sol.mode1[0]), flat(sol.y1)

    unique, mode, y = run(1.5)
    assert (unique, mode) == (False, 0)
    np.testing.assert_allclose(y, [1.7, 0.2], atol=1e-14)
    unique, mode, y = run(1.5, mode=-1)
    assert (unique, mode) == (False, -1)
    np.testing.assert_allclose(y, [1 + 0.5 * np.cos(1) + 0.2 * np.sin(1), 0.2 * np.cos(1) - 0.5 * np.sin(1)], atol=1e-8)
    assert run(0.5)[:2] == (True, 0)


def test_repulsion_sliding_does_not_drift():
    """Pitfall 24: off the surface everything grows without bound at once; on it the solution and its derivative among
    the solutions that stay are exact."""

    def end(x1):
        y0, held = PLANE(x1, jnp.ones_like(x1)), {"surface": jnp.asarray(0)}
        sol = solve(gallery.RepulsionSliding(), 0.0, 100.0, y0, mode=held, **ONE_STEP | dict(dt0=1.0))
        return flat_jax(sol.y1), sol

    s = sensitivity(end, 0.5)
    np.testing.assert_allclose(s.value, [0.5 - 500, 1], rtol=1e-13)
    np.testing.assert_array_equal(s.jacobian, [1, 0])
    assert list(s.itinerary) == [{"surface": 0}]


@pytest.mark.slow
def test_repulsion_sliding_stays():
    """Pitfall 24: what steps off the surface is put back, on a circle too (it repels backwards in time), and what the
    start was off it is not in the derivative."""

    y1 = flat(solve(Circle(), 100.0, 0.0, Plane(1.0, 0.0), mode={"circle": 0}).y1)
    np.testing.assert_allclose(y1, [np.cos(100), -np.sin(100)], atol=1e-6)
    assert abs(np.hypot(*y1) - 1) < 4e-15

    def end(y0):
        return flat_jax(solve(gallery.RepulsionSliding(), 0.0, 2.0, PLANE(*y0), mode={"surface": 0}).y1)

    jacobian = jax.jit(jax.jacfwd(end))(jnp.asarray([0.5, 1.0]))
    np.testing.assert_array_equal(jacobian[:, 0], [1, 0])
    assert jacobian[1, 1] == 0


def flat_jax(y):
    return jnp.stack(jax.tree.leaves(y))
