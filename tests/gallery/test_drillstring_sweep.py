"""The hysteresis of a slow sweep of the drillstring (section A.10), against the points where branches begin and end."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from drillstring import B_1, C, D, K, K_B, M_A, M_F, MU, R, R_C

import nsjax
from nsjax import gallery


def rolling(omega):
    """The radius at which the rotor rolls: (A.30) in (A.31)."""
    stiff = K + K_B - omega**2 * M_F / 4
    roots = np.roots([B_1, 0.0, stiff, -(K_B * R_C + M_F * omega**2 * R), -M_A * R**2 * omega**2])
    return max(x.real for x in roots if abs(x.imag) < 1e-9)


def last_rolling():
    """Point d, where friction is at its bound: (A.32)."""

    def excess(omega):
        r = rolling(float(omega))
        along = -(C + D) * R * omega - D * omega / 2 * r
        return MU * K_B * (r - R_C) + along

    return float(mp.findroot(excess, (0.4, 0.45), solver="anderson"))


@pytest.mark.slow
def test_turned_up_it_leaves_p1_and_turned_down_it_rolls_until_d():
    """P1 is stable below its Neimark-Sacker point, 2.25601 rad/s; beyond the fold of P4, 3.43908 rad/s, rolling is all
    that is left; and it ends at d."""
    # After a step rolling rings, by half in some 18 s: it is given time, and told from other motion to 5e-3.
    up = [2.1, 2.2, 2.24, 2.3, 2.36, 2.4, 3.0, 3.45, 3.45, 3.45]
    down = [3.0, 2.6, 2.2, 2.2, 1.5, 1.0, 0.7, 0.5, 0.46, 0.42]
    system = gallery.EccentricDrillstringScene(f_0=1e-3)
    swept = nsjax.brute_force(system, "omega", jnp.array(up + down), system.state(), carry=True, transient=30, keep=10)
    assert (swept.result == nsjax.RESULTS.successful).all()
    r = np.hypot(swept.ys.q.x, swept.ys.q.y)[:, 0]
    rising, falling = dict(zip(up, r)), dict(zip(down, r[len(up) :]))
    d = last_rolling()
    assert 0.42 < d < 0.43
    for omega in up:
        if omega < 2.256:
            assert rising[omega].max() < 0.01  # P1: the rotor stays in the middle
        elif omega > 2.35:
            assert rising[omega].max() > 0.5  # it does not
        if omega > 3.43908:
            np.testing.assert_allclose(rising[omega], rolling(omega), atol=5e-3)
    for omega in down:
        if d < omega < 2.3:
            np.testing.assert_allclose(falling[omega], rolling(omega), atol=5e-3)
        elif omega < d:
            assert falling[omega].max() < 0.01
    assert rising[2.2].max() < 0.01 < 1 < falling[2.2].min()  # the loop: two motions at one speed
