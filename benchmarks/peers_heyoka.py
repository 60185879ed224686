"""S1, S2 and S3 with heyoka: a Taylor integrator with one terminal event, whose callback changes state and mode;
compiled once, reused by all lanes. With `width` > 1 in batch mode, where each operation is one SIMD instruction for so
many lanes and the callback is called for one lane of them.

What its user must know:

- Mode and swept parameter are runtime parameters, so the event's equation is another one after its own callback;
  `direction` is needed as in other packages.
- A terminal event whose callback returns False, or that has none, ends the propagation of the whole batch.
- Callbacks are Python and take a good part of the time, so that SIMD gains least where events are many. Arrays that
  show state and parameters, made once and not in each callback, make S1 a third faster.
- The surface is left with g at 0 and falling, or at a rounding error from it. Heyoka's cooldown and `direction` keep
  the root just handled from being found again. On none of the 4096 lanes was the next one lost, whether x was set onto
  the wall or left where it was. `reset_cooldowns` before the next lanes.
- Derivatives are `var_ode_sys`'s between events; over an event its user multiplies by the saltation matrix
  (`workloads.jump`, some lines of mathematics for each kind of event). In batches that is half of the time of S3.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import heyoka as hy
import numpy as np
from workloads import after_event, after_impact, DAMPING, F_SLIP, F_STICK, HAMMER, jump, K, SLIDER, T1, WALL


class Model(NamedTuple):
    """`change` alters views of the state y and of the parameters p of one lane; p[0] is the lane's own."""

    field: Any
    guard: Any
    change: Callable[[np.ndarray, np.ndarray], None]
    y0: list[float]
    p0: list[float]


def stick_slip() -> Model:
    x, v = hy.make_vars("x", "v")
    v_dr, s = hy.par[0], hy.par[1]

    def change(y: np.ndarray, p: np.ndarray) -> None:
        y[1], p[1] = p[0], after_event(p[1], y[0])

    field = [(x, v), (v, s * s * (-K * x - s * F_SLIP))]
    guard = -s * (v - v_dr) + (1.0 - s * s) * (K * x - F_STICK)
    return Model(field, guard, change, [*SLIDER], [0.2, -1.0])


def impacts() -> Model:
    x, v = hy.make_vars("x", "v")

    def change(y: np.ndarray, p: np.ndarray) -> None:
        y[0], y[1] = WALL, after_impact(y[1])

    field = [(x, v), (v, hy.cos(hy.par[0] * hy.time) - DAMPING * v - x)]
    return Model(field, x - WALL, change, [*HAMMER], [2.8])


def stick_slip_derivative() -> Model:
    """The state is (x, v, dx by five quantities, dv by the same five)."""
    x, v = hy.make_vars("x", "v")
    v_dr, s, f_slip, k = (hy.par[i] for i in range(4))

    def change(y: np.ndarray, p: np.ndarray) -> None:
        after = after_event(p[1], y[0], p[3])
        jump(y[2:7], y[7:], y[0], p[1], after, p[0], p[2], p[3])
        y[1], p[1] = p[0], after

    field = [(x, v), (v, s * s * (-k * x - s * f_slip))]
    guard = -s * (v - v_dr) + (1.0 - s * s) * (k * x - F_STICK)
    y0 = [*SLIDER, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    return Model(hy.var_ode_sys(field, [x, v, v_dr, f_slip, k]), guard, change, y0, [0.2, -1.0, F_SLIP, K])


MODELS = {"S1": stick_slip, "S2": impacts, "S3": stick_slip_derivative}


def ensemble(workload: str, *, tol: float = 1e-8, width: int = 1) -> Callable[[np.ndarray], np.ndarray]:
    """A Python loop over lanes, or over batches of `width` lanes."""
    model = MODELS[workload]()
    run = scalar(model, tol) if width == 1 else batch(model, tol, width)
    return (lambda p: run(p)[:, 2:].reshape(-1, 2, 5)) if workload == "S3" else run


def scalar(model: Model, tol: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(ta: Any, d_sgn: int) -> bool:
        model.change(y, p)
        return True

    event = hy.t_event(model.guard, callback=change, direction=hy.event_direction.positive)
    ta = hy.taylor_adaptive(model.field, model.y0, t_events=[event], tol=tol, pars=model.p0)
    y, p = ta.state, ta.pars

    def run(values: np.ndarray) -> np.ndarray:
        final = np.empty((len(values), len(model.y0)))
        for i, value in enumerate(values):
            ta.time, y[:], p[:] = 0.0, model.y0, [value, *model.p0[1:]]
            ta.reset_cooldowns()
            if ta.propagate_until(T1)[0] != hy.taylor_outcome.time_limit:
                raise RuntimeError(f"heyoka stopped early at {value}.")
            final[i] = y
        return final

    return run


def batch(model: Model, tol: float, width: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(ta: Any, d_sgn: int, lane: int) -> bool:
        model.change(*views[lane])
        return True

    event = hy.t_event_batch(model.guard, callback=change, direction=hy.event_direction.positive)
    y0, p0 = (np.repeat(np.array(a)[:, None], width, axis=1) for a in (model.y0, model.p0))
    # without `force_avx512` LLVM keeps to registers of 4 numbers, as `recommended_simd_size` says
    ta = hy.taylor_adaptive_batch(model.field, y0, t_events=[event], tol=tol, pars=p0, force_avx512=width > 4)
    views = [(ta.state[:, i], ta.pars[:, i]) for i in range(width)]

    def run(values: np.ndarray) -> np.ndarray:
        chunks = np.pad(values, (0, -len(values) % width), mode="edge").reshape(-1, width)
        final = np.empty((len(chunks), width, len(model.y0)))
        for i, chunk in enumerate(chunks):
            ta.set_time(0.0)
            ta.state[:], ta.pars[:] = y0, p0
            ta.pars[0] = chunk
            ta.reset_cooldowns()
            ta.propagate_until(np.full(width, T1))
            if any(outcome[0] != hy.taylor_outcome.time_limit for outcome in ta.propagate_res):
                raise RuntimeError(f"heyoka stopped early in {chunk}.")
            final[i] = ta.state.T
        return final.reshape(-1, len(model.y0))[: len(values)]

    return run


def user_code(workload: str, *, width: int = 1) -> tuple[Any, ...]:
    """What its user writes for a workload; the loop over lanes or batches is part of `scalar` and `batch`."""
    rules = {"S1": (after_event,), "S2": (after_impact,), "S3": (after_event, jump)}
    return (Model, MODELS[workload], scalar if width == 1 else batch, *rules[workload])
