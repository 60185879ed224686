"""Derivatives of the flow and of event times: first and second, against 40-digit references."""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from models import Hammer, Motion, Pair, pid, Plane, Toggle

import nsjax
from nsjax import gallery, solve


NAMES = ("v_dr", "F_slip", "k")
FLOAT = dict(v_dr=0.5, F_slip=1.0, k=1.0)
P = np.asarray([2.5, -0.5, *FLOAT.values()])  # x0, v0 and the parameters
T1 = 140.0


def stick_slip(p):
    return gallery.StickSlip(c=0.1, **dict(zip(NAMES, p[2:])))


@functools.cache
def flow(solver):
    """(p, tol) -> ((state and the times of some events), number of events and of steps) and its Jacobian."""

    def run(p, tol):
        control = dfx.PIDController(rtol=tol, atol=tol)
        sol = solve(
            stick_slip(p), 0.0, T1, Motion(p[0], p[1]),
            solver=solver, stepsize_controller=control, max_steps=50_000, max_events=64,
        )  # fmt: skip
        out = jnp.stack([*sol.y1, *sol.events.t[:3]])
        return out, (out, sol.events.num, sol.stats["num_steps"])

    return jax.jit(jax.jacfwd(run, has_aux=True))


@pytest.fixture(scope="module")
def exact():
    """State and the first three event times at T1, and their derivatives; and how many events there are."""

    def final(x, v, *changed):
        path = reference.simulate(reference.StickSlip(c=0.1, **dict(zip(NAMES, changed))), T1, (x, v))
        return [*path.y, *(e.t for e in path.events[:3])]

    at = [float(x) for x in P]
    ref = reference.solution(reference.StickSlip, T1, at[:2], wrt=NAMES, c=0.1, **FLOAT)
    events = [e[0] for e in ref.events]
    derivative = reference.derivative(final, *at)
    np.testing.assert_allclose(derivative[:2], ref.derivative, rtol=1e-14)
    return np.array([*ref.y, *events[:3]]), derivative, len(events)


@pytest.mark.slow
@pytest.mark.parametrize("solver, order", [(dfx.Tsit5(), 5), (dfx.Dopri5(), 5), (dfx.Dopri8(), 8)])
def test_errors_fall_with_the_tolerance(solver, order, exact):
    """State, event times and their derivatives by state and parameters after thirty events: the error falls as the
    tolerance (and so as the length of the steps to the power of the order), down to 1e-11; pitfall 19."""
    value, derivative, events = exact
    assert events >= 30
    tols = np.array([1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13])
    rows = []
    for tol in tols:
        jacobian, (y, num, steps) = flow(solver)(P, jnp.asarray(tol))
        assert num == events
        errors = (
            np.abs(y - value).max() / np.abs(value).max(),
            np.abs(jacobian - derivative).max() / np.abs(derivative).max(),
        )
        rows.append([int(steps), *errors])
        print(type(solver).__name__, tol, rows[-1])
    steps, *errors = np.array(rows).T
    for error in errors:
        assert error[-1] < 1e-11
        clean = (error > 3e-12) & (tols < 1e-5)
        slope, _ = np.polyfit(np.log(tols[clean]), np.log(error[clean]), 1)
        by_steps, _ = np.polyfit(np.log(steps[clean]), np.log(error[clean]), 1)
        print("slope", slope, by_steps)
        assert abs(slope - 1) < 0.1 and by_steps < -order


@pytest.mark.slow
def test_vmap_and_jacfwd_commute():
    """Also at different numbers of events in different lanes; pitfalls 17, 18."""
    speeds = jnp.linspace(0.2, 0.9, 6)

    def final(p):
        sol = solve(stick_slip(p), 0.0, 25.0, Motion(p[0], p[1]), solver=dfx.Heun(), stepsize_controller=pid(1e-4))
        return jnp.stack([*sol.y1, sol.events.t[1]]), sol.events.num

    lanes = jnp.broadcast_to(P, (6, 5)).at[:, 2].set(speeds)
    inside, num = jax.jit(jax.vmap(jax.jacfwd(final, has_aux=True)))(lanes)

    def batch(p):
        return jax.vmap(lambda row, v: final(row.at[2].add(v))[0], (None, 0))(p, speeds)

    outside = jax.jit(jax.jacfwd(batch))(jnp.asarray(P).at[2].set(0.0))
    assert len(set(num.tolist())) > 1
    np.testing.assert_allclose(inside, outside, rtol=1e-12, atol=1e-12)


def test_times_of_start_and_end():
    """d/dt0, d/dt1 of state and event times of a forced impact oscillator, and d/d(its parameters)."""

    def final(p):
        sol = solve(
            Hammer(omega=p[2], e=p[3], x_w=p[4]),
            p[0],
            p[1],
            Motion(1.0, 0.0),
            solver=dfx.Tsit5(),
            stepsize_controller=pid(1e-11),
            max_steps=9000,
        )
        return jnp.stack([*sol.y1, sol.events.t[0], sol.events.t[3]])

    def exact(t0, t1, omega, e, x_w):
        path = reference.simulate(reference.ImpactOscillator(omega=omega, e=e, x_w=x_w), t1, (1.0, 0.0), t0=t0)
        return [*path.y, path.events[0].t, path.events[3].t]

    at = [0.1, 9.0, 0.8, 0.8, 0.5]
    found, want = jax.jit(jax.jacfwd(final))(jnp.asarray(at)), reference.derivative(exact, *at)
    print(np.abs(found - want).max(), np.abs(want).max())
    np.testing.assert_allclose(found, want, atol=1e-8 * np.abs(want).max())


@pytest.mark.slow
def test_second_derivatives():
    """Pitfall 20: not silently wrong, across stick and slip."""

    def final(p):
        sol = solve(
            gallery.StickSlip(v_dr=p[2]), 0.0, 22.0, Motion(p[0], p[1]),
            solver=dfx.Bosh3(), stepsize_controller=pid(1e-9), max_steps=100_000,
        )  # fmt: skip
        return jnp.stack([*sol.y1, sol.events.t[2]])

    def exact(x, v, v_dr):
        path = reference.simulate(reference.StickSlip(v_dr=v_dr), 22.0, (x, v))
        return [*path.y, path.events[2].t]

    mp, at, h = reference.mp, [2.5, -0.5, 0.3], reference.mp.mpf("1e-10")
    want = np.zeros((3, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            total = np.zeros(3, object)
            for a in (1, -1):
                for b in (1, -1):
                    p = [mp.mpf(x) for x in at]
                    p[i] += a * h
                    p[j] += b * h
                    total = total + a * b * np.array(exact(*p))
            want[:, i, j] = want[:, j, i] = [float(x / (4 * h * h)) for x in total]
    found = jax.jit(jax.jacfwd(jax.jacfwd(final)))(jnp.asarray(at))
    print(np.abs(found - want).max(), np.abs(want).max())
    np.testing.assert_allclose(found, want, atol=1e-5 * np.abs(want).max())


class Ramp(nsjax.System):
    """x'' = w t - F Sgn(x'), breakaway b: `reference.sliding_flow`."""

    w: float = 0.8
    F: float = 1.5
    b: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.w * t - self.F * s.rub)

    @nsjax.sgn
    def rub(self, t, y):
        return y.v

    @rub.breakaway
    def rub(self):
        return self.b


def ramp(p):
    return Ramp(w=p[2], F=p[3], b=p[4])


FLOWS = {
    "crossing": (reference.crossing_flow, lambda p: Toggle(a=p[2], c=p[3]), (0.8, 0.3, 1.1, 0.2), 1),
    "sliding": (reference.sliding_flow, ramp, (0.1, 0.7, 0.8, 1.5, 1.0), 2),
    "breakaway": (reference.sliding_flow, ramp, (0.1, 0.7, 0.8, 1.5, 1.3), 2),
    "impact": (reference.impact_flow, lambda p: gallery.BouncingBall(g=p[2], e=p[3]), (0.9, 0.4, 1.2, 0.7), 1),
}


@functools.cache
def second(system, events):
    def final(p):
        sol = solve(system(p), 0.0, 3.0, Motion(p[0], p[1]), solver=dfx.Bosh3(), stepsize_controller=pid(1e-6))
        return jnp.stack([*sol.y1, *sol.events.t[:events]])

    def first(p):
        out = final(p)
        return out, out

    def both(p):
        jacobian, out = jax.jacfwd(first, has_aux=True)(p)
        return jacobian, (out, jacobian)

    return jax.jit(jax.jacfwd(both, has_aux=True))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ("crossing", "impact"))) for name in FLOWS]
)
def test_second_derivatives_by_closed_forms(name):
    """Pitfall 20: through a crossing, the start and the end of sliding, static breakaway, an impact; and of the times of
    events. The solutions are polynomials of time, on which the solver is exact."""
    flow, system, at, events = FLOWS[name]

    def exact(*p):
        return flow(3.0, *p)

    hessian, (value, jacobian) = second(system, events)(jnp.asarray(at))
    for found, want, tol in (
        (value, reference.floats(exact(*map(reference.mp.mpf, at))), 1e-10),
        (jacobian, reference.derivative(exact, *at), 1e-8),
        (hessian, reference.second_derivative(exact, *at), 1e-6),
    ):
        if name == "sliding":  # b = 1 is the least it may be
            found, want = (np.asarray(a)[(..., *[slice(4)] * (a.ndim - 1))] for a in (found, want))
        print(name, np.abs(found - want).max(), np.abs(want).max())
        np.testing.assert_allclose(found, want, rtol=tol, atol=tol)


@pytest.mark.slow
def test_two_surfaces():
    """Through sliding on one surface, on two, and the tangential exit: closed form, see `test_flow.pair_exact`."""

    def final(p):
        sol = solve(Pair(w=p[0], g=p[1], c=p[2]), 0.0, 26.0, Plane(1.0, 2.0), solver=dfx.Bosh3())
        return jnp.stack([sol.y1.x, *sol.events.t[:3]])

    def exact(w, g, c):
        t_a = (2 + c - jnp.sqrt((2 + c) ** 2 - 2 * w)) / w
        slope, bend = g - 2 + c * c / 2, -c * w / 4
        rest = 2 + (g - c - 2) * t_a - slope * t_a - bend * t_a**2
        t_b = (-slope - jnp.sqrt(slope**2 - 4 * bend * rest)) / (2 * bend)
        t_c = (4 - c * c + c * g) / (2 * w)
        return jnp.stack([w / 2 * (26.0 - t_c) ** 2, t_a, t_b, t_c])

    p = jnp.asarray([0.1, 0.5, 0.5])
    value, want = exact(*p), jnp.stack(jax.jacfwd(exact, (0, 1, 2))(*p), -1)
    found = jax.jit(jax.jacfwd(lambda p: (final(p),) * 2, has_aux=True))(p)
    np.testing.assert_allclose(found[1], value, atol=1e-10)
    print(np.abs(found[0] - want).max())
    np.testing.assert_allclose(found[0], want, atol=1e-9 * np.abs(want).max())


@pytest.mark.slow
def test_saved_states_within_a_step_to_an_event():
    """Pitfall 19: the derivative of a state saved on such a step is that of a solution which ends there."""
    ts = jnp.array([1.0, 3.6, 12.0, 13.2])  # in slip; on the one long step of stick, up to its end at 13.27

    def saved(p, t1, saveat):
        system = gallery.StickSlip(v_dr=p[2])
        sol = solve(system, 0.0, t1, Motion(p[0], p[1]), saveat=saveat, stepsize_controller=pid(1e-9))
        return jnp.stack(sol.ys)

    p = jnp.array([2.0, 0.0, 0.2])
    within = jax.jit(jax.jacfwd(lambda p: saved(p, 14.0, dfx.SaveAt(ts=ts))))(p)
    ends = jax.jit(jax.jacfwd(lambda p, t1: saved(p, t1, dfx.SaveAt(t1=True))))
    for i, t in enumerate(ts):
        np.testing.assert_allclose(within[:, i], ends(p, t)[:, 0], atol=1e-8)


@pytest.mark.slow
def test_derivative_of_what_failed():
    """Pitfall 16: who asks for the derivative alone is told too, in forward mode and in reverse."""

    def end(v, adjoint=dfx.ForwardMode()):
        return solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5), max_events=2, adjoint=adjoint).y1.x

    with pytest.raises(Exception, match="max_events"):
        jax.jacfwd(end)(0.5)
    with pytest.raises(Exception, match="max_events"):
        jax.grad(end)(0.5, dfx.RecursiveCheckpointAdjoint())
