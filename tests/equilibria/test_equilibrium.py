"""Equilibria in regions, on surfaces, and virtual ones, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import find_equilibria, find_equilibrium, gallery, RESULTS


def test_in_a_region():
    """The focus of section 6.7 at x = F_slip / k, and its derivatives by all parameters."""

    def focus(p):
        found = find_equilibrium(gallery.StickSlip(c=p[0], k=p[1], F_slip=p[2]), Motion(0.8, 0.1), throw=False)
        return jnp.stack([found.y.x, found.y.v, jnp.max(found.eigenvalues.real), jnp.max(found.eigenvalues.imag)])

    p = jnp.array([0.1, 1.2, 0.9])
    exact = [0.9 / 1.2, 0.0, -0.05, np.sqrt(1.2 - 0.05**2)]
    np.testing.assert_allclose(focus(p), exact, atol=1e-14)
    w = exact[3]
    by = [[0, -0.9 / 1.44, 1 / 1.2], [0, 0, 0], [-0.5, 0, 0], [-0.1 / (4 * w), 0.5 / w, 0]]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(focus))(p), by, atol=1e-13)
    found = find_equilibrium(gallery.StickSlip(c=0.1), Motion(0.8, 0.1))
    assert found.stable and found.admissible and not found.boundary and found.isolated and found.held == 0
    assert "stable equilibrium of StickSlip" in str(found) and "-0.05+0.998749j" in str(found)


@pytest.mark.parametrize("mu", [-1.0, -0.3, 0.3, 1.0])
def test_section_5_7(mu):
    """(5.33)-(5.35): an unstable focus, or a saddle between two stable nodes; the virtual nodes are left out."""
    x = jnp.linspace(-3, 3, 7)
    found = find_equilibria(gallery.HopfPitchfork(mu=mu), gallery.Plane(x, 0 * x))
    at = {round(float(e.y.x1) / abs(mu), 8) + 0.0: e for e in found}
    origin = at[0.0]
    if mu < 0:
        assert set(at) == {0.0} and not origin.stable
        np.testing.assert_allclose(origin.eigenvalues, [0.5 + 0.5j * np.sqrt(11), 0.5 - 0.5j * np.sqrt(11)], atol=1e-12)
    else:
        assert set(at) == {-2.0, 0.0, 2.0} and not origin.stable
        np.testing.assert_allclose(origin.eigenvalues, [-1.5 + np.sqrt(13) / 2, -1.5 - np.sqrt(13) / 2], atol=1e-12)
        for side in -2.0, 2.0:
            assert at[side].stable
            np.testing.assert_allclose(at[side].eigenvalues, [-1.5 + np.sqrt(5) / 2, -1.5 - np.sqrt(5) / 2], atol=1e-12)


def test_on_a_surface():
    """Pseudo-equilibria: on (2.3) with λ = 1/2; a block held by friction (2.28); a ball at rest on a floor."""
    point = find_equilibrium(gallery.SlidingPoint(), gallery.Line(0.3))
    np.testing.assert_allclose([point.y.x, point.multipliers[0]], [0, 0.5], atol=1e-14)
    assert list(point.mode) == [0] and point.stable and point.held == 1 and np.all(np.isnan(point.eigenvalues))
    assert find_equilibrium(gallery.FallingFrictionBlock(), gallery.Slip(0.0)).multipliers[0] == 0.75
    ball = find_equilibrium(gallery.BouncingBall(), Motion(0.3, 0.0))
    np.testing.assert_allclose([*ball.y, *ball.multipliers], [0, 0, 9.81], atol=1e-12)
    assert ball.held == 2 and ball.admissible and "floor +1" in str(ball)


class Valley(nsjax.System):
    """x' = -a s + b, y' = -y + x on the line x = 0: slides, and settles there at y = 0."""

    a: float = 2.0
    b: float = 0.5

    def vector_field(self, t, y, s):
        return gallery.Plane(-self.a * s.line + self.b, 0.3 - 3 * y.x2 + y.x1)

    @nsjax.sgn
    def line(self, t, y):
        return y.x1


def test_sliding():
    """With the eigenvalue of what can still move, along the surface."""
    found = find_equilibrium(Valley(), gallery.Plane(1.0, 1.0))
    np.testing.assert_allclose([*found.y, *found.multipliers], [0, 0.1, 0.25], atol=1e-14)
    np.testing.assert_allclose(found.eigenvalues[0], -3, atol=1e-12)
    assert found.held == 1 and np.isnan(found.eigenvalues[1]) and found.stable
    # With a < 0 the line repels; with b > a it cannot hold.
    assert not find_equilibrium(Valley(a=-2.0), gallery.Plane(0.0, 1.0), mode={"line": 0}).stable
    virtual = find_equilibrium(Valley(b=3.0), gallery.Plane(0.0, 1.0), mode={"line": 0})
    assert not virtual.admissible and np.isclose(virtual.multipliers[0], 1.5) and "virtual" in str(virtual)


def test_virtual():
    """Asked for in a region where it does not lie."""
    found = find_equilibrium(gallery.StickSlip(v_dr=0.2), Motion(0.0, 0.5), mode={"belt": 1})
    np.testing.assert_allclose([*found.y], [-1, 0], atol=1e-14)
    assert not found.admissible
    x = jnp.linspace(-2.0, 2.0, 5)
    every = find_equilibria(gallery.StickSlip(v_dr=0.2), Motion(x, 0 * x), virtual=True)
    assert [bool(e.admissible) for e in every] == [True, False]


def test_continuum():
    """A mass at rest on rough ground may be anywhere that friction holds: the nearest place is found, and it is told."""

    class Rough(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - s.ground)

        @nsjax.sgn
        def ground(self, t, y):
            return y.v

    found = find_equilibrium(Rough(), Motion(0.4, 0.0))
    np.testing.assert_allclose([*found.y, *found.multipliers], [0.4, 0, -0.4], atol=1e-12)
    assert not found.isolated and found.admissible and found.residual < 1e-12


def test_many_at_once():
    @jax.jit
    @jax.vmap
    def run(F):
        found = find_equilibrium(gallery.StickSlip(F_slip=F), Motion(0.8, 0.1), throw=False)
        return found.y.x, found.result

    x, result = run(jnp.array([0.5, 1.0, jnp.nan]))
    np.testing.assert_allclose(x[:2], [0.5, 1.0], atol=1e-14)
    assert list(result == RESULTS.successful) == [True, True, False]


def test_there_is_none():
    system = gallery.TransversalIntersection()
    with pytest.raises(Exception, match="No equilibrium was found"):
        find_equilibrium(system, gallery.Plane(0.0, 2.0))
    assert find_equilibria(system, gallery.Plane(jnp.zeros(2), jnp.ones(2))) == []


def test_time_enters():
    with pytest.raises(ValueError, match="`Trilinear` has no equilibrium, because time enters its vector field"):
        find_equilibrium(gallery.Trilinear(), Motion(0.0, 0.0))


class Curved(nsjax.System):
    """Slides on a curved surface, along which its pseudo-equilibrium moves with p."""

    p: float = 0.3

    def vector_field(self, t, y, s):
        x, z, w = y
        rate = self.p - x + 0.3 * w + 0.2 * z * s.sheet
        return jnp.stack([rate, 0.5 * x - 0.4 * w * z - s.sheet + 0.1, -w + x * z + 0.3 * s.sheet])

    @nsjax.sgn
    def sheet(self, t, y):
        return y[1] - y[0] ** 2 - 0.5 * y[2] ** 2


@pytest.mark.slow
def test_derivatives_of_eigenvalues_on_a_curved_surface():
    def roots(p):
        guess = jnp.array([0.3, 0.1, 0.0])
        return find_equilibrium(Curved(p=p), guess, mode={"sheet": 0}, throw=False).eigenvalues[:2].real

    step = 1e-5
    differences = (roots(0.3 + step) - roots(0.3 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(roots)(0.3), differences, rtol=1e-8)
