"""The Poincaré map (6.4): from one crossing of a section to the next."""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics._autodiff import frozen
from .._numerics._select import select
from .._numerics._text import positive
from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..flow.events._initial_mode import AT_ONCE
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch, forwarded
from ..system._system import SwitchValues, System
from ._iterate import Iterate, iterated, PoincareMap


PERIODS = 100  # of the forcing in which a solution is expected to return

Section = Callable[[Scalar, Y], Scalar] | str


def _section_name(system: System) -> str:
    name = "section"
    while any(k.name == name for k in system.switches):
        name += "_"
    return name


@ft.cache  # switches are told apart by identity
def _watch(name: str, ends: tuple[int, ...]) -> AbstractSwitch:
    return sgn(lambda self, t, y: self.section(t, y), name=name)._with(ends=ends)


@ft.cache
def _ending(switch: AbstractSwitch, ends: tuple[int, ...]) -> AbstractSwitch:
    return forwarded(switch)._with(ends=ends)


class _Watched(System):
    """A system whose solutions end at a section: at a function's zero, or at an event of one of its switches."""

    system: System
    section: Callable[[Scalar, Y], Scalar] | None
    name: str | None = eqx.field(static=True)  # of the switch, if it is one
    direction: int = eqx.field(static=True)

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        if self.section is None:
            return tuple(
                _ending(k, k.modes_after(self.direction)) if k.name == self.name else forwarded(k)
                for k in self.system.switches
            )
        ends = (self.direction,) if self.direction else (1, -1)
        # Last: at an instant which it shares with an event the state on the section is that after the event.
        return (*map(forwarded, self.system.switches), _watch(_section_name(self.system), ends))

    @property
    def jumps_in_time(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.jumps_in_time

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        return self.system.vector_field(t, y, self.system.values(tuple(s[k.name] for k in self.system.switches)))

    @property
    def period(self) -> Float[Array, ""] | float | None:
        return self.system.period


class _Section(PoincareMap):
    """From one crossing of a section to the next."""

    section: Callable[[Scalar, Y], Scalar] | None
    name: str | None = eqx.field(static=True)
    direction: int = eqx.field(static=True)
    max_time: Scalar

    def flow_of(self, system: System) -> System:
        return _Watched(system, self.section, self.name, self.direction)

    def horizon(self, system: System, t: Scalar) -> Scalar:
        return self.max_time

    def sides(self, model: SwitchedSystem, t: Scalar, y: Y, state: ModeState) -> tuple[Array, ...]:
        """A start on the section is no return. Nor is one that an earlier computation left a little before it: it
        counts as being beyond."""
        if self.section is None:
            return state.mode
        *others, side = state.mode
        k = len(others)
        h, rate = model.h(k, t, y)[0], model.approach(k, t, y, state)
        at_once = AT_ONCE * float(jnp.finfo(t.dtype).eps) ** 0.5 * self.max_time
        on = (jnp.abs(h) <= at_once * jnp.abs(rate)) & (rate != 0)
        return *others, select(on, jnp.sign(rate).astype(jnp.int32), side)

    def passage(
        self, system: System, here: tuple[Scalar, Scalar, Y], mode: Any, still: bool = False
    ) -> tuple[Scalar, Y, RESULTS, Solution]:
        _, t, y = here
        end = t + self.max_time
        sol = integrate(system, t, end, y, self.integrator, mode=mode, still=still)
        late = is_okay(sol.result) & ~(sol.t1 < end)
        y1 = sol.y1
        for switch in system.switches:
            if switch.unilateral and switch.ends:
                y1 = _onto(switch, system, sol, y1)
        return sol.t1, y1, RESULTS.where(late, RESULTS.no_return, sol.result), sol


def _onto(switch: AbstractSwitch, system: System, sol: Solution, y: Y) -> Y:
    """The state after an impact without what rounding has left between it and the surface: where h is compared with
    nothing but zero, a solution that goes on from there must not begin beyond it. (A reset that takes the state away
    from the surface has not left it there by rounding.)"""
    flat, unravel = jfu.ravel_pytree(y)
    last = jax.tree.map(lambda x: x[sol.events.num - 1], sol.events.y_before)
    still, t_still, x, before = frozen((system, sol.t1, flat, jfu.ravel_pytree(last)[0]))

    def gap(x: Array) -> Scalar:
        return switch.least(still, t_still, unravel(x))

    h, normal = jax.value_and_grad(gap)(x)
    rounding = float(jnp.finfo(x.dtype).eps) ** 0.5 * jnp.max(jnp.abs(x)) * jnp.linalg.norm(normal)
    h = select(jnp.abs(h) <= 2 * jnp.abs(gap(before)) + rounding, h, 0)
    return unravel(flat - h * normal / select(normal @ normal == 0, 1, normal @ normal))


def section_map(
    system: System, section: Section, direction: int, max_time: Any, t: Scalar, y: Y, integrator: Integrator
) -> PoincareMap:
    """The map of a section, after a look at the arguments that make it."""
    owner = type(system).__name__
    if direction not in (1, 0, -1):
        raise ValueError(f"Argument `direction` must be 1, -1 or 0 (both), but got {direction!r}.")
    if isinstance(section, str):
        found = {k.name: k for k in system.switches}.get(section)
        if found is None:
            known = ", ".join(f"`{k.name}`" for k in system.switches) or "none"
            raise ValueError(
                f"Argument `section` must be a function of (t, y), or the name of a switch of `{owner}` ({known}), but "
                f"got {section!r}."
            )
        if found.ticking:
            raise ValueError(
                f"Argument `section` must not be the clock `{section}`, which ticks by itself: take "
                "`nsjax.stroboscopic_map`."
            )
        if found.unilateral and direction == -1:
            raise ValueError(
                f"Argument `direction` must be 1 or 0 for the impact `{section}`, because an iterate is the state "
                "after it, but got -1."
            )
    elif callable(section):
        h = jax.eval_shape(section, t, y)
        if not isinstance(h, jax.ShapeDtypeStruct) or h.shape != () or h.dtype != t.dtype:
            got = f"{h.dtype}{list(h.shape)}" if isinstance(h, jax.ShapeDtypeStruct) else repr(h)
            raise ValueError(
                f"Argument `section` must return a scalar of dtype {t.dtype}, which vanishes on the section, but "
                f"returned {got}."
            )
    else:
        raise TypeError(
            f"Argument `section` must be a function of (t, y), or the name of a switch, but got {section!r}."
        )
    if max_time is None and system.period is None:
        raise ValueError(
            f"Argument `max_time` must be given, because `{owner}` is autonomous and has no time of its own: how long "
            "a solution may take to return [time]."
        )
    time = jnp.asarray(system.period, t.dtype) * PERIODS if max_time is None else jnp.asarray(max_time, t.dtype)
    if isinstance(section, str):
        return _Section(integrator, None, section, direction, time)
    # A plain function is no array, nor has it any: it belongs to the structure.
    plain = jax.tree.leaves(section) == [section]
    return _Section(integrator, jax.tree_util.Partial(section) if plain else section, None, direction, time)


def poincare_map(
    system: System,
    section: Section,
    y0: Y,
    *,
    direction: int = 1,
    number: int = 1,
    iterates: int | None = None,
    t0: Any = 0.0,
    mode: Any = None,
    solver: dfx.AbstractSolver | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 256,
    max_time: Any = None,
    adjoint: dfx.AbstractAdjoint = dfx.ForwardMode(),
    throw: bool = True,
) -> Iterate:
    """The Poincaré map (6.4): where the solution from `y0` meets a section next.

    ```python
    def top(t, y):  # x is largest where v falls through zero
        return y.v

    first = nsjax.poincare_map(nsjax.gallery.StickSlip(), top, y0, direction=-1, max_time=100.0)
    first.t, first.y.x
    ```

    The crossing is located like an event, to the accuracy of the flow. `jax.jacfwd` of the state with respect to `y0`
    is the derivative (6.7) of the map; of the time, how much later solutions from beside `y0` return.

    A start on the section is no crossing of it: the solution leaves first. So is one that would cross it within
    1.5e-10 of `max_time` (float32: 3.5e-6). What an impact jumps over is not crossed.

    **Arguments:**

    - `system`: the model.
    - `section`: a function `h(t, y)` of time and state, zero on the section and smooth near it; or the name of a
        switch, whose events are then the iterates, with the state after them. The latter is for sections on which the
        solution slides or from which it rebounds. (Every new function is compiled: define it once, not in a loop.)
    - `y0`: the state at `t0`, on the section or not.
    - `direction`: 1 to count crossings where h rises, -1 where it falls, 0 for both. Of a `sgn` switch, crossings to
        that side, and 0 for all of its events; of a relay 1 where it switches on, -1 off; of an impact 1 or 0.
    - `number`: which crossing, counted from 1: that power of the map.
    - `iterates`: how many iterates, which then have a leading axis; by default one, without.
    - `t0`, `mode`, `solver`, `stepsize_controller`, `rtol`, `atol`, `max_events`, `adjoint`: as for `solve`.
        `max_steps`: for each return.
    - `max_time`: how long each return may take [time]; forced systems: by default a hundred periods.
    - `throw`: whether a failure raises; if not, look at `Iterate.result`, which has one entry a lane under `vmap`.

    **Returns:** an `Iterate`: time, state and mode at the crossing. Its result is `RESULTS.tangential_event`, which is
    no failure, where the solution grazed a surface, or the section.

    **Raises:** `TypeError`, `ValueError` for mistakes in the arguments; a runtime error if the solution does not
    return.
    """
    positive("number", number)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events, adjoint)

    def make(system: System, t: Scalar, y: Y) -> PoincareMap:
        return section_map(
            system, section, direction, max_time, t, y, integrator.checked(t.dtype, rtol=rtol, atol=atol)
        )

    return iterated(make, system, (t0, y0, mode), iterates, number, throw)
