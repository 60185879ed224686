"""Virtual branches: what the segments of an orbit do beyond a corner at which they are no orbit any more."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from branches import continue_orbit, orbit_of
from models import Motion

from nsjax import gallery, OrbitBranch, plot


def amplitude(omega):
    """Of the linear oscillator of section 6.6."""
    return np.abs(0.2 / (1 - omega**2 + 0.05j * omega))


@pytest.fixture(scope="module")
def trilinear():
    """Section 6.6, through ω_A, from where there is no contact."""
    omega = 0.88
    x = 0.2 / (1 - omega**2 + 0.05j * omega)
    system = gallery.Trilinear(omega=omega)
    orbit = orbit_of(system, Motion(x.imag, x.real * omega))
    return continue_orbit(system, orbit, "omega", (0.87, 0.92), virtual=True, max_step=0.1)


@pytest.mark.slow
def test_without_contact(trilinear):
    """At ω_A contact begins; without it the oscillator would go on as a linear one does."""
    (corner,) = trilinear.special_points
    assert corner.kind == "none" and trilinear.admissible.all() and len(trilinear.branches) == 3
    free, _ = trilinear.others
    assert not free.admissible.any() and free.special == ()
    assert free.ends == (f"{corner.name} at omega = {corner.value:.6g}", "omega = 0.92")
    np.testing.assert_allclose(free.values[0], corner.value, atol=1e-12)
    np.testing.assert_allclose(free.high.x, amplitude(free.values), rtol=1e-4)
    np.testing.assert_allclose(free.low.x, -free.high.x, rtol=1e-4)
    modulus = np.exp(-0.05 * free.periods[1:] / 2)  # the first has the multipliers of the corner
    np.testing.assert_allclose(np.abs(free.multipliers[1:]), np.stack([modulus, modulus], axis=1), rtol=1e-8)
    with pytest.raises(
        ValueError, match="must be that of an orbit of the system, but point 5 of this branch is virtual"
    ):
        free.orbit(5)


@pytest.mark.slow
def test_negative_durations(trilinear):
    """The orbit with contact ends where that lasts for no time; beyond, time runs backwards in contact. The parameter
    turns back there: it changes with the square of the duration, by one series on both sides."""
    (corner,) = trilinear.special_points
    _, mirrored = trilinear.others

    def contact(branch, index):
        return min((s.duration for s in branch.segments[index] if 1 in s.mode), key=abs)

    real = [(trilinear.values[i] - corner.value, contact(trilinear, i))
            for i in range(trilinear.indices[0] + 3, len(trilinear))]  # fmt: skip
    virtual = [(mirrored.values[i] - corner.value, contact(mirrored, i)) for i in range(1, len(mirrored))]
    assert len(virtual) > 3 and not mirrored.admissible.any()
    assert min(d for _, d in real) > 0 and max(d for _, d in virtual) < 0
    off, d = np.array([pair for pair in [*real, *virtual] if abs(pair[1]) < 0.04]).T
    series = np.polynomial.Polynomial.fit(d, off / d**2, 3)
    assert min(np.sum(d > 0), np.sum(d < 0)) > 3
    np.testing.assert_allclose(off / d**2, series(d), rtol=1e-3)


@pytest.mark.slow
def test_told_and_drawn(trilinear, tmp_path):
    lines = str(trilinear).splitlines()
    assert lines[0] == "1 branch of periodic orbits of Trilinear, 2 virtual"
    assert sum(line.endswith("points, virtual") for line in lines) == 2
    ax = plot.orbit_diagram(trilinear)
    drawn = [line for line in ax.lines if line.get_color() == "0.6"]
    assert len(drawn) == 2 and {line.get_linestyle() for line in drawn} == {":"}
    assert [line.get_label() for line in ax.lines].count("virtual") == 1
    assert "virtual" in [text.get_text() for text in ax.get_legend().get_texts()]
    assert "virtual" not in [line.get_label() for line in plot.multiplier_diagram(trilinear).lines]
    plt.close("all")
    trilinear.save(tmp_path / "branch")
    again = OrbitBranch.load(tmp_path / "branch", gallery.Trilinear())
    assert str(again) == str(trilinear) and [b.admissible.any() for b in again.branches] == [True, False, False]
