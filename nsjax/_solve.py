"""The flow: one flat loop whose body is one step of a diffrax solver.

Under `vmap` every lane is in its own mode and at its own time: it takes a step, or works on its event, and never waits
for the segments of the others.
"""

import functools as ft
from collections.abc import Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from ._check import check_model, check_solve
from ._compact import compact_cond
from ._crossing import deflate, elevate, nodes, to_bernstein, to_chebyshev
from ._event import land, Landing
from ._filippov import Model, State
from ._forward import forward_only
from ._jacobian import dense_jacobian
from ._once import once
from ._save import Log, Saved
from ._solution import Events, is_okay, RESULTS, Solution
from ._start import start_mode
from ._step import stack, Stepper
from ._structure import is_affine
from ._system import arrays_of, frozen, System
from ._types import Scalar, Y


class _Carry(eqx.Module):
    """What one turn of the loop hands to the next."""

    t: Scalar
    y: Y
    f: Y  # the field at (t, y)
    state: State
    dt: Scalar
    controller: PyTree
    active: Bool[Array, ""]
    result: RESULTS
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    events: Int[Array, ""]
    halted: Int[Array, ""]  # events in a row without progress in time
    halvings: Int[Array, ""]  # in a row, to resolve a guard
    grazed: Bool[Array, ""]  # whether an event was tangential
    log: Log | None
    saved: Saved
    meter: PyTree


class _Flow(eqx.Module):
    """One solve: the model, the method, and the body of its loop."""

    model: Model
    stepper: Stepper
    controller: dfx.AbstractStepSizeController
    t0: Scalar
    t1: Scalar
    max_steps: int = eqx.field(static=True)
    max_events: int = eqx.field(static=True)
    keep_steps: int = eqx.field(static=True)
    want_points: bool = eqx.field(static=True)
    meter: dfx.AbstractProgressMeter
    affine: tuple[bool, ...] = eqx.field(static=True)  # whether each guard is affine in (t, y)
    degree: int = eqx.field(static=True)  # of the polynomial for one that is not
    reverse: bool = eqx.field(static=True)  # whether the loop is to be transposed

    def coefficients(
        self, t: Scalar, t_next: Scalar, y: Y, y1: Y, ks: list[Y], state: State
    ) -> tuple[list[list[list[Scalar]]], Bool[Array, ""]]:
        """Bernstein coefficients `[slot][part][j]` of the guards along a step, and whether they represent them well.

        A guard affine in (t, y) has its values at the control points as coefficients; any other is interpolated, and
        the size of its last Chebyshev coefficients tells whether a polynomial of that degree can stand for it.
        """
        out: list[list[list[Scalar]]] = [[] for _ in self.model.slots]
        resolved = jnp.ones((), bool)
        dt = t_next - t
        if any(self.affine):
            n = self.stepper.degree
            rows = [
                self.model.guards(t + dt * (j / n), point, state)
                for j, point in enumerate(self.stepper.points(y, y1, ks))
            ]
            for i, affine in enumerate(self.affine):
                if affine:
                    out[i] = [list(c) for c in zip(*[row[i] for row in rows])]
        if not all(self.affine):
            n = self.degree
            at = [float(u) for u in nodes(n)]
            samples = self.stepper.samples(y, y1, ks, n)
            rows = [self.model.guards(t + dt * u, point, state) for u, point in zip(at, samples)]
            for i, affine in enumerate(self.affine):
                if affine:
                    continue
                for values in zip(*[row[i] for row in rows]):
                    v = jnp.stack(values)
                    tail = jnp.max(jnp.abs(jnp.asarray(to_chebyshev(n)[-2:], t.dtype) @ v))
                    resolved = resolved & ~(tail > max(1e-7, 64 * float(jnp.finfo(t.dtype).eps)) * jnp.max(jnp.abs(v)))
                    out[i].append(list(jnp.asarray(to_bernstein(n), t.dtype) @ v))
        return out, resolved

    def stacked(self, coefficients: list[list[list[Scalar]]]) -> Float[Array, "slots parts coefficients"]:
        """The same as one array, of one degree, known roots at the start of the step divided out of it."""
        n = self.stepper.degree if all(self.affine) else self.degree
        dtype = self.t0.dtype
        rows = [
            [
                jnp.stack(c) if len(c) == n + 1 else jnp.asarray(elevate(len(c) - 1, n), dtype) @ jnp.stack(c)
                for c in row
            ]
            for row in coefficients
        ]
        return self.model.stacked(rows, -1.0)

    def land(self, t: Scalar, t_next: Scalar, y: Y, f: Y, state: State, coefficients: list) -> Landing:
        """The step once more, to its first event."""
        coefficients = lax.stop_gradient(coefficients)
        known = self.model.stacked(self.model.known_roots(state), 0)
        polynomials = deflate(self.stacked(coefficients), known)
        return land(self.model, self.stepper, self.want_points, self.t0, t, t_next, y, f, state, polynomials)

    def body(self, c: _Carry) -> _Carry:
        model, stepper = self.model, self.stepper

        def flow(t: Scalar, y: Y) -> Y:
            return model.flow(t, y, c.state)

        t_next = jnp.where(c.t + c.dt >= self.t1, self.t1, c.t + c.dt)
        y1, error, ks, _ = stepper(flow, c.t, t_next, c.y, c.f)
        # An error that is not a number is too large.
        error = jax.tree.map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)
        terms = dfx.ODETerm(lambda t, y, args: flow(t, y))
        # The step size is no function to be differentiated; powers of an error of zero are not even differentiable.
        t_still, t_next_still, y_still, y1_still, error = frozen((c.t, t_next, c.y, y1, error))
        # A step that overflows is too long, but must not make the next one infinity divided by infinity.
        y1_still = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(new), new, old), y1_still, y_still)
        order = stepper.solver.error_order(terms)
        keep, a, b, _, controller, outcome = self.controller.adapt_step_size(
            t_still, t_next_still, y_still, y1_still, None, error, order, c.controller
        )
        dt = b - a
        halvings = c.halvings
        result = RESULTS.promote(outcome)

        if model.slots:
            coefficients, resolved = self.coefficients(c.t, t_next, c.y, y1, ks, c.state)
            finite, quiet = _survey(coefficients, model.known_roots(c.state))
            result = RESULTS.where(keep & ~finite, RESULTS.nonfinite_field, result)
            # A guard that is no polynomial to the precision needed is not trusted: a shorter step is. (At most so
            # often: one with a kink never is.)
            # Nor is a step so short that rounding of time alone spoils the polynomial.
            eps = float(jnp.finfo(c.t.dtype).eps)
            floor = 4 * eps / max(1e-7, 64 * eps) * jnp.maximum(jnp.abs(c.t), self.t1 - self.t0)
            poor = keep & finite & ~resolved & (halvings < 30) & (t_next - c.t > floor)
            halvings = jnp.where(poor, halvings + 1, jnp.where(keep, 0, halvings))
            keep = keep & ~poor
            dt = jnp.where(poor, 0.5 * (t_next - c.t), dt)
            # On the last few ulps before the end the polynomials are rounding.
            busy = c.active & keep & finite & ~quiet & (t_next - c.t > 4 * eps * jnp.abs(c.t))
        keep = keep & c.active

        y_end = model.project(t_next, y1, c.state)
        f_end = stepper.last_slope(ks, t_next - c.t, flow, t_next, y_end)
        t, y, f, state = t_next, y_end, f_end, c.state
        event = jnp.zeros((), bool)
        events, halted, grazed, log = c.events, c.halted, c.grazed, c.log
        t_stop, points, before = t_next, None, y1
        if self.want_points:
            points = stack(stepper.points(c.y, y1, ks))
        if model.slots:
            here = (c.t, t_next, c.y, c.f, c.state, lax.stop_gradient(coefficients))
            still = Landing(
                event,
                t_next,
                t_next,
                y1,
                y_end,
                f_end,
                c.state,
                jnp.zeros((), jnp.int32),
                event,
                points,
                c.t,
                event,
                RESULTS.successful,
            )
            there = _landed(busy, self, here, still)
            event = busy & there.found

            def pick(x: Any, y: Any) -> Any:
                return jax.tree.map(lambda a, b: jnp.where(event, a, b), x, y)

            t, y, f, state = pick(
                (there.t_after, there.y_after, there.f_after, there.state), (t_next, y_end, f_end, c.state)
            )
            state = pick(state, state._replace(roots=tuple(jnp.zeros_like(r) for r in state.roots)))
            t_stop, before = pick((there.t, there.y_before), (t_next, y1))
            if self.want_points:
                points = pick(there.points, points)
            log_it = event & there.news
            assert log is not None
            at = there.t_after * model.direction
            row = (at, there.y_before, there.y_after, there.slot, there.state.mode, there.transversality)
            log = log.write(events, log_it, *row)
            grazed = grazed | (event & there.grazes)
            events = events + log_it.astype(jnp.int32)
            halted = jnp.where(event, jnp.where(there.t > c.t, 0, halted + 1), jnp.where(keep, 0, halted))
            result = RESULTS.where(event, there.result, result)
            result = RESULTS.where(halted > 8 + 4 * len(model.switches), RESULTS.stuck_in_events, result)

        # What happened to this lane: an event, an accepted step, a rejected one, or nothing as it has ended.
        moved = keep | event

        def settle(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(moved, a, b), new, old)

        saved = c.saved
        if saved.request.ts is not None:
            mode = c.state.mode
            saved = saved.write_times(moved, c.t, t_stop, points, mode, model.system, model.direction, self.reverse)
        saved = saved.write_step(moved, c.accepted, c.t, t_stop, points)
        accepted = c.accepted + moved.astype(jnp.int32)
        if self.keep_steps:
            due = moved & ((accepted % self.keep_steps == 0) | event)
            saved = saved.write(due, t_stop, before, c.state.mode, model.system, model.direction)
            saved = saved.write(due & event, t, y, state.mode, model.system, model.direction)
        t, y, f, state = settle((t, y, f, state), (c.t, c.y, c.f, c.state))

        steps = c.steps + c.active.astype(jnp.int32)
        done = t >= self.t1
        result = RESULTS.where(
            (steps >= self.max_steps) & ~done & (result == RESULTS.successful), RESULTS.max_steps_reached, result
        )
        if model.slots:
            full = (events >= self.max_events) & ~done & (result == RESULTS.successful)
            result = RESULTS.where(full, RESULTS.max_events_reached, result)
        bad = ~_finite((y, f))
        result = RESULTS.where(bad, RESULTS.nonfinite_field, result)
        # Rejected again and again, down to nothing: at a place where the field ends, or where it is too rough.
        tiny = ~moved & ((t + dt <= t) | (dt <= 1e-6 * float(jnp.finfo(t.dtype).eps) * (self.t1 - self.t0)))
        ended = ~_finite(y1)
        tiny = tiny & (result == RESULTS.successful)
        result = RESULTS.where(tiny & ended, RESULTS.nonfinite_field, result)
        result = RESULTS.where(tiny & ~ended, RESULTS.dt_min_reached, result)
        result = RESULTS.where(c.active, result, c.result)
        active = c.active & ~done & (result == RESULTS.successful)
        meter = self.meter.step(c.meter, jnp.where(active, (t - self.t0) / (self.t1 - self.t0), 1.0))

        def hold(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(c.active, a, b), new, old)

        return _Carry(
            t=t,
            y=y,
            f=f,
            state=state,
            dt=hold(dt, c.dt),
            controller=hold(controller, c.controller),
            active=active,
            result=result,
            steps=steps,
            accepted=accepted,
            events=events,
            halted=halted,
            halvings=halvings,
            grazed=grazed,
            log=log,
            saved=saved,
            meter=meter,
        )


def _survey(coefficients: list, known: list) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether all coefficients are finite, and whether certainly no guard has a root on the step: one of its parts is
    positive in all coefficients but those which vanish with its known roots."""

    def least(c: list[Scalar], roots: Int[Array, ""]) -> Scalar:
        return ft.reduce(jnp.minimum, [jnp.where(j < roots, 1, x) if j < 3 else x for j, x in enumerate(c)])

    rows = [ft.reduce(jnp.maximum, map(least, row, roots)) for row, roots in zip(coefficients, known)]
    return _finite(coefficients), once(ft.reduce(jnp.minimum, rows)) > 0


def _finite(tree: Any) -> Bool[Array, ""]:
    """Whether all numbers are finite: only then are all of their products with zero."""
    return once(sum(jnp.sum(0 * x) for x in jax.tree.leaves(tree))) == 0


def _landed(pred: Any, flow: _Flow, here: tuple, default: Landing) -> Landing:
    """`flow.land(*here)` for lanes with work to do, else `default`."""
    dynamic, static = eqx.partition((flow, here), eqx.is_array)
    dynamic_default, static_default = eqx.partition(default, eqx.is_array)

    def branch(dynamic: Any) -> Any:
        flow, here = eqx.combine(dynamic, static)
        return eqx.filter(flow.land(*here), eqx.is_array)

    if flow.reverse:  # `compact_cond` knows no transposition
        return eqx.combine(lax.cond(pred, branch, lambda _: dynamic_default, dynamic), static_default)
    return eqx.combine(compact_cond(pred, branch, (dynamic,), dynamic_default), static_default)


@eqx.filter_jit
def _run(
    system: System,
    t0: Scalar,
    t1: Scalar,
    y0: Y,
    given: dict[str, Any],
    solver: dfx.AbstractSolver,
    controller: dfx.AbstractStepSizeController,
    saveat: dfx.SaveAt,
    dt0: Scalar | None,
    max_steps: int,
    max_events: int,
    adjoint: dfx.AbstractAdjoint,
    throw: bool,
    meter: dfx.AbstractProgressMeter,
) -> Solution:
    def run(system: System, t0: Scalar, t1: Scalar, y0: Y) -> Solution:
        options = solver, controller, saveat, dt0, max_steps, max_events, adjoint, throw, meter
        return _integrate(system, t0, t1, y0, given, *options)

    if isinstance(adjoint, dfx.DirectAdjoint):
        return dense_jacobian(run, system, t0, t1, y0)
    if not isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        system, t0, t1, y0 = forward_only(
            (system, t0, t1, y0),
            "`nsjax.solve` was differentiated in reverse mode (`jax.grad`, `jax.vjp`, `jax.jacrev`), which needs "
            "`adjoint=diffrax.DirectAdjoint()` (up to some tens of parameters and states) or "
            "`adjoint=diffrax.RecursiveCheckpointAdjoint()` (more). Or use `jax.jacfwd`.",
        )
    return run(system, t0, t1, y0)


def _integrate(
    system: System,
    t0: Scalar,
    t1: Scalar,
    y0: Y,
    given: dict[str, Any],
    solver: dfx.AbstractSolver,
    controller: dfx.AbstractStepSizeController,
    saveat: dfx.SaveAt,
    dt0: Scalar | None,
    max_steps: int,
    max_events: int,
    adjoint: dfx.AbstractAdjoint,
    throw: bool,
    meter: dfx.AbstractProgressMeter,
) -> Solution:
    reverse = isinstance(adjoint, dfx.RecursiveCheckpointAdjoint)
    direction = jnp.where(t1 >= t0, 1, -1).astype(t0.dtype)
    t0 = check_model(system, t0, y0, direction)
    start, stop = t0 * direction, t1 * direction
    model = Model(system, direction, start, y0)
    for k in model.contacts:
        zeros = tuple(jnp.zeros_like(t0) for _ in model.switches)
        unit = tuple(jnp.where(i == k, 1, zero) for i, zero in enumerate(zeros))
        blank = State((), (None,) * len(zeros), ())
        force = model.rates((k,), start, y0, blank, unit)[0] - model.rates((k,), start, y0, blank, zeros)[0]
        name = model.switches[k].name
        start = eqx.error_if(
            start,
            force < 0,
            f"`{type(system).__name__}.vector_field` must contain `s.{name}` with the sign with which a contact force "
            f"s.{name} >= 0 opens the gap `{name}`, but it closes it. Change its sign.",
        )
    stepper = Stepper(solver)
    max_events = max_events if model.slots else 0
    state, result = start_mode(model, start, y0, given)
    f0 = model.flow(start, y0, state)

    def guard(i: int, ty: tuple[Scalar, Y]) -> list[Scalar]:
        return model.guards(ty[0], ty[1], state)[i]

    affine = tuple(is_affine(ft.partial(guard, i), (start, y0)) for i in range(len(model.slots)))
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
    flow = _Flow(
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
        degree=max(8, stepper.degree + 3),
        reverse=reverse,
    )
    zero = jnp.zeros((), jnp.int32)
    bad = ~_finite((y0, f0, start, stop))
    result = RESULTS.where(bad, RESULTS.nonfinite_field, result)
    carry = _Carry(
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
        grazed=jnp.zeros((), bool),
        log=Log(max_events, y0, len(model.switches)) if model.slots else None,
        saved=saved,
        meter=meter.init(),
    )
    dynamic, static = eqx.partition(jax.tree.map(_strong, carry), eqx.is_array)

    def body(dynamic: Any) -> Any:
        new = eqx.filter(flow.body(eqx.combine(dynamic, static)), eqx.is_array)
        return jax.tree.map(lambda old, x: x.astype(old.dtype), dynamic, new)

    # `unvmap_any` keeps the predicate unbatched, so that ended lanes cost no copy of the buffers.
    if isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        options = dict(kind="checkpointed", max_steps=max_steps, checkpoints=adjoint.checkpoints)
    else:
        options = dict(kind="lax")
    dynamic = eqxi.while_loop(lambda c: eqxi.unvmap_any(c.active), body, dynamic, **options)
    c: _Carry = eqx.combine(dynamic, static)
    meter.close(c.meter)
    result = RESULTS.where(c.grazed & (c.result == RESULTS.successful), RESULTS.tangential_event, c.result)
    saved = c.saved
    if request.t1:
        saved = saved.write(True, c.t, c.y, c.state.mode, system, direction)
    sol = Solution(
        system=system,
        t0=t0,
        t1=c.t * direction,
        y1=c.y,
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
        dense=None if saved.dense is None else (*saved.dense, direction, c.accepted),
    )
    if throw:
        sol = result.error_if(sol, ~is_okay(result))
    return sol


def _strong(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, (bool, int, float)) else x


def _row(mode: tuple) -> Int[Array, " switches"]:
    return jnp.stack(mode) if mode else jnp.zeros(0, jnp.int32)


def _events(model: Model, c: _Carry, start: State) -> Events:
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


def solve(
    system: System,
    t0: Any,
    t1: Any,
    y0: Y,
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
) -> Solution:
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
        to rest.
    - `solver`: an explicit diffrax Runge-Kutta solver, a diagonally implicit one for stiff fields, or Euler.
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
        system, t0, t1, y0, mode, solver, stepsize_controller, saveat, max_steps, max_events
    )
    system = arrays_of(system, t0.dtype)
    # Tolerances are numbers too: a new one is no new program.
    plain = [n for n in ("rtol", "atol") if isinstance(getattr(controller, n, None), (int, float))]
    controller = eqx.tree_at(
        lambda c: [getattr(c, n) for n in plain],
        controller,
        [jnp.asarray(getattr(controller, n), t0.dtype) for n in plain],
    )
    if dt0 is not None:
        dt0 = jnp.abs(jnp.asarray(dt0, t0.dtype))
    return _run(
        system,
        t0,
        t1,
        y0,
        given,
        solver,
        controller,
        saveat,
        dt0,
        max_steps,
        max_events,
        adjoint,
        throw,
        progress_meter,
    )
