"""Sliding through a two-fold, pitfall 39: where the fields on both sides are tangent to the surface at one
point, n · f⁺ = n · f⁻ = 0, sliding passes from where the surface attracts to where it repels. From there on a solution
may leave at any time, to either side: none is unique."""

import functools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from models import flat, Motion, pid

import nsjax
from nsjax import RESULTS, solve
from nsjax.system._model import SwitchedSystem


class VerticalPlane(NamedTuple):
    x: Array
    z: Array


class VisibleVisible(nsjax.System):
    """x' = 1, z' = x s: f± = (1, ±x), λ = 0, x = x0 + t."""

    def vector_field(self, t, y, s):
        return VerticalPlane(jnp.ones_like(y.x), y.x * s.side)

    @nsjax.sgn
    def side(self, t, y):
        return y.z


class VisibleInvisible(nsjax.System):
    """f⁺ = (1, x), f⁻ = (-1, -g x): below, the fields turn back to the surface; λ = (g - 1) / (g + 1) = x'."""

    g: float = 2.0

    def vector_field(self, t, y, s):
        return VerticalPlane(s.side + 0 * y.x, y.x * (1 - self.g + (1 + self.g) * s.side) / 2)

    @nsjax.sgn
    def side(self, t, y):
        return y.z


class Space(NamedTuple):
    x: Array
    y: Array
    z: Array


class InvisibleInvisible(nsjax.System):
    """Teixeira's singularity: f⁺ = (1, V, -x), f⁻ = (V, 1, y). It slides for x, y > 0; with u = x + y, w = x - y
    u' = 1 + V, w' = (V - 1) w / u: for V = -2 u = u0 - t, w = w0 (u / u0)³, a node that all solutions run into."""

    V: float = -2.0

    def vector_field(self, t, y, s):
        up, down = (1 + s.side) / 2, (1 - s.side) / 2
        return Space(up + self.V * down, self.V * up + down, y.y * down - y.x * up)

    @nsjax.sgn
    def side(self, t, y):
        return y.z


# The model, a start, when it reaches the two-fold, and the solution that goes on sliding.
FOLDS = {
    "visible-visible": (VisibleVisible(), VerticalPlane(-1.0, 0.0), 1.0, lambda t: [t - 1, 0]),
    "visible-invisible": (VisibleInvisible(), VerticalPlane(-1.0, 0.0), 3.0, lambda t: [t / 3 - 1, 0]),
    "invisible-invisible": (
        InvisibleInvisible(),
        Space(1.0, 0.6, 0.0),
        1.6,
        lambda t: [(1.6 - t) / 2 + 0.2 * (1 - t / 1.6) ** 3, (1.6 - t) / 2 - 0.2 * (1 - t / 1.6) ** 3, 0],
    ),
}


TOLERANCES = (1e-4, 1e-6, 1e-9)
PARTS = np.array([0.3, 0.6, 0.9, 0.97, 1.03, 1.1, 1.5, 2.0, 2.5])  # of the time until it


@functools.cache
def through(kind, taylor):
    """The solutions to all parts of the time to the two-fold and beyond, for each tolerance."""
    system, y0, met, _ = FOLDS[kind]
    solver = nsjax.Taylor() if taylor else dfx.Tsit5()

    def run(t1, tol):
        sol = solve(system, 0.0, t1, y0, solver=solver, stepsize_controller=pid(tol), throw=False)
        return bool(sol.unique), sol.result == RESULTS.successful, flat(sol.y1), int(sol.mode1[0])

    return [[np.asarray(row) for row in zip(*(run(met * part, tol) for part in PARTS))] for tol in TOLERANCES]


@pytest.mark.parametrize(
    "kind, taylor",
    [
        pytest.param(kind, taylor, marks=[pytest.mark.slow] * (taylor or kind != "invisible-invisible"))
        for kind in FOLDS
        for taylor in (False, True)
    ],
)
def test_unique_until_the_two_fold(kind, taylor):
    """Before it the only solution, behind it not, whatever the step length."""
    *_, met, exact = FOLDS[kind]
    ends = met * PARTS
    for tol, (unique, fine, y1, mode) in zip(TOLERANCES, through(kind, taylor)):
        np.testing.assert_array_equal(unique, ends < met)
        assert np.all(fine)
        for t, y, m in zip(ends, y1, mode):
            # In space what happens to w at 0/0 is rounding: the solution may leave there at once.
            if t < met or kind != "invisible-invisible":
                assert m == 0
                np.testing.assert_allclose(y, exact(float(t)), atol=20 * tol)


def test_what_comes_behind_is_a_solution():
    """Whichever of the infinitely many is taken: in space u' = 1 + V as long as it slides or crosses, on both sides."""
    unique, _, y1, _ = through("invisible-invisible", False)[-1]
    assert not unique[-1]
    np.testing.assert_allclose(y1[-1, 0] + y1[-1, 1], 1.6 - 4.0, atol=1e-6)


@pytest.mark.parametrize("x", [0.0, 0.4])
@pytest.mark.parametrize("kind", [pytest.param("visible-visible", marks=pytest.mark.slow), "visible-invisible"])
def test_start_at_it_or_behind(kind, x):
    """At the two-fold a visible side is left to, and nothing is unique; behind it a side must be chosen."""
    sol = solve(FOLDS[kind][0], 0.0, 0.3, VerticalPlane(x, 0.0), throw=False)
    assert not sol.unique
    assert sol.result == (RESULTS.successful if x == 0 else RESULTS.repulsive_sliding)


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 0.4])
@pytest.mark.parametrize("kind", ["visible-visible", "visible-invisible"])
def test_start_in_a_mode_that_is_chosen(kind, x):
    """To slide from the very point has no field: λ = 0/0."""
    for mode in (0, 1):
        sol = solve(FOLDS[kind][0], 0.0, 0.3, VerticalPlane(x, 0.0), mode={"side": mode}, throw=False)
        undefined = (x, mode) == (0.0, 0)
        assert not sol.unique and sol.mode1 == mode
        assert sol.result == (RESULTS.nonfinite_field if undefined else RESULTS.successful)


class Beside(nsjax.System):
    """The planar fold, and a block that rubs beside it; or that carries it."""

    feed: float = 0.0

    def vector_field(self, t, y, s):
        return Space(jnp.ones_like(y.x), 0.5 - s.rub, y.x * s.side + self.feed * s.rub)

    @nsjax.sgn
    def side(self, t, y):
        return y.z

    @nsjax.sgn
    def rub(self, t, y):
        return y.y


@pytest.mark.slow
@pytest.mark.parametrize("feed", [0.0, 0.2])
def test_beside_another_surface(feed):
    """Pitfall 38: repulsion of one of two surfaces that are slid on. With `feed` λ_side = -feed / (2 x): it leaves
    where that is 1, before the two-fold."""
    before, after = (solve(Beside(feed), 0.0, t1, Space(-1.0, 0.0, 0.0)) for t1 in (0.85, 1.5))
    assert before.unique and list(before.mode1) == [0, 0]
    if feed:
        np.testing.assert_allclose(after.events[0].t, 0.9, rtol=1e-6)
        assert after.unique and list(after.mode1) == [1, 0]
    else:
        assert not after.unique and len(after.events) == 0
        np.testing.assert_allclose(flat(after.y1), [0.5, 0, 0], atol=1e-9)


class Turning(nsjax.System):
    """A surface that is not affine, and attracts where it is slid on: z = sin x, with fields that point at it."""

    def vector_field(self, t, y, s):
        return VerticalPlane(jnp.ones_like(y.x), -2 * s.side + 0 * y.z)

    @nsjax.sgn
    def side(self, t, y):
        return y.z - jnp.sin(y.x)


def test_sliding_that_stays_attracted():
    """M_kk that is not constant is no matter while it keeps its sign."""
    sol = solve(Turning(), 0.0, 10.0, VerticalPlane(0.0, 1.0), stepsize_controller=pid(1e-9))
    assert sol.unique and sol.mode1 == 0
    np.testing.assert_allclose(sol.y1.z, np.sin(10.0), atol=1e-8)


def test_cost():
    """Only models in which what acts on a surface is not constant look for it."""

    def steady(system, y0):
        return SwitchedSystem(system, jnp.ones(()), jnp.zeros(()), jax.tree.map(jnp.asarray, y0)).steady

    assert not any(steady(system, y0) for system, y0, *_ in FOLDS.values())
    assert steady(Turning(), VerticalPlane(0.0, 0.0)) and not steady(Beside(), Space(0.0, 0.0, 0.0))
    assert steady(nsjax.gallery.StickSlip(), Motion(0.0, 0.0))
