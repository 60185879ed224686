"""`solve`: the flow from one time to another, as one flat loop."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._numerics._autodiff import dense_jacobian, forward_only, frozen
from .._numerics._compile import interactive
from .._numerics._first_pass import is_sweep, left_over
from .._numerics._jaxpr import bends_and_jumps, jumps
from .._numerics._linalg import WRITTEN_OUT
from .._numerics._merge import merged
from .._numerics._select import select
from .._numerics._text import known, suggesting
from .._numerics._while_any import while_any
from .._types import Scalar, StateT, Y
from ..system._checks import check_model, closing_contacts, forces_on_speeds
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ..system._ticking import ticking
from ._arguments import check_numbers, check_span, checked_start, checked_time, given_modes
from ._diagnosis import explain
from ._integrator import Integrator
from ._loop import Carry, finite, Flow
from ._results import is_okay, raise_if, RESULTS, SolveError
from ._save import Log, Request, Saved, times_in_order
from ._solution import Events, Solution
from .affine._exact import exactly
from .affine._plan import planned
from .events._initial_mode import start_mode
from .events._locate import seen_numbers
from .steppers._exponential import AbstractExponential, Affine, ExponentialStepper
from .steppers._stepper import RungeKutta, Stepper
from .steppers._taylor import Taylor, TaylorStepper


class _Options(NamedTuple):
    """The arguments of `solve` apart from the problem."""

    given: dict[str, Any]  # modes, by the names of switches
    integrator: Integrator
    saveat: dfx.SaveAt
    dt0: Scalar | None = None
    throw: bool = False
    meter: dfx.AbstractProgressMeter = dfx.NoProgressMeter()
    still: bool = False  # whether only the state at the end has derivatives
    exact: bool = False  # whether models that have an exact flow are solved by it
    plain: bool = False  # whether the exact flow goes by plain events alone, and leaves the rest over


@interactive
def _run(system: System, t0: Scalar, t1: Scalar, y0: Y, options: _Options) -> tuple[Solution, Any]:
    """The solution, and whether it was left over; None if it could not be."""

    def run(system: System, t0: Scalar, t1: Scalar, y0: Y) -> tuple[Solution, Any]:
        return _integrate(system, t0, t1, y0, options)

    if isinstance(options.integrator.adjoint, dfx.DirectAdjoint):
        return dense_jacobian(run, system, t0, t1, y0)
    if not isinstance(options.integrator.adjoint, dfx.RecursiveCheckpointAdjoint):
        system, t0, t1, y0 = forward_only(
            (system, t0, t1, y0),
            "`nsjax.solve` was linearised (as by optimistix's least squares) or differentiated in reverse mode, as by "
            "`jax.grad`. That works with `adjoint=diffrax.DirectAdjoint()` (up to some tens of parameters and states); "
            "reverse mode also with `diffrax.RecursiveCheckpointAdjoint()` (more). Or use `jax.jacfwd`.",
        )
        if len(system.switches) > WRITTEN_OUT:
            run = merged(run)
    return run(system, t0, t1, y0)


def _integrate(system: System, t0: Scalar, t1: Scalar, y0: Y, options: _Options) -> tuple[Solution, Any]:
    direction = select(t1 < t0, -1, 1).astype(t0.dtype)  # forwards to an end that is NaN
    t0 = check_model(system, t0, y0, direction)
    start, stop = t0 * direction, t1 * direction
    model = SwitchedSystem(ticking(system.assembled(), t0, y0), direction, start, y0, smooth=True).at(start)
    state, values, forked, result = start_mode(model, start, y0, options.given, frozen(stop - start))
    # (To end on a surface is not plain: none of a map's solutions would be.)
    plain = options.plain and not any(switch.ends for switch in model.switches)
    exact = planned(model, options.meter, state, start, y0) if options.exact else None
    plain = plain and exact is not None
    if exact is not None:
        options = options._replace(integrator=options.integrator._replace(solver=Affine()))
    stepper = _stepper(options.integrator).made_for(model, state, start, y0)
    y0 = model.project(start, y0, state, values)  # a change of y0 off the surface that holds it changes nothing
    f0 = model.flow(start, y0, state)
    flow = _flow(model, stepper, (start, stop), y0, state, options)
    result = _obstacle(flow, y0, f0, options.saveat, result)
    carry = _first_turn(flow, y0, f0, state, forked, result, options)
    carry = _tied(jax.tree.map(_strong, carry), (system, t0, t1, y0))
    c = exactly(flow, exact, carry, plain) if exact else _looped(flow, carry, options.integrator.adjoint)
    sol = _solution(flow, c, t0, state, Request.of(options.saveat).t1)
    if plain:  # what fails too is for the second pass to tell
        return sol, ~is_okay(sol.result) | (c.t < flow.t1)
    if options.throw:
        # (What is transposed has been computed before.)
        failed = ~is_okay(sol.result)
        sol = sol.result.error_if(sol, failed) if flow.reverse else raise_if(failed, sol.result, sol)
    return sol, None


def _flow(
    model: SwitchedSystem, stepper: Stepper, span: tuple[Scalar, Scalar], y: Y, state: ModeState, options: _Options
) -> Flow:
    """What stays the same in all turns of the loop; of each guard whether it is affine, and whether it may jump."""
    integrator, request = options.integrator, Request.of(options.saveat)
    t, slots = span[0], range(len(model.slots))

    def guards(ty: tuple[Scalar, Y]) -> list[Array]:
        return [jnp.stack(row) for row in model.guards(*ty, state)]

    def rates(ty: tuple[Scalar, Y]) -> Any:  # multipliers are made of these: that solving compares is no jump
        return model.rates(model.holdable, *ty, state, model.signs(ty[0], state))

    bent, leaps = bends_and_jumps(guards, (t, y))
    wild = any(bent[i] for i in slots if model.slots[i].holding) and any(jumps(rates, (t, y)))
    return Flow(
        model=model,
        stepper=stepper,
        controller=integrator.stepsize_controller,
        t0=span[0],
        t1=span[1],
        max_steps=integrator.max_steps,
        max_events=integrator.max_events if model.slots else 0,
        keep_steps=request.steps,
        want_points=options.saveat.dense or request.ts is not None,
        still=options.still,
        meter=options.meter,
        affine=tuple(not b for b in bent),
        jumpy=tuple(bent[i] and (wild if model.slots[i].holding else leaps[i]) for i in slots),
        reverse=isinstance(integrator.adjoint, dfx.RecursiveCheckpointAdjoint),
        seen=seen_numbers(model, t, y, state) if len(model.switches) > WRITTEN_OUT else (),
    )


def _obstacle(flow: Flow, y: Y, f: Y, saveat: dfx.SaveAt, result: RESULTS) -> RESULTS:
    """What keeps a solution from setting out, if anything does."""
    model, t0, t1, ts = flow.model, flow.t0, flow.t1, Request.of(saveat).ts
    for _, _, good, _ in [law for switch in model.switches for law in switch.laws(model.system)]:
        result = RESULTS.where(good, result, RESULTS.wrong_parameter)
    for t in (t0, t1) if model.clocks else ():
        result = RESULTS.where(model.countable(t * model.direction), result, RESULTS.clock_too_fast)
    for wrong in (*closing_contacts(model, t0, y).values(), *forces_on_speeds(model, t0, y).values()):
        result = RESULTS.where(wrong, RESULTS.wrong_contact, result)
    good = finite((y, f, t0, t1))
    result = RESULTS.where(good, result, RESULTS.nonfinite_field)
    if ts is not None and len(ts):
        ordered = times_in_order(ts.astype(t0.dtype), t0 * model.direction, t1 * model.direction)
        result = RESULTS.where(ordered, result, RESULTS.wrong_save_times)
    return result


def _first_turn(flow: Flow, y: Y, f: Y, state: ModeState, forked: Any, result: RESULTS, options: _Options) -> Carry:
    """What the loop begins with."""
    model, stepper, controller, t = flow.model, flow.stepper, flow.controller, flow.t0
    terms = dfx.ODETerm(lambda t, y, args: model.flow(t, y, state))
    solver: Any = options.integrator.solver
    order = solver.error_order(terms)
    first, controller_state = controller.init(terms, t, flow.t1, y, options.dt0, None, solver.func, order)
    saved = Saved(options.saveat, (flow.max_steps, flow.max_events), t, y, state.mode, stepper.degree, model)
    if saved.request.t0:
        saved = saved.write(True, t, y, state.mode, model)
    if saved.request.ts is not None:
        blank = jax.tree.map(lambda x: jnp.stack([x] * (stepper.degree + 1)), y)
        saved = saved.write_times(jnp.ones((), bool), (t, t), blank, state.mode, model, flow.reverse)
    zero = jnp.zeros((), jnp.int32)
    return Carry(
        t=t,
        y=y,
        f=f,
        state=state,
        dt=lax.stop_gradient(first - t),
        controller=controller_state,
        active=(t < flow.t1) & (result == RESULTS.successful),
        result=result,
        steps=zero,
        accepted=zero,
        events=zero,
        halted=zero,
        halvings=zero,
        crawled=zero,
        swing=jnp.zeros_like(t),
        grazed=jnp.zeros((), bool),
        forked=forked,
        margin=jnp.full_like(t, jnp.inf),
        log=Log(flow.max_events, y, len(model.switches)) if model.slots else None,
        saved=saved,
        meter=flow.meter.init(),
    )


def _looped(flow: Flow, carry: Carry, adjoint: dfx.AbstractAdjoint) -> Carry:
    """The end of the loop."""
    checkpointed = None
    if isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        checkpointed = dict(max_steps=flow.max_steps, checkpoints=adjoint.checkpoints)
    # Where the predicate depends on one number of the carry alone, XLA looks for a count of the turns in it, which
    # takes a quarter of the compilation.
    c = while_any(lambda c: c.active & (c.steps >= 0), flow.body, carry, checkpointed)
    flow.meter.close(c.meter)
    return c


def _solution(flow: Flow, c: Carry, t0: Scalar, first: ModeState, end_wanted: bool) -> Solution:
    """The solution from `t0`, in the mode `first`, to where the loop has ended."""
    model, stop = flow.model, flow.t1
    # After an event at the very end the solution has no time left, but it moves with the difference of the two times.
    ended = c.t == stop
    late = select(ended, stop - c.t, 0)
    y1, t_end = jax.tree.map(lambda y, f: y + select(ended, f, 0) * late, c.y, c.f), c.t + late
    saved = c.saved
    if end_wanted:
        saved = saved.write(True, t_end, y1, c.state.mode, model)
    return Solution(
        system=model.system.owner,
        t0=t0,
        t1=t_end * model.direction,
        mode0=_row(first.mode)[: model.declared],
        y1=y1,
        mode1=_row(c.state.mode)[: model.declared],
        ts=saved.ts,
        ys=saved.ys,
        modes=None if saved.modes is None else saved.modes[:, : model.declared],
        events=_events(model, c, first),
        stats={
            "num_steps": c.steps,
            "num_accepted_steps": c.accepted,
            "num_rejected_steps": c.steps - c.accepted,
            "num_events": c.events,
            "max_steps": flow.max_steps,
        },
        result=RESULTS.where(c.grazed & (c.result == RESULTS.successful), RESULTS.tangential_event, c.result),
        unique=~c.forked,
        margin=c.margin,
        dense=None if saved.dense is None else (*saved.dense, model.direction, c.accepted),
    )


def _stepper(integrator: Integrator) -> Stepper:
    solver = integrator.solver
    if isinstance(solver, Taylor):
        return TaylorStepper(solver)
    if isinstance(solver, AbstractExponential):
        return ExponentialStepper(solver)
    return RungeKutta(solver, isinstance(integrator.adjoint, dfx.RecursiveCheckpointAdjoint))


def _strong(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, (bool, int, float)) else x


def _tied(carry: Carry, args: Any) -> Carry:
    """The same, but all of it depends on `args`, formally. What is differentiated or batched in the loop is so from its
    start, and need not be found out by transforming the body once more for every level at which it spreads."""
    never = jnp.zeros((), bool)
    leaves = jax.tree.leaves(eqx.filter(args, eqx.is_inexact_array))
    nought = sum(jnp.sum(select(never, jnp.real(x), 0)).astype(carry.t.dtype) for x in leaves)

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
    before = select(log.slot[:, None] < 0, log.modes, before)
    return Events(
        t=log.t,
        switch=table[log.slot],
        mode_before=before[:, : model.declared],
        mode_after=log.modes[:, : model.declared],
        y_before=log.before,
        y_after=log.after,
        transversality=log.transversality,
        num=c.events,
        names=tuple(k.name for k in model.switches[: model.declared]),
    )


TOLERANCE = "The tolerances of the step size are `rtol=..., atol=...`."
HINTS = {name: TOLERANCE for name in ("tol", "rtols", "tolerance", "tolerances")} | {
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
    solver: dfx.AbstractSolver | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
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
    - `y0`: the state at `t0`, any pytree of floating point arrays of one dtype. Integers become floating point numbers.
    - `mode`: for a start on a surface, `{"name": value}` or one value for each switch: `sgn` +1, -1, or 0 to slide
        (also on a repulsive surface); `relay` 0 or 1 (needed between its two surfaces, 0 by default); `impact` 0 or 1
        to rest. Where the solution is not unique this chooses one; without it static friction holds as long as it can,
        a repulsive surface that is reached is crossed, and a start on one is refused. `Solution.unique` tells.
    - `solver`: an explicit diffrax Runge-Kutta solver, a diagonally implicit one for stiff fields, Euler,
        `nsjax.Taylor`, or for models that are affine in the state `nsjax.Exponential` or, for sweeps, `nsjax.Affine`.
        By default `diffrax.Tsit5()`; within `nsjax.sweep` that of `nsjax.method_for`, where nothing is said of steps
        (by `stepsize_controller`, `dt0`, `SaveAt(steps=...)` or `SaveAt(dense=True)`) and `adjoint` is not
        `RecursiveCheckpointAdjoint`.
    - `stepsize_controller`: by default `diffrax.PIDController` with `rtol = atol = 1e-8` (1e-5 for float32).
    - `rtol`, `atol`: relative and absolute tolerance of that default controller, if not these; not to be given together
        with `stepsize_controller`.
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
    t0, y0, given = checked_start(system, t0, y0, mode)
    t1 = checked_time("t1", t1, t0.dtype)
    check_span(system, t0, t1, saveat)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events, adjoint).checked(
        t0.dtype, rtol=rtol, atol=atol
    )
    # Steps and dense output are those of a solver. (Outside of sweeps nobody asks, so that it is one program there.)
    if dt0 is not None or saveat.dense or Request.of(saveat).steps or not is_sweep():
        integrator = integrator._replace(open=False)
    if throw:
        check_numbers(system, t0, t1, y0)
    system = arrays_of(system, t0.dtype)
    integrator = integrator.with_arrays(t0.dtype)
    if dt0 is not None:
        if known(dt0) and not np.all(np.asarray(dt0) > 0):
            raise ValueError(f"Argument `dt0` must be a time above zero, whatever the direction, but got {dt0}.")
        dt0 = jnp.abs(jnp.asarray(dt0, t0.dtype))
    concrete = throw and known((system, t0, t1, y0, given, integrator, saveat, dt0))
    within = throw and not concrete  # raised by the compiled program itself
    how = dict(exact=integrator.takes_exact, plain=integrator.may_be_plain)
    options = _Options(given, integrator, saveat, dt0, within, progress_meter, **how)
    sol, left = _run(system, t0, t1, y0, options)
    if left is not None:
        return left_over(left, sol)
    if not concrete:
        return sol
    if not known(sol.result):  # numbers that are known, within a function that is being compiled
        return raise_if(~is_okay(sol.result), sol.result, sol)
    if not is_okay(sol.result):
        raise SolveError(explain(system, sol, t1))
    return sol


def integrate(
    system: System,
    t0: Scalar,
    t1: Scalar,
    y0: Y,
    integrator: Integrator,
    *,
    mode: Any = None,
    saveat: dfx.SaveAt = dfx.SaveAt(t1=True),
    still: bool = False,
) -> Solution:
    """`solve` for arguments that have been checked, which never raises. `still`: only `y1` has derivatives, not what is
    saved or logged on the way, which makes a smaller program."""
    how = dict(still=still, exact=integrator.takes_exact, plain=integrator.may_be_plain)
    options = _Options(given_modes(system, mode), integrator.with_arrays(t0.dtype), saveat, **how)
    sol, left = _run(arrays_of(system, t0.dtype), t0, jnp.asarray(t1, t0.dtype), y0, options)
    return sol if left is None else left_over(left, sol)
