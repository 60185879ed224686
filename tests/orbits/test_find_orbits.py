"""The search for several orbits at once."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion, pid

import nsjax
from nsjax import find_orbit, find_orbits, gallery


METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), max_steps=2048, max_events=10)


class Rings(nsjax.System):
    """In polar coordinates r' = r (r² - 1) (4 - r²)/20, φ' = 1: an unstable orbit r = 1 around a stable focus, and a
    stable one r = 2 around both."""

    def vector_field(self, t, y, s):
        r2 = y.x**2 + y.v**2
        growth = (r2 - 1) * (4 - r2) / 20
        return Motion(growth * y.x - y.v, growth * y.v + y.x)


@pytest.mark.slow
def test_rings():
    """Whatever the base points, each ring is found once; the focus is none."""
    angle = jnp.arange(12.0)
    radius = jnp.array([0.01, 0.97, 1.03, 1.95, 2.0, 2.1] * 2)
    orbits = find_orbits(Rings(), Motion(radius * jnp.cos(angle), radius * jnp.sin(angle)), period=6.2, **METHOD)
    radii = [float(np.hypot(*orbit.y0)) for orbit in orbits]
    assert sorted(round(r, 9) for r in radii) == [1, 2]
    for orbit, r in zip(orbits, radii):
        rate = (2 * r**2 * (4 - r**2) - 2 * r**2 * (r**2 - 1)) / 20
        other = np.exp(2 * np.pi * rate)
        np.testing.assert_allclose(np.sort(orbit.multipliers.real), sorted([1, other]), rtol=1e-8)
        assert orbit.stable == (r > 1.5) and orbit.trivial.sum() == 1
        # The Poincaré map (6.7), whatever its section.
        for normal in None, Motion(0.3, 1.0) if abs(orbit.y0.x) > 0.5 else Motion(1.0, 0.1):
            found = np.linalg.eigvals(orbit.poincare_derivative(normal))
            np.testing.assert_allclose(sorted(found.real), sorted([0, other]), atol=1e-8)
        assert np.isclose(orbit.period, 2 * np.pi, rtol=1e-11)


def test_symmetric():
    """y(t + T/2) = -y(t), by half of the period, of an autonomous system."""
    orbit = find_orbit(Rings(), Motion(1.9, 0.1), period=6.2, symmetry="inversion", **METHOD)
    np.testing.assert_allclose(np.hypot(*orbit.y0), 2, atol=1e-10)
    np.testing.assert_allclose(orbit.period, 2 * np.pi, atol=1e-10)


@pytest.mark.slow
def test_infinitely_unstable():
    """Section 6.7 in backward time: one orbit, though its solutions from different base points leave it."""
    x, v = jnp.linspace(0.7, 1.6, 8), jnp.linspace(-0.3, 0.1, 8)
    orbits = find_orbits(gallery.thesis("6.7"), Motion(x, v), period=6.4, backward=True, **METHOD)
    assert [len(orbits), *map(int, np.isinf(orbits[0].multipliers))] == [1, 1, 0]


@pytest.mark.slow
def test_none():
    far = Motion(jnp.array([0.01, 0.02]), jnp.array([0.0, 0.01]))
    assert find_orbits(Rings(), far, period=6.2, **METHOD) == []


@pytest.mark.slow
def test_section_6_6():
    """At ω = 1.15 two stable orbits, with contact and without, and an unstable one with contact; that also by segments."""
    x, v = jnp.meshgrid(jnp.linspace(-1.6, 1.6, 9), jnp.linspace(-1.6, 1.6, 7))
    orbits = find_orbits(gallery.thesis("6.6"), Motion(x.ravel(), v.ravel()), **METHOD)
    assert [(bool(orbit.stable), len(orbit.events)) for orbit in orbits] == [(True, 4), (True, 0), (False, 4)]
    # Without contact it is a linear oscillator.
    w = 1.15
    amplitude = 0.2 / (1 - w**2 + 0.05j * w)
    np.testing.assert_allclose([*orbits[1].y0], [amplitude.imag, (amplitude * w).real], atol=1e-10)
    unstable = orbits[2]
    again = find_orbit(gallery.thesis("6.6"), unstable.y0, method="segments", **METHOD)
    np.testing.assert_allclose(again.y0, unstable.y0, atol=1e-9)
    np.testing.assert_allclose(again.multipliers, unstable.multipliers, atol=1e-8)


@pytest.mark.slow
def test_kept_in_a_folder(tmp_path):
    """A second call searches for nothing, on whatever devices; another search is refused."""
    angle = jnp.arange(6.0)
    starts = Motion(1.95 * jnp.cos(angle), 1.95 * jnp.sin(angle))
    (orbit,) = find_orbits(Rings(), starts, period=6.2, path=tmp_path, **METHOD)
    np.testing.assert_allclose(np.hypot(*orbit.y0), 2, atol=1e-9)
    (block,) = (tmp_path / "blocks").iterdir()
    before = block.stat().st_mtime_ns
    (again,) = find_orbits(Rings(), starts, period=6.2, path=tmp_path, devices=1, **METHOD)
    assert block.stat().st_mtime_ns == before
    np.testing.assert_array_equal([*again.y0], [*orbit.y0])
    np.testing.assert_allclose(again.solve().y1, orbit.y0, atol=1e-9)
    with pytest.raises(ValueError, match="holds another sweep"):
        find_orbits(Rings(), starts, period=6.3, path=tmp_path, **METHOD)


@pytest.mark.parametrize("name, value", [("throw", True), ("segments", [])])
def test_wrong_arguments(name, value):
    with pytest.raises(ValueError, match=f"Argument `{name}` is not for `find_orbits`"):
        find_orbits(Rings(), Motion(jnp.zeros(2), jnp.ones(2)), period=6.2, **{name: value})
