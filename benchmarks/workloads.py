"""The workloads that nsjax and its peers are timed on: parameters, references, and the rules at events.

Each is a sweep of one parameter from one start, t from 0 to 100, in float64; the error is the largest component of what
is wanted at t = 100 against a reference that shares nothing with the code being measured.

S1: stick-slip of section 3.4, (3.33)-(3.34): x'' = -k x - F_slip sgn(x' - v_dr), held until |k x| > F_stick; from
    (2.5, -0.5), v_dr = 0.1 ... 1; 8 to 30 events a lane. Wanted: the final state.
S2: x'' + 0.02 x' + x = cos ωt with a wall at x = 0.5 and restitution 0.8; from (0.5, -1), ω = 2.6 ... 3; 20 to 23
    impacts a lane. Wanted: the final state.
S3: S1; wanted: the derivative of the final state by (x0, v0, v_dr, F_slip, k), through all events.
"""

import functools as ft
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np


sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "references"))
import reference


T1 = 100.0
F_SLIP, F_STICK, K = 1.0, 2.0, 1.0  # S1 and S3; m = 1, c = 0
SLIDER = (2.5, -0.5)  # (x, v) at t = 0
HAMMER = (0.5, -1.0)  # S2
WALL, RESTITUTION, DAMPING = 0.5, 0.8, 0.02
E_V_DR, E_K = np.eye(5)[2], np.eye(5)[4]  # derivatives of v_dr and k by (x0, v0, v_dr, F_slip, k)


def belt_velocities(lanes: int = 4096) -> np.ndarray:
    return np.linspace(0.1, 1.0, lanes)


def frequencies(lanes: int = 4096) -> np.ndarray:
    return np.linspace(2.6, 3.0, lanes)


# what happens at an event, by hand: the users of other packages write this


def after_event(s: int, x: float, k: float = K) -> int:
    """The mode s after an event at v = v_dr: 0 is stick, ±1 the sign of v_rel. v_dr > 0."""
    if s == 0:
        return -1
    return 0 if abs(k * x) <= F_STICK else -s


def after_impact(v: float) -> float:
    return -RESTITUTION * v


def jump(dx: np.ndarray, dv: np.ndarray, x: float, s: int, after: int, v_dr: float, f_slip: float, k: float) -> None:
    """Multiplies the derivatives dx, dv of x and v by the saltation matrix of an event from mode s to mode `after`.

    v = v_dr on both sides, so that dx does not jump. The event itself moves, by `delay` = d t / d(x0, ...): (3.30), but
    with the terms by which the surfaces v = v_dr and k x = F_stick depend on the parameters.
    """
    if after == 0:  # the acceleration is 0: when stick began does not matter
        dv[:] = E_V_DR
        return
    delay = (E_V_DR - dv) / (-k * x - s * f_slip) if s else -(k * dx + x * E_K) / (k * v_dr)
    dv[:] = E_V_DR + (k * x + after * f_slip) * delay


# references


def exact_impacts(omega: float) -> np.ndarray:
    """S2 in 40 digits, rounded."""
    machine = reference.ImpactOscillator(c=DAMPING, k=1, f_0=1, omega=omega, x_w=WALL, e=RESTITUTION)
    return reference.floats(reference.simulate(machine, T1, HAMMER).y)


def exact_derivative(v_dr: float) -> np.ndarray:
    """S3 by central differences in 40 digits, rounded: (2, 5)."""
    return reference.solution(
        reference.StickSlip, T1, SLIDER, wrt=("v_dr", "F_slip", "k"), k=K, v_dr=v_dr, F_slip=F_SLIP, F_stick=F_STICK
    ).derivative


def checked(name: str, exact: Callable[[float], np.ndarray], values: np.ndarray) -> np.ndarray:
    """Forty digits take 0.1 to 1 s a lane; so heyoka's result at tolerance 1e-15, on three lanes held against them."""
    import peers_heyoka

    found = peers_heyoka.ensemble(name, tol=1e-15)(values)
    for i in (0, len(values) // 2, len(values) - 1):
        error = abs(found[i] - exact(values[i])).max()
        if not error <= 1e-11:
            raise AssertionError(f"The reference of {name} at {values[i]} is wrong by {error:.1e}.")
    return found


class Workload(NamedTuple):
    sweep: Callable[[int], np.ndarray]  # number of lanes -> the parameter of each
    reference: Callable[[np.ndarray], np.ndarray]  # these parameters -> (lanes, *wanted)


WORKLOADS = {
    "S1": Workload(
        belt_velocities, lambda v_dr: reference.stick_slip_final(v_dr, T1, *SLIDER, 1.0, K, F_SLIP, F_STICK)
    ),
    "S2": Workload(frequencies, ft.partial(checked, "S2", exact_impacts)),
    "S3": Workload(belt_velocities, ft.partial(checked, "S3", exact_derivative)),
}
