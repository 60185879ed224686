"""Generalized Jacobians against their closed forms in chapter 5."""

import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

from nsjax import gallery
from nsjax.setvalued import eigenvalue_crossings, generalized_jacobian


def test_section_5_7():
    """(5.33): at the origin four kinks meet for μ = 0; and the crossings at q = 1/4 and 3/4 of Fig. 5.13."""
    left = generalized_jacobian(gallery.HopfPitchfork(mu=-1.0), gallery.Plane(0.0, 0.0))
    right = generalized_jacobian(gallery.HopfPitchfork(mu=1.0), gallery.Plane(0.0, 0.0))
    assert left.surfaces == right.surfaces == ()
    np.testing.assert_allclose(left.vertices, [[0, 1], [-3, 1]])
    np.testing.assert_allclose(right.vertices, [[0, 1], [1, -3]])
    found = eigenvalue_crossings(left.vertices, right.vertices)
    np.testing.assert_allclose([c.q for c in found], [0.25, 0.75], atol=1e-14)
    both = generalized_jacobian(gallery.HopfPitchfork(mu=0.0), gallery.Plane(0.0, 0.0))
    assert both.surfaces == ("left", "right", "below", "above") and both.vertices.shape == (2,) * 4 + (2, 2)
    corners = both.vertices.reshape(-1, 2, 2)
    for vertex in left.vertices, right.vertices:
        assert any(np.allclose(vertex, corner) for corner in corners)


def test_by_a_parameter():
    """|x + μ| by μ is its slope, one on each side."""
    found = generalized_jacobian(gallery.HopfPitchfork(mu=1.0), gallery.Plane(1.0, 0.0), parameter="mu")
    assert found.surfaces == ("right",)
    np.testing.assert_allclose(found.vertices, [[[0, 1], [1, -3]], [[0, 1], [-1, -3]]])
    np.testing.assert_allclose(found.by_parameter, [[0, 0], [0, 2]])
    assert "right < 0: [0 1; 1 -3]" in str(found)


def test_it_jumps():
    with pytest.raises(ValueError, match="field of `StickSlip` jumps by 2 on the surface of belt"):
        generalized_jacobian(gallery.StickSlip(), Motion(0.3, 0.2))
    one = generalized_jacobian(gallery.StickSlip(c=0.1), Motion(0.3, 0.1))
    np.testing.assert_allclose(one.vertices, [[0, 1], [-1, -0.1]])


def test_unknown_parameter():
    with pytest.raises(ValueError, match="`parameter` must be one of m, c, k"):
        generalized_jacobian(gallery.StickSlip(), Motion(0.3, 0.1), parameter="mass")


def test_float32():
    y = gallery.Plane(jnp.float32(1.0), jnp.float32(0.0))
    found = generalized_jacobian(gallery.HopfPitchfork(mu=jnp.float32(1.0)), y)
    assert found.vertices.dtype == jnp.float32 and found.vertices.shape == (2, 2, 2)
