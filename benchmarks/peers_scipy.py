"""S1, S2 and S3 with scipy: one `solve_ivp` with a terminal event per segment, the pattern of its documentation.

What its user must know: the state is set onto the surface exactly after an event, and `direction` makes the event just
handled silent (g starts at 0 and becomes negative). An event is a change of sign over a step: two roots in one step are
lost.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from workloads import after_event, after_impact, DAMPING, F_SLIP, F_STICK, HAMMER, jump, K, SLIDER, T1, WALL


class Model(NamedTuple):
    """One lane; s is its mode. `change` is (y, s) -> (y, s) after an event."""

    field: Callable[..., Any]
    guard: Callable[..., float]
    change: Callable[..., tuple[np.ndarray, int]]
    y0: np.ndarray
    s0: int


def lane(model: Model, *, method: str, tol: float) -> np.ndarray:
    t, y, s = 0.0, model.y0, model.s0
    while t < T1:

        def guard(t: float, y: np.ndarray, s: int) -> float:
            return model.guard(t, y, s)

        guard.terminal, guard.direction = True, 1.0
        sol = solve_ivp(model.field, (t, T1), y, method=method, args=(s,), rtol=tol, atol=tol, events=guard)
        t, y = sol.t[-1], sol.y[:, -1]
        if sol.status == 1:
            y, s = model.change(y, s)
    return y


def stick_slip(v_dr: float) -> Model:
    def field(t: float, y: np.ndarray, s: int) -> list[float]:
        return [y[1], -K * y[0] - s * F_SLIP if s else 0.0]

    def guard(t: float, y: np.ndarray, s: int) -> float:
        return -s * (y[1] - v_dr) if s else K * y[0] - F_STICK

    def change(y: np.ndarray, s: int) -> tuple[np.ndarray, int]:
        return np.array([y[0], v_dr]), after_event(s, y[0])

    return Model(field, guard, change, np.array(SLIDER), -1)


def impacts(omega: float) -> Model:
    def field(t: float, y: np.ndarray, s: int) -> list[float]:
        return [y[1], np.cos(omega * t) - DAMPING * y[1] - y[0]]

    def guard(t: float, y: np.ndarray, s: int) -> float:
        return y[0] - WALL

    def change(y: np.ndarray, s: int) -> tuple[np.ndarray, int]:
        return np.array([WALL, after_impact(y[1])]), s

    return Model(field, guard, change, np.array(HAMMER), 0)


def stick_slip_derivative(v_dr: float) -> Model:
    """The variational equations beside the model: y is (x, v, dx by five quantities, dv by the same five)."""

    def field(t: float, y: np.ndarray, s: int) -> np.ndarray:
        if s == 0:
            return np.array([y[1], 0.0, *y[7:], 0.0, 0.0, 0.0, 0.0, 0.0])
        dv = -K * y[2:7]
        dv[3] -= s  # by F_slip
        dv[4] -= y[0]  # by k
        return np.array([y[1], -K * y[0] - s * F_SLIP, *y[7:], *dv])

    def guard(t: float, y: np.ndarray, s: int) -> float:
        return -s * (y[1] - v_dr) if s else K * y[0] - F_STICK

    def change(y: np.ndarray, s: int) -> tuple[np.ndarray, int]:
        y, after = y.copy(), after_event(s, y[0])
        jump(y[2:7], y[7:], y[0], s, after, v_dr, F_SLIP, K)
        y[1] = v_dr
        return y, after

    return Model(field, guard, change, np.array([*SLIDER, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0]), -1)


MODELS = {"S1": stick_slip, "S2": impacts, "S3": stick_slip_derivative}


def ensemble(workload: str, *, method: str = "DOP853", tol: float = 1e-8) -> Callable[[np.ndarray], np.ndarray]:
    """A Python loop over lanes."""

    def run(values: np.ndarray) -> np.ndarray:
        final = np.array([lane(MODELS[workload](float(p)), method=method, tol=tol) for p in values])
        return final[:, 2:].reshape(-1, 2, 5) if workload == "S3" else final

    return run


def user_code(workload: str) -> tuple[Any, ...]:
    """What its user writes for a workload, the loop over lanes apart."""
    rules = {"S1": (after_event,), "S2": (after_impact,), "S3": (after_event, jump)}
    return (Model, lane, MODELS[workload], *rules[workload])
