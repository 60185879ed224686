"""`solve`: the flow from one time to another, as one flat loop."""

import functools as ft
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._numerics._autodiff import dense_jacobian, forward_only, frozen
from .._numerics._jaxpr import is_affine, may_jump
from .._numerics._text import known, suggesting
from .._types import Scalar, StateT, Y
from ..system._checks import check_model, closing_contacts
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._arguments import check_numbers, check_solve
from ._diagnosis import explain
from ._loop import Carry, finite, Flow
from ._results import is_okay, raise_if, RESULTS, SolveError
from ._save import in_order, Log, Saved
from ._solution import Events, Solution
from .events._initial_mode import start_mode
from .steppers._exponential import Exponential, ExponentialStepper
from .steppers._stepper import RungeKutta, Stepper
from .steppers._taylor import Taylor, TaylorStepper


class _Options(NamedTuple):
    """The arguments of `solve` that say how, and not what."""

    given: dict[str, Any]
    solver: dfx.AbstractSolver
    controller: dfx.AbstractStepSizeController
    saveat: dfx.SaveAt
    dt0: Scalar | None
    max_steps: int
    max_events: int
    adjoint: dfx.AbstractAdjoint
    throw: bool
    meter: dfx.AbstractProgressMeter


@eqx.filter_jit
def _run(system: System, t0: Scalar, t1: Scalar, y0: Y, options: _Options) -> Solution:
    def run(system: System, t0: Scalar, t1: Scalar, y0: Y) -> Solution:
        return _integrate(system, t0, t1, y0, options)

    if isinstance(options.adjoint, dfx.DirectAdjoint):
        return dense_jacobian(run, system, t0, t1, y0)
    if not isinstance(options.adjoint, dfx.RecursiveCheckpointAdjoint):
        system, t0, t1, y0 = forward_only(
            (system, t0, t1, y0),
            "`nsjax.solve` was differentiated in reverse mode (`jax.grad`, `jax.vjp`, `jax.jacrev`), which needs "
            "`adjoint=diffrax.DirectAdjoint()` (up to some tens of parameters and states) or "
            "`adjoint=diffrax.RecursiveCheckpointAdjoint()` (more). Or use `jax.jacfwd`.",
        )
    return run(system, t0, t1, y0)


def _integrate(system: System, t0: Scalar, t1: Scalar, y0: Y, options: _Options) -> Solution:
    given, solver, controller, saveat, dt0, max_steps, max_events, adjoint, throw, meter = options
    reverse = isinstance(adjoint, dfx.RecursiveCheckpointAdjoint)
    direction = jnp.where(t1 >= t0, 1, -1).astype(t0.dtype)
    t0 = check_model(system, t0, y0, direction)
    start, stop = t0 * direction, t1 * direction
    model = SwitchedSystem(system, direction, start, y0).at(start)
    max_events = max_events if model.slots else 0
    state, forked, result = start_mode(model, start, y0, given, frozen(stop - start))
    stepper = _stepper(solver).made_for(model, state, start, y0)
    y0 = model.project(start, y0, state)  # a change of y0 off the surface that holds it changes nothing
    f0 = model.flow(start, y0, state)

    slots = range(len(model.slots))

    def guard(i: int, ty: tuple[Scalar, Y]) -> list[Scalar]:
        return model.guards(*ty, state, wanted=tuple(j == i for j in slots))[i]

    affine = tuple(is_affine(ft.partial(guard, i), (start, y0)) for i in slots)
    jumpy = tuple(not affine[i] and may_jump(ft.partial(guard, i), (start, y0)) for i in slots)
    terms = dfx.ODETerm(lambda t, y, args: model.flow(t, y, state))
    func: Any = solver.func
    first, controller_state = controller.init(terms, start, stop, y0, dt0, None, func, solver.error_order(terms))
    saved = Saved(saveat, max_steps, max_events, start, y0, state.mode, stepper.degree, system)
    request = saved.request
    if request.t0:
        saved = saved.write(True, start, y0, state.mode, system, direction)
    if request.ts is not None:
        blank = jax.tree.map(lambda x: jnp.stack([x] * (stepper.degree + 1)), y0)
        saved = saved.write_times(jnp.ones((), bool), start, start, blank, state.mode, system, direction, reverse)
    flow = Flow(
        model=model,
        stepper=stepper,
        controller=controller,
        t0=start,
        t1=stop,
        max_steps=max_steps,
        max_events=max_events,
        keep_steps=request.steps,
        want_points=saveat.dense or request.ts is not None,
        meter=meter,
        affine=affine,
        jumpy=jumpy,
        reverse=reverse,
    )
    for _, _, good, _ in [law for switch in model.switches for law in switch.laws(system)]:
        result = RESULTS.where(good, result, RESULTS.wrong_parameter)
    for t in (t0, t1) if model.clocks else ():
        result = RESULTS.where(model.countable(t), result, RESULTS.clock_too_fast)
    for closes in closing_contacts(model, start, y0).values():
        result = RESULTS.where(closes, RESULTS.wrong_contact, result)
    zero = jnp.zeros((), jnp.int32)
    bad = ~finite((y0, f0, start, stop))
    result = RESULTS.where(bad, RESULTS.nonfinite_field, result)
    if request.ts is not None and len(request.ts):
        ordered = in_order(request.ts.astype(t0.dtype), t0, t1)
        result = RESULTS.where(ordered, result, RESULTS.wrong_save_times)
    carry = Carry(
        t=start,
        y=y0,
        f=f0,
        state=state,
        dt=lax.stop_gradient(first - start),
        controller=controller_state,
        active=(start < stop) & (result == RESULTS.successful),
        result=result,
        steps=zero,
        accepted=zero,
        events=zero,
        halted=zero,
        halvings=zero,
        crawled=zero,
        grazed=jnp.zeros((), bool),
        forked=forked,
        margin=jnp.full_like(start, jnp.inf),
        log=Log(max_events, y0, len(model.switches)) if model.slots else None,
        saved=saved,
        meter=meter.init(),
    )
    carry = _tied(jax.tree.map(_strong, carry), (system, t0, t1, y0))
    dynamic, static = eqx.partition(carry, eqx.is_array)

    def body(dynamic: Any) -> Any:
        new = eqx.filter(flow.body(eqx.combine(dynamic, static)), eqx.is_array)
        return jax.tree.map(lambda old, x: x.astype(old.dtype), dynamic, new)

    # `unvmap_any` keeps the predicate unbatched, so that ended lanes cost no copy of the buffers.
    kind = dict(kind="lax")
    if isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        kind = dict(kind="checkpointed", max_steps=max_steps, checkpoints=adjoint.checkpoints)
    dynamic = eqxi.while_loop(lambda c: eqxi.unvmap_any(c.active), body, dynamic, **kind)
    c: Carry = eqx.combine(dynamic, static)
    meter.close(c.meter)
    # After an event at the very end the solution has no time left, but it moves with the difference of the two times.
    ended = c.t == stop
    late = jnp.where(ended, stop - c.t, 0)
    y1, t_end = jax.tree.map(lambda y, f: y + jnp.where(ended, f, 0) * late, c.y, c.f), c.t + late
    result = RESULTS.where(c.grazed & (c.result == RESULTS.successful), RESULTS.tangential_event, c.result)
    saved = c.saved
    if request.t1:
        saved = saved.write(True, t_end, y1, c.state.mode, system, direction)
    sol = Solution(
        system=system,
        t0=t0,
        t1=t_end * direction,
        mode0=_row(state.mode),
        y1=y1,
        mode1=_row(c.state.mode),
        ts=saved.ts,
        ys=saved.ys,
        modes=saved.modes,
        events=_events(model, c, state),
        stats={
            "num_steps": c.steps,
            "num_accepted_steps": c.accepted,
            "num_rejected_steps": c.steps - c.accepted,
            "num_events": c.events,
            "max_steps": max_steps,
        },
        result=result,
        unique=~c.forked,
        margin=c.margin,
        dense=None if saved.dense is None else (*saved.dense, direction, c.accepted),
    )
    if throw:
        # (What is transposed has been computed before.)
        sol = result.error_if(sol, ~is_okay(result)) if reverse else raise_if(~is_okay(result), result, sol)
    return sol


def _stepper(solver: Any) -> Stepper:
    if isinstance(solver, Taylor):
        return TaylorStepper(solver)
    return ExponentialStepper(solver) if isinstance(solver, Exponential) else RungeKutta(solver)


def _strong(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, (bool, int, float)) else x


def _tied(carry: Carry, args: Any) -> Carry:
    """The same, but all of it depends on `args`, formally. What is differentiated or batched in the loop is so from its
    start, and need not be found out by transforming the body once more for every level at which it spreads."""
    never = jnp.zeros((), bool)
    leaves = jax.tree.leaves(eqx.filter(args, eqx.is_inexact_array))
    nought = sum(jnp.sum(jnp.where(never, jnp.real(x), 0)).astype(carry.t.dtype) for x in leaves)

    def tie(x: Any) -> Any:
        if not eqx.is_array(x):
            return x
        return x | (nought != 0) if x.dtype == bool else x + jnp.asarray(nought).astype(x.dtype)

    # The requested times stay the same in every lane, and the progress meter belongs to all of them.
    def apart(c: Carry) -> tuple:
        return c.saved.request, c.meter

    return eqx.tree_at(apart, jax.tree.map(tie, carry), apart(carry), is_leaf=lambda x: x is None)


def _row(mode: tuple) -> Int[Array, " switches"]:
    return jnp.stack(mode) if mode else jnp.zeros(0, jnp.int32)


def _events(model: SwitchedSystem, c: Carry, start: ModeState) -> Events:
    log = c.log or Log(0, c.y, len(model.switches))
    table = jnp.asarray([s.switch for s in model.slots] + [-1], jnp.int32)
    first = _row(start.mode)[None] if model.switches else jnp.zeros((1, 0), jnp.int32)
    # The mode before an event is the one after the last; rows past the end keep their padding.
    before = jnp.concatenate([first, log.modes])[: len(log.t)]
    before = jnp.where(log.slot[:, None] < 0, log.modes, before)
    return Events(
        t=log.t,
        switch=table[log.slot],
        mode_before=before,
        mode_after=log.modes,
        y_before=log.before,
        y_after=log.after,
        transversality=log.transversality,
        num=c.events,
        names=tuple(k.name for k in model.switches),
    )


TOLERANCE = "Tolerances are those of the step size: `stepsize_controller=diffrax.PIDController(rtol=..., atol=...)`."
HINTS = {name: TOLERANCE for name in ("rtol", "atol", "tol", "rtols", "tolerance")} | {
    "args": "Parameters are fields of the system.",
    "event": "Surfaces are switches of the system: `@nsjax.sgn`, `@nsjax.relay`, `@nsjax.impact`.",
    "dense": "Write `saveat=diffrax.SaveAt(dense=True)`.",
    "ts": "Write `saveat=diffrax.SaveAt(ts=...)`.",
    "t_eval": "Write `saveat=diffrax.SaveAt(ts=...)`.",
    "method": "Write `solver=...`.",
}


@suggesting(HINTS)
def solve(
    system: System,
    t0: Any,
    t1: Any,
    y0: StateT,
    *,
    mode: Mapping[str, Any] | Sequence[Any] | None = None,
    solver: dfx.AbstractSolver = dfx.Tsit5(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    saveat: dfx.SaveAt = dfx.SaveAt(t1=True),
    dt0: Any = None,
    max_steps: int = 4096,
    max_events: int = 256,
    adjoint: dfx.AbstractAdjoint = dfx.ForwardMode(),
    throw: bool = True,
    progress_meter: dfx.AbstractProgressMeter = dfx.NoProgressMeter(),
) -> Solution[StateT]:
    """Solves y' = f(t, y, s), s_k in Sgn(h_k(t, y)), from `t0` to `t1` (which may lie before it), event by event.

    Between events the field is smooth and `solver` steps it; every event is located to the accuracy of the method;
    after it the solution crosses, slides (2.19), sticks, switches, rebounds or rests. Derivatives by `jax.jvp` and
    `jax.jacfwd` with respect to `y0`, `t0`, `t1` and the parameters of `system` are those of the flow, saltation (3.30)
    included; so are those of event times.

    **Arguments:**

    - `system`: the model.
    - `t0`, `t1`: start and end [time].
    - `y0`: the state at `t0`, any pytree of floating point arrays of one dtype.
    - `mode`: for a start on a surface, `{"name": value}` or one value for each switch: `sgn` +1, -1, or 0 to slide
        (also on a repulsive surface); `relay` 0 or 1 (needed between its two surfaces, 0 by default); `impact` 0 or 1
        to rest. Where the solution is not unique this chooses one; without it static friction holds as long as it can,
        a repulsive surface that is reached is crossed, and a start on one is refused. `Solution.unique` tells.
    - `solver`: an explicit diffrax Runge-Kutta solver, a diagonally implicit one for stiff fields, Euler,
        `nsjax.Taylor`, or for models that are affine in the state `nsjax.Exponential`.
    - `stepsize_controller`: by default `diffrax.PIDController` with `rtol = atol = 1e-8` (1e-5 for float32).
    - `saveat`: as in diffrax: `t0`, `t1`, `ts`, `steps`, `fn(t, y, system)`, `dense`.
    - `dt0`: first step; chosen automatically by default.
    - `max_steps`, `max_events`: bounds, also the capacity of dense output and of the event log.
    - `adjoint`: how derivatives are taken. `diffrax.ForwardMode()`, the default: `jax.jvp` and `jax.jacfwd`, of every
        order. For `jax.grad`, `jax.vjp`, `jax.jacrev`: `diffrax.DirectAdjoint()` multiplies by the Jacobian, found in
        forward mode, at the cost of a forward derivative for each number among `y0`, the parameters and the times that
        is perturbed: the choice up to some tens of them. `diffrax.RecursiveCheckpointAdjoint()` goes back through the
        steps, whatever their number: the choice for more. (Both also under `jax.jacfwd`: `hessian` works.)
    - `throw`: whether a failure raises; if not, look at `Solution.result`, which has one entry a lane under `vmap`.
    - `progress_meter`: as in diffrax.

    **Returns:** a `Solution`.

    **Raises:** `TypeError`, `ValueError` for mistakes in the model or the arguments; a runtime error that tells which
    of `RESULTS` occurred, if `throw`.
    """
    y0, t0, t1, solver, controller, given = check_solve(
        system, t0, t1, y0, mode, solver, stepsize_controller, saveat, max_steps, max_events, adjoint
    )
    if throw:
        check_numbers(system, t0, t1, y0)
    system = arrays_of(system, t0.dtype)
    # Tolerances are numbers too: a new one is no new program.
    plain = [n for n in ("rtol", "atol") if isinstance(getattr(controller, n, None), (int, float))]
    controller = eqx.tree_at(
        lambda c: [getattr(c, n) for n in plain],
        controller,
        [jnp.asarray(getattr(controller, n), t0.dtype) for n in plain],
    )
    if dt0 is not None:
        if known(dt0) and not np.all(np.asarray(dt0) > 0):
            raise ValueError(f"Argument `dt0` must be a time above zero, whatever the direction, but got {dt0}.")
        dt0 = jnp.abs(jnp.asarray(dt0, t0.dtype))
    told = throw and known((system, t0, t1, y0, given, controller, saveat, dt0))
    within = throw and not told  # raised by the compiled program itself
    options = _Options(given, solver, controller, saveat, dt0, max_steps, max_events, adjoint, within, progress_meter)
    sol = _run(system, t0, t1, y0, options)
    if not told:
        return sol
    if not known(sol.result):  # numbers that are known, within a function that is being compiled
        return raise_if(~is_okay(sol.result), sol.result, sol)
    if not is_okay(sol.result):
        raise SolveError(explain(system, sol))
    return sol
