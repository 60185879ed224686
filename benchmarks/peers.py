"""What users of other packages write for workload S1, timed and checked against the closed form.

S1: 4096 stick-slip oscillators of section 3.4, (3.33)-(3.34), from (x, v) = (2.5, -0.5), belt velocities 0.1 ... 1,
t from 0 to 100: 8 to 30 events a lane. Every peer integrates slip and stick numerically, finds events by its own means
and changes the mode by the same rule (`after_event`); all of them may slip with either sign.

    python benchmarks/peers.py --lanes 4096 --tol 1e-6 1e-8 1e-10 --peer diffrax heyoka
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array
from scipy.integrate import solve_ivp


sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import reference


M, C, K, F_SLIP, F_STICK = 1.0, 0.0, 1.0, 1.0, 2.0
T1, X0, V0 = 100.0, 2.5, -0.5


def belt_velocities(lanes: int = 4096) -> np.ndarray:
    return np.linspace(0.1, 1.0, lanes)


class Measured(NamedTuple):
    """One peer at one tolerance: median seconds for all lanes (compile apart), largest error of the final states."""

    peer: str
    tol: float
    lanes: int
    seconds: float
    compile_seconds: float
    max_error: float
    median_error: float


def after_event(mode: int, x: float, v_dr: float) -> int:
    """The mode s after an event at v = v_dr: 0 is stick, ±1 the sign of v_rel. v_dr > 0."""
    if mode == 0:
        return -1
    return 0 if abs(K * x + C * v_dr) <= F_STICK else -mode


# scipy


def scipy_lane(v_dr: float, *, method: str = "RK45", tol: float = 1e-8) -> np.ndarray:
    """One lane: one `solve_ivp` with a terminal event per segment, the pattern of its documentation.

    What its user must know: v is set to v_dr exactly after an event, and `direction` makes the event just handled
    silent (g starts at 0 and becomes negative). An event is a change of sign over a step: two roots in one are lost.
    """
    t, y, mode = 0.0, np.array([X0, V0]), -1
    while t < T1:

        def field(t: float, y: np.ndarray, s: int = mode) -> list[float]:
            return [y[1], (-K * y[0] - C * y[1] - s * F_SLIP) / M if s else 0.0]

        def guard(t: float, y: np.ndarray, s: int = mode) -> float:
            return -s * (y[1] - v_dr) if s else K * y[0] + C * v_dr - F_STICK

        guard.terminal, guard.direction = True, 1.0
        sol = solve_ivp(field, (t, T1), y, method=method, rtol=tol, atol=tol, events=guard)
        t, y = sol.t[-1], sol.y[:, -1]
        if sol.status == 1:
            mode, y = after_event(mode, y[0], v_dr), np.array([y[0], v_dr])
    return y


def scipy_events(v_dr: Iterable[float], **options: Any) -> np.ndarray:
    """Final states (lanes, 2): a Python loop over lanes."""
    return np.array([scipy_lane(float(v), **options) for v in v_dr])


# diffrax


def diffrax_lane(
    v_dr: Array,
    *,
    tol: float = 1e-8,
    solver: diffrax.AbstractSolver = diffrax.Tsit5(),
    dt0: float | None = 0.1,
    root_finder: optx.AbstractRootFinder | None = None,
    max_events: int = 100,
) -> tuple[tuple[Array, Array], Array]:
    """One lane: a `while_loop` around `diffeqsolve(event=...)`, one segment per event, as diffrax's maintainer advises
    (diffrax #492, #423). Returns the final state and whether every solve succeeded.

    What its user must know:

    - One guard, signed by the mode so that it always rises to zero, with `direction=True`: the guard, exactly 0 after
      v has been set to v_dr, falls, and does not fire again. With `direction=None` a segment that starts on the belt's
      velocity ends after one step with length zero, for ever.
    - An event is a change of sign between two steps. Here the error control keeps steps shorter than the time between
      two roots whatever `dt0`; where it does not (a short flight of a ball), `dt0` must.
    - Newton's method is safe here because v is steep at the root. Bisection raises "The root is not contained in
      [lower, upper]" as soon as some lanes have finished before others.
    - One vmap runs in lockstep, segment by segment and step by step; chunks (`batch_size`) wait less and stay in cache.
    """
    term = diffrax.ODETerm(_field)
    controller = diffrax.PIDController(rtol=tol, atol=tol)
    root_finder = optx.Newton(rtol=0.1 * tol, atol=0.1 * tol) if root_finder is None else root_finder
    event = diffrax.Event(_guard, root_finder, direction=True)

    def segment(carry: tuple) -> tuple:
        t, y, mode, n, ok = carry
        sol = diffrax.diffeqsolve(
            term,
            solver,
            t,
            T1,
            dt0,
            y,
            (v_dr, mode),
            stepsize_controller=controller,
            event=event,
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        t, (x, v) = sol.ts[0], jax.tree.map(lambda a: a[0], sol.ys)
        happened = sol.event_mask
        sticks = jnp.abs(K * x + C * v_dr) <= F_STICK
        after = jnp.where(mode == 0, -1, jnp.where(sticks, 0, -mode))
        mode = jnp.where(happened, after, mode)
        t = jnp.where(happened, t, T1)
        return t, (x, jnp.where(happened, v_dr, v)), mode, n + 1, ok & diffrax.is_okay(sol.result)

    def unfinished(carry: tuple) -> Array:
        t, _, _, n, _ = carry
        return (t < T1) & (n < max_events)

    start = (jnp.asarray(0.0), (jnp.asarray(X0), jnp.asarray(V0)), jnp.asarray(-1), jnp.asarray(0), jnp.asarray(True))
    t, y, _, _, ok = jax.lax.while_loop(unfinished, segment, start)
    return y, ok & (t >= T1)


def _field(t: Array, y: tuple[Array, Array], args: tuple[Array, Array]) -> tuple[Array, Array]:
    (x, v), (_, s) = y, args
    return v, jnp.where(s == 0, 0.0, (-K * x - C * v - s * F_SLIP) / M)


def _guard(t: Array, y: tuple[Array, Array], args: tuple[Array, Array], **kwargs: Any) -> Array:
    (x, v), (v_dr, s) = y, args
    return jnp.where(s == 0, K * x + C * v_dr - F_STICK, -s * (v - v_dr))


def diffrax_events(
    *, tol: float = 1e-8, batch_size: int | None = None, **options: Any
) -> Callable[[Array], tuple[Any, Array]]:
    """The jitted ensemble: v_dr (lanes,) -> ((x, v), success). `batch_size`: chunks by `lax.map`, else one vmap."""

    def lane(v_dr: Array) -> tuple[Any, Array]:
        return diffrax_lane(v_dr, tol=tol, **options)

    if batch_size is None:
        return jax.jit(jax.vmap(lane))
    return jax.jit(lambda v_dr: jax.lax.map(lane, v_dr, batch_size=batch_size))


# heyoka


def heyoka_events(*, tol: float = 1e-8) -> Callable[[np.ndarray], np.ndarray]:
    """A Taylor integrator with one terminal event, whose callback changes the mode; compiled here, reused by all lanes.

    What its user must know: mode and belt velocity are runtime parameters, so the event's equation is another one after
    its own callback; `direction` is needed as in the other packages.
    """
    import heyoka as hy

    x, v = hy.make_vars("x", "v")
    v_dr, s = hy.par[0], hy.par[1]
    slips = s * s

    def change(ta: Any, d_sgn: int) -> bool:
        ta.pars[1] = after_event(int(ta.pars[1]), ta.state[0], ta.pars[0])
        ta.state[1] = ta.pars[0]
        return True

    guard = -s * (v - v_dr) + (1.0 - slips) * (K * x + C * v_dr - F_STICK)
    event = hy.t_event(guard, callback=change, direction=hy.event_direction.positive)
    field = [(x, v), (v, slips * (-K * x - C * v - s * F_SLIP) / M)]
    ta = hy.taylor_adaptive(field, [X0, V0], t_events=[event], tol=tol, pars=[0.2, -1.0])

    def run(v_dr: np.ndarray) -> np.ndarray:
        final = np.empty((len(v_dr), 2))
        for i, value in enumerate(v_dr):
            ta.time, ta.state[:], ta.pars[:] = 0.0, (X0, V0), (value, -1.0)
            ta.reset_cooldowns()
            if ta.propagate_until(T1)[0] != hy.taylor_outcome.time_limit:
                raise RuntimeError(f"heyoka stopped early at v_dr = {value}.")
            final[i] = ta.state
        return final

    return run


# measuring


def measure(peer: str, tol: float, v_dr: np.ndarray, *, repeats: int = 3, batch_size: int | None = None) -> Measured:
    """Runs one peer (`RK45`, `DOP853`, `diffrax`, `heyoka`) and compares it with the closed form."""
    start = time.perf_counter()
    argument, unpack = v_dr, np.asarray
    if peer == "diffrax":
        argument = jnp.asarray(v_dr)
        run = diffrax_events(tol=tol, batch_size=batch_size).lower(argument).compile()

        def unpack(out: tuple) -> np.ndarray:
            if not out[1].all():
                raise RuntimeError("A diffrax lane failed.")
            return np.stack(out[0], -1)

    elif peer == "heyoka":
        run = heyoka_events(tol=tol)
    else:

        def run(v_dr: np.ndarray) -> np.ndarray:
            return scipy_events(v_dr, method=peer, tol=tol)

    compiled, times = time.perf_counter() - start, []
    for _ in range(repeats):
        start = time.perf_counter()
        out = jax.block_until_ready(run(argument))
        times.append(time.perf_counter() - start)
    error = abs(unpack(out) - reference.stick_slip_final(v_dr, T1, X0, V0, M, K, F_SLIP, F_STICK)).max(1)
    name = f"diffrax/{batch_size}" if peer == "diffrax" and batch_size else peer
    return Measured(name, tol, len(v_dr), statistics.median(times), compiled, error.max(), float(np.median(error)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--scipy-lanes", type=int, default=8, help="lanes given to scipy, whose time is scaled up")
    parser.add_argument("--tol", type=float, nargs="+", default=[1e-6, 1e-8, 1e-10])
    parser.add_argument("--peer", nargs="+", default=["RK45", "DOP853", "diffrax", "heyoka"])
    parser.add_argument("--batch-size", type=int, nargs="*", default=[0, 256], help="chunks for diffrax; 0: one vmap")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'peer':<12} {'tol':>7} {'s per 4096 lanes':>17} {'compile s':>10} {'max error':>10} {'median':>10}")
    for peer in options.peer:
        lanes = options.lanes if peer in ("diffrax", "heyoka") else options.scipy_lanes
        for tol in options.tol:
            for batch_size in options.batch_size if peer == "diffrax" else [0]:
                m = measure(peer, tol, belt_velocities(lanes), repeats=options.repeats, batch_size=batch_size or None)
                seconds = m.seconds * 4096 / m.lanes
                print(
                    f"{m.peer:<12} {tol:>7.0e} {seconds:>17.3f} {m.compile_seconds:>10.2f} "
                    f"{m.max_error:>10.1e} {m.median_error:>10.1e}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
