"""The drillstring of Appendix A in the complex plane, z = x + iy: for numbers of any kind, those of mpmath too;
and its periodic orbits by scipy."""

import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root


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
    bit = -T_0 * s[2] / (1 + DELTA * (s[2] * theta if abs(s[2]) == 1 else abs(theta)))  # smooth at θ' = 0
    twist = (-K_PHI * phi + bit + along * R - fluid.imag * r) / J
    return u, a.real + r * Omega**2, (a.imag - 2 * u * Omega) / r, w, twist


def regions(r, u, Omega, phi, w, omega):
    """The values of the switches in the region of a state."""
    theta, pushes = omega + w, r > R_C and K_B * (r - R_C) + C_B * u > 0
    return (1 if pushes else -1), (1 if r * Omega + R * theta > 0 else -1), (1 if theta > 0 else -1)


# Periodic orbits, arc by arc: scipy, with the variational equations and saltation matrices.

CONTACT, RELEASE, STOP, SLIP = "contact", "release", "stop", "slip"  # what ends an arc


def field(y, omega, s):
    """(A.51), and while the bit sticks its angular velocity stays what it is."""
    f = np.array(drillstring(*y, omega, s))
    if s[2] == 0:
        f[4] = 0.0
    return f


def ending(event, y, omega, s):
    """What comes down to zero at the end of an arc."""
    r, u, _, _, w = y
    if event == CONTACT:
        return R_C - r
    if event == RELEASE:
        return K_B * (r - R_C) + C_B * u
    if event == STOP:
        return s[2] * (omega + w)
    torque = drillstring(*y, omega, (*s[:2], 0))[4] * J  # what friction has to balance: at most T_0
    return T_0 - torque


def slope(of, y, step=1e-6):
    """Derivative by the state, by central differences of fourth order."""
    columns = []
    for e in np.eye(len(y)):
        near, far = (of(y + h * e) - of(y - h * e) for h in (step, 2 * step))
        columns.append((8 * near - far) / (12 * step))
    return np.array(columns).T


def lap(y, time, omega, arcs, field=field, ending=ending):
    """The state after a time, and its derivative by the first one.

    - `arcs`: values of the switches and the event that ends each arc; the last one ends with the time.
    - `field`, `ending`: the equations, and what ends an arc.
    """
    n, t, phi = len(y), 0.0, np.eye(len(y))
    for k, (s, event) in enumerate(arcs):

        def both(t, z, s=s):
            y, phi = z[:n], z[n:].reshape(n, n)
            return np.append(field(y, omega, s), slope(lambda y: field(y, omega, s), y) @ phi)

        def over(t, z, s=s, event=event):
            return ending(event, z[:n], omega, s)

        over.terminal, over.direction = True, -1
        start = np.append(y, phi)
        events = None if event is None else over
        arc = solve_ivp(both, (t, time), start, "DOP853", events=events, rtol=1e-12, atol=1e-13)
        if event is not None and arc.status != 1:
            raise ArithmeticError(f"no {event} before t = {time}")
        t, y, phi = arc.t[-1], arc.y[:n, -1], arc.y[n:, -1].reshape(n, n)
        if event is not None:
            normal = slope(lambda y, e=event, s=s: ending(e, y, omega, s), y)
            before, after = field(y, omega, s), field(y, omega, arcs[k + 1][0])
            salt = np.eye(n) + np.outer(after - before, normal) / (normal @ before)
            if event == STOP and arcs[k + 1][0][2] == 0:
                salt = (np.eye(n) - np.outer(np.eye(n)[4], np.eye(n)[4])) @ salt  # w = -ω from now on
            phi = salt @ phi
    return y, phi


def of_fold(monodromy):
    """Zero where a second multiplier is 1: derivative at 1 of the characteristic polynomial."""
    return np.polyval(np.polyder(np.poly(monodromy)), 1.0)


def of_flip(monodromy):
    return np.linalg.det(monodromy + np.eye(len(monodromy)))


def of_neimark_sacker(monodromy):
    """Zero where a pair has modulus one: the largest one off the real axis."""
    rho = np.linalg.eigvals(monodromy)
    return np.max(np.abs(rho[np.abs(rho.imag) > 1e-3])) - 1


def solved(residual, guess):
    """MINPACK's root, and two of Newton's steps with better derivatives."""
    z = root(residual, guess, options=dict(xtol=1e-12, eps=1e-14)).x
    for _ in range(2):
        z = z - np.linalg.solve(slope(residual, z, 1e-5), residual(z))
    return z


def special_point(y, time, omega, arcs, test):
    """The orbit near a given one at which a test function of its monodromy matrix is zero: state, period, parameter,
    multipliers. The state is sought at right angles to the flow through the given one."""
    y = np.array(y, float)
    along = field(y, omega, arcs[0][0])

    def residual(z):
        end, phi = lap(z[:5], z[5], z[6], arcs)
        return np.concatenate([end - z[:5], [along @ (z[:5] - y), test(phi)]])

    z = root(residual, np.concatenate([y, [time, omega]]), options=dict(xtol=1e-12, eps=1e-14)).x
    return z[:5], z[5], z[6], np.linalg.eigvals(lap(z[:5], z[5], z[6], arcs)[1])


# The branches P1 to P6, from points of branches that were followed.

TESTS = {"fold": of_fold, "flip": of_flip, "Neimark-Sacker": of_neimark_sacker}
FREE, TOUCH = (-1, 1, 1), (1, 1, 1)
# P2 from where it touches: slip forwards, backwards, stick, slip forwards. P4 from its lowest speed on.
OF_P2 = [(FREE, STOP), ((-1, 1, -1), STOP), ((-1, 1, 0), SLIP), (FREE, None)]
OF_P4 = [(FREE, CONTACT), (TOUCH, RELEASE), (FREE, None)]


def arcs_of(branch, i):
    """The modes of an orbit from its base point on, and what ends each."""
    arcs = []
    for segment in branch.segments[i]:
        wall, roll, bit = segment.mode
        event = None
        if segment.ends == "wall":
            event = CONTACT if wall < 0 else RELEASE
        elif segment.ends == "bit":
            event = SLIP if bit == 0 else STOP
        arcs.append(((wall, 1 if wall < 0 else roll, bit), event))
    return arcs


def flat(tree):
    return np.array([float(x) for x in jax.tree.leaves(tree)])


def at(ys, i):
    return flat(jax.tree.map(lambda x: x[i], ys))


def smooth_point(branch, i, kind):
    """`special_point` from a point of a branch, for one of its kind."""
    return special_point(at(branch.ys, i), branch.periods[i], branch.values[i], arcs_of(branch, i), TESTS[kind])


def touching(y, period, omega, arcs=((FREE, None),)):
    """The orbit that touches the stator, without contact: state there (u = 0, r = R_c), period, parameter."""

    def residual(z):
        start = np.array([1.0, 0.0, *z[:3]])
        return lap(start, z[3], z[4], arcs)[0] - start

    z = solved(residual, [*y[2:], period, omega])
    return np.array([1.0, 0.0, *z[:3]]), z[3], z[4]


def _slowest(omega):
    def event(t, y):
        return field(y, omega, FREE)[4]

    event.terminal, event.direction = True, 1
    return event


def just_stopping(branch, i, special):
    """The orbit of P4 that just comes to θ' = 0, beside a special point: state there (w = -ω, w' = 0), period,
    parameter."""
    j = next(j for j in (i, i + 1) if len(branch.segments[j]) <= 4)
    y, period = at(branch.ys, j), branch.periods[j]
    stop = solve_ivp(
        lambda t, y: field(y, special.value, FREE), (0, 6), lap(y, 2.7, special.value, OF_P4)[0], "DOP853",
        events=_slowest(special.value), rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    guess = stop.y_events[0][0]

    def residual(z):
        start = np.array([*z[:4], -z[5]])
        return np.append(lap(start, z[4], z[5], OF_P4)[0] - start, field(start, z[5], FREE)[4])

    z = solved(residual, [*guess[:4], period, special.value])
    return np.array([*z[:4], -z[5]]), z[4], z[5]


def whirl_of_p1(omega):
    """The largest modulus of the multipliers of a small whirl while the bit slips to and fro, by scipy: the rotor's
    equation is linear in the complex plane, and its coefficients follow the bit."""

    def equations(t, x, side):
        phi, w, (z, v) = x[0].real, x[1].real, x[2:].reshape(2, 2)
        small = 1e-150  # whose square is zero
        a = [whirl(small * one, small * rate, omega + w, 0.0)[0] / small for one, rate in zip(z, v)]
        return np.array([w, -phi - side * T_0 / (1 + DELTA * side * (omega + w)), *v, *a], complex)

    def stands(t, x, side):
        return side * (x[1].real + omega)

    stands.terminal, stands.direction = True, -1
    phi = -0.25
    for _ in range(12):  # the orbit attracts
        x = np.array([phi, -omega, 1, 0, 0, 1], complex)
        for side in (1, -1):
            arc = solve_ivp(
                equations, (0, 30), x, "DOP853", events=stands, args=(side,), first_step=1e-3, rtol=1e-12, atol=1e-14
            )
            x = arc.y[:, -1]
        phi = x[0].real
    return np.max(np.abs(np.linalg.eigvals(x[2:].reshape(2, 2))))
