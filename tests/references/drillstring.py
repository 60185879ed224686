"""The drillstring of Appendix A in the complex plane, z = x + iy: for numbers of any kind, those of mpmath too."""

# Appendix C.6.
M = M_F = K = R_C = J = K_PHI = 1.0
C, D, B_1, K_B, C_B, MU, R, T_0, DELTA = 0.3, 0.1, 0.1, 50.0, 30.0, 0.5, 2.0, 0.2, 0.3
M_A, BETA = M + M_F, D / (C + D)


def whirl(z, v, theta, f_b):
    """z'' of the rotor's middle z = x + iy by (A.2), (A.13), and the fluid's force, under the contact force f_b."""
    drag, stiff = D, B_1 * abs(z) ** 2
    rest = 1j * M_F * theta * v + M_F * theta**2 / 4 * z - drag * (v - 0.5j * theta * z) - stiff * z
    a = (-C * v - K * z + rest + f_b) / M_A
    return a, rest - M_F * a


def contact(r, u, v_rel, touch, roll):
    """F_bN and F_bT, section 3.5 and (A.6)."""
    normal = (K_B * (r - R_C) + C_B * u) if touch > 0 else 0.0
    return normal, -MU * roll * normal


def drillstring(r, u, Omega, phi, w, omega, s):
    """(A.51), for values s of the switches."""
    theta = omega + w
    normal, along = contact(r, u, r * Omega + theta * R, s[0], s[1])
    a, fluid = whirl(r, u + 1j * r * Omega, theta, -normal + 1j * along)
    bit = -T_0 * s[2] / (1 + DELTA * abs(theta))
    twist = (-K_PHI * phi + bit + along * R - fluid.imag * r) / J
    return u, a.real + r * Omega**2, (a.imag - 2 * u * Omega) / r, w, twist


def regions(r, u, Omega, phi, w, omega):
    """The values of the switches in the region of a state."""
    theta, pushes = omega + w, r > R_C and K_B * (r - R_C) + C_B * u > 0
    return (1 if pushes else -1), (1 if r * Omega + R * theta > 0 else -1), (1 if theta > 0 else -1)
