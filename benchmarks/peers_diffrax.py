"""S1, S2 and S3 with diffrax: a `while_loop` around `diffeqsolve(event=...)`, one segment per event, as diffrax's
maintainer advises (diffrax #492, #423).

What its user must know:

- One guard, signed by the mode so that it always rises to zero, with `direction=True`: the guard, exactly 0 after the
  state has been set onto the surface, falls, and does not fire again. With `direction=None` a segment that starts on
  the belt's velocity ends after one step with length zero, for ever.
- An event is a change of sign between two steps. Here the error control keeps steps shorter than the time between two
  roots whatever `dt0`; where it does not (a short flight of a ball), `dt0` must.
- Newton's method is safe here because the guard is steep at the root. Bisection raises "The root is not contained in
  [lower, upper]" as soon as some lanes have finished before others.
- One vmap runs in lockstep, segment by segment and step by step; chunks (`batch_size`) wait less and stay in cache.
- The derivative is `jax.jacfwd` of the whole loop, with `adjoint=ForwardMode()`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array
from workloads import after_impact, DAMPING, F_SLIP, F_STICK, HAMMER, K, SLIDER, T1, WALL


class Model(NamedTuple):
    """p are the parameters, s is the mode. `change` is (y, p, s) -> (y, s) after an event."""

    field: Callable[..., Any]
    guard: Callable[..., Array]
    change: Callable[..., tuple[Any, Array]]


def loop(
    model: Model,
    y0: tuple,
    p: tuple,
    s0: int,
    *,
    tol: float = 1e-8,
    solver: diffrax.AbstractSolver = diffrax.Tsit5(),
    dt0: float | None = 0.1,
    root_finder: optx.AbstractRootFinder | None = None,
    max_events: int = 100,
) -> tuple[tuple[Array, Array], Array]:
    """One lane: the final state and whether every solve succeeded."""
    term = diffrax.ODETerm(lambda t, y, args: model.field(t, y, *args))
    controller = diffrax.PIDController(rtol=tol, atol=tol)
    root_finder = optx.Newton(rtol=0.1 * tol, atol=0.1 * tol) if root_finder is None else root_finder
    event = diffrax.Event(lambda t, y, args, **_: model.guard(y, *args), root_finder, direction=True)

    def segment(carry: tuple) -> tuple:
        t, y, s, n, ok = carry
        sol = diffrax.diffeqsolve(
            term,
            solver,
            t,
            T1,
            dt0,
            y,
            (p, s),
            stepsize_controller=controller,
            event=event,
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        t, y = sol.ts[0], jax.tree.map(lambda a: a[0], sol.ys)
        happened = sol.event_mask
        y, s = jax.tree.map(lambda a, b: jnp.where(happened, a, b), model.change(y, p, s), (y, s))
        return jnp.where(happened, t, T1), y, s, n + 1, ok & diffrax.is_okay(sol.result)

    def unfinished(carry: tuple) -> Array:
        t, _, _, n, _ = carry
        return (t < T1) & (n < max_events)

    start = (jnp.asarray(0.0), jax.tree.map(jnp.asarray, y0), jnp.asarray(s0), jnp.asarray(0), jnp.asarray(True))
    t, y, _, _, ok = jax.lax.while_loop(unfinished, segment, start)
    return y, ok & (t >= T1)


def stick_slip() -> Model:
    """Parameters: v_dr, F_slip, k."""

    def field(t: Array, y: tuple, p: tuple, s: Array) -> tuple:
        (x, v), (_, f_slip, k) = y, p
        return v, jnp.where(s == 0, 0.0, -k * x - s * f_slip)

    def guard(y: tuple, p: tuple, s: Array) -> Array:
        (x, v), (v_dr, _, k) = y, p
        return jnp.where(s == 0, k * x - F_STICK, -s * (v - v_dr))

    def change(y: tuple, p: tuple, s: Array) -> tuple:
        (x, _), (v_dr, _, k) = y, p
        sticks = jnp.abs(k * x) <= F_STICK
        return (x, v_dr), jnp.where(s == 0, -1, jnp.where(sticks, 0, -s))

    return Model(field, guard, change)


def impacts() -> Model:
    """Parameter: ω."""

    def field(t: Array, y: tuple, p: tuple, s: Array) -> tuple:
        (x, v), (omega,) = y, p
        return v, jnp.cos(omega * t) - DAMPING * v - x

    def guard(y: tuple, p: tuple, s: Array) -> Array:
        return y[0] - WALL

    def change(y: tuple, p: tuple, s: Array) -> tuple:
        return (jnp.asarray(WALL), after_impact(y[1])), s

    return Model(field, guard, change)


def slider_lane(v_dr: Array, **options: Any) -> tuple[Any, Array]:
    return loop(stick_slip(), SLIDER, (v_dr, F_SLIP, K), -1, **options)


def hammer_lane(omega: Array, **options: Any) -> tuple[Any, Array]:
    return loop(impacts(), HAMMER, (omega,), 0, **options)


def derivative_lane(v_dr: Array, **options: Any) -> tuple[Array, Array]:
    def final(q: Array) -> tuple[Array, Array]:
        y1, ok = loop(stick_slip(), (q[0], q[1]), (q[2], q[3], q[4]), -1, **options)
        return jnp.stack(y1), ok

    return jax.jacfwd(final, has_aux=True)(jnp.array([*SLIDER, v_dr, F_SLIP, K]))


LANES = {"S1": slider_lane, "S2": hammer_lane, "S3": derivative_lane}


def ensemble(
    workload: str, *, tol: float = 1e-8, batch_size: int | None = None, **options: Any
) -> Callable[[Array], tuple[Any, Array]]:
    """The jitted ensemble: (lanes,) -> (what is wanted, success). `batch_size`: chunks by `lax.map`, else one vmap."""

    def lane(p: Array) -> tuple[Any, Array]:
        return LANES[workload](p, tol=tol, **options)

    if batch_size is None:
        return jax.jit(jax.vmap(lane))
    return jax.jit(lambda p: jax.lax.map(lane, p, batch_size=batch_size))


def user_code(workload: str) -> tuple[Any, ...]:
    """What its user writes for a workload, `vmap` apart."""
    rules = {"S1": (stick_slip,), "S2": (impacts, after_impact), "S3": (stick_slip,)}
    return (Model, loop, LANES[workload], *rules[workload])
