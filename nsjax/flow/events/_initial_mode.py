"""The mode in which a solution sets out."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._linalg import nearly
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState, OFF, put
from ...system._model import SwitchedSystem
from .._results import RESULTS
from ._mode_choice import settle


AT_ONCE = 0.01  # times the root of eps and of the time to be solved for: what is crossed sooner is where the start is


def start_mode(
    model: SwitchedSystem, t: Scalar, y: Y, given: dict[str, Any], horizon: Scalar
) -> tuple[ModeState, tuple[Any, ...], Bool[Array, ""], RESULTS]:
    """The mode in which the solution sets out: from the signs of h, from `mode=`, and on a surface by the fields; the
    values of the switches in it; and whether another solution sets out there too. `horizon`: for how long it is to be
    solved."""
    start = _Start(model, t, y, given, horizon)
    counts = model.counts(t)
    for k, switch in enumerate(model.switches):
        if k in counts:  # whatever `mode` says: it may be that of the same phase a period earlier
            start.put(counts[k])
        elif switch.levels:
            before = jnp.asarray(given.get(switch.name, switch.modes[0]), jnp.int32)
            start.put(model.level_at(k, t, y, before))
        elif switch.unilateral:
            start.put_contact(k)
        else:
            start.put_sign(k)
    start.join_surfaces_at_once()
    start.refuse_wrong_modes()
    at = start.at
    leaves = {k: jnp.zeros((), jnp.int32) for k in at}
    state, unsure, forked, wrong = settle(model, t, y, start.state(), at, leaves, tuple(start.chosen))
    for k in model.holdable:  # run backwards, see `transition`
        forked = forked | (model.held(k, state.mode[k]) & (model.direction < 0))
    result = RESULTS.where(unsure, RESULTS.repulsive_sliding, start.result)
    result = RESULTS.where(wrong, RESULTS.ambiguous_event, result)
    values, f = model.values_and_flow(t, y, state)
    return state._replace(roots=tuple(start.roots_there(state, values, f))), values, forked, result


class _Start:
    """The mode in which a solution sets out, determined switch by switch."""

    def __init__(self, model: SwitchedSystem, t: Scalar, y: Y, given: dict[str, Any], horizon: Scalar):
        self.model, self.t, self.y, self.given, self.horizon = model, t, y, given, horizon
        self.modes: list[Any] = []
        self.parts: list[Any] = []
        self.chosen: list[int] = []  # switches whose mode is given
        self.at: dict[int, Bool[Array, ""]] = {}  # as for `settle`
        self.on: dict[int, Bool[Array, ""]] = {}  # whether h is zero
        self.beyond: dict[int, Scalar] = {}  # how far the state is off the place where the given mode is
        self.result = RESULTS.successful

    def put(self, mode: Any, part: Any = None) -> None:
        self.modes.append(mode)
        self.parts.append(part)

    def state(self) -> ModeState:
        return ModeState.of(self.modes, self.parts)

    def surface(self, k: int) -> tuple[Scalar, Scalar, Any]:
        """The active component of h, its rounding, and which it is."""
        model, t, y = self.model, self.t, self.y
        h = jnp.stack(model.h(k, t, y))
        noise = model.rounding(lambda t, y: model.h(k, t, y), t, y)
        part = jnp.argmin(h)
        return h[part], noise[part], part.astype(jnp.int32) if model.parts[k] > 1 else None

    def put_contact(self, k: int) -> None:
        """A contact is at rest if that is given, or if neither gap nor velocity is more than rounding."""
        model, t, y, name = self.model, self.t, self.y, self.model.switches[k].name
        h, noise, part = self.surface(k)
        self.on[k], rests = jnp.abs(h) <= noise, jnp.zeros((), bool)
        if name in self.given:
            if k not in model.contacts:
                raise ValueError(
                    f"Argument `mode` must not name `{name}`: this impact surface cannot hold the solution (it is a "
                    f"minimum, or `s.{name}` is not a force that acts on d²h/dt²)."
                )
            self.at[k], rests = rests, jnp.asarray(self.given[name]) == 1
            self.beyond[k] = select(rests, jnp.abs(h), -h) - 1e6 * noise
            self.on[k] = h <= noise
        else:
            self.result = RESULTS.where(h < -noise, RESULTS.start_penetrates, self.result)
            if k in model.contacts:
                still = ModeState((), (*self.parts, part), ())
                (slow,) = model.rounding(lambda t, y: (model.level(k, t, y, still),), t, y)
                self.at[k] = rests = self.on[k] & (jnp.abs(model.level(k, t, y, still)) <= slow)
        self.put(rests.astype(jnp.int32), part)

    def put_sign(self, k: int) -> None:
        """A `sgn` switch has the sign of h, 0 on its surface, or what is given."""
        name = self.model.switches[k].name
        h, noise, part = self.surface(k)
        self.on[k] = jnp.abs(h) <= noise
        if name in self.given:
            mode = jnp.asarray(self.given[name], jnp.int32)
            if self.model.conditional(k):  # whether its contact is closed is seen later
                mode = select(mode == OFF, select(jnp.abs(h) <= noise, 0, jnp.sign(h)).astype(jnp.int32), mode)
            # A state taken from an earlier solution may carry some drift off its surface.
            self.beyond[k] = select(mode == 0, jnp.abs(h), -mode.astype(h.dtype) * h) - 1e6 * noise
            self.chosen.append(k)
            self.on[k] = mode.astype(h.dtype) * h <= noise
        else:
            mode = select(self.on[k], 0, jnp.sign(h)).astype(jnp.int32)
        self.at[k] = self.on[k]
        self.put(mode, part)

    def join_surfaces_at_once(self) -> None:
        """A start so near to a surface that an event there could not be told from the start is on it: the end of a
        period on the surface is off by rounding."""
        model, t, y, state = self.model, self.t, self.y, self.state()
        free = [k for k in model.which("signed") if k not in self.chosen]
        f = model.flow(t, y, state) if free else None
        for k in free:
            instant = 2 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + self.horizon)
            h = model.least(k, t, y)
            near = jnp.abs(h) <= instant * jnp.abs(frozen(model.approach(k, t, y, state, f)))
            self.on[k] = self.at[k] = self.on[k] | near
            self.modes[k] = select(self.on[k], 0, self.modes[k])

    def refuse_wrong_modes(self) -> None:
        model, t, y, state = self.model, self.t, self.y, self.state()
        f = model.flow(t, y, state) if self.beyond else None
        for k, gap in self.beyond.items():
            # Near the origin h has no rounding of its own, but a state that an earlier event left there has that of the
            # event's time. So the measure is how soon the surface is crossed, not how large h is.
            soon = AT_ONCE * float(jnp.finfo(t.dtype).eps) ** 0.5 * self.horizon
            off = gap > soon * self.speed(k, state, f)
            if model.conditional(k):
                off = off & ~model.absent(k, state.mode)
            self.result = RESULTS.where(off, RESULTS.wrong_mode, self.result)
            if model.switches[k].unilateral:
                below = off & (model.least(k, t, y) < 0)
                self.result = RESULTS.where(below, RESULTS.start_penetrates, self.result)

    def speed(self, k: int, state: ModeState, f: Y | None) -> Scalar:
        """Returns |dh/dt| of switch k; where it is held, that which h would have beside its surface."""
        model, t, y = frozen((self.model, self.t, self.y))
        rate = jnp.abs(frozen(model.approach(k, t, y, state, f)))
        if k not in model.holdable:
            return rate

        def beside(mode: int) -> ModeState:
            return state._replace(mode=put(state.mode, (k,), (jnp.asarray(mode, jnp.int32),)))

        if k in model.contacts:  # it would fall for all the time
            free = beside(0)
            (pull,) = model.rates((k,), t, y, free, model.values(t, y, free))
            fast = self.horizon * jnp.abs(pull)
        else:
            fast = jnp.maximum(*(jnp.abs(model.approach(k, t, y, beside(side))) for side in (1, -1)))
        return select(model.held(k, state.mode[k]), jnp.maximum(rate, fast), rate)

    def roots_there(self, state: ModeState, values: tuple[Any, ...], f: Y) -> list[Any]:
        """Guards of surfaces on which the start lies have a root there already. `values` of the switches and field `f`
        are those of the mode."""
        # Without this the first step would find the start itself as an event. A root is simple where the field crosses
        # the surface and double where it is tangent; more than two cannot be told apart.
        model, t, y, roots = self.model, self.t, self.y, list(state.roots)
        for k, value in enumerate(frozen(values)):
            if model.static(k) and k in model.holdable:
                edge = select(model.direction < 0, model.edge(k, value, nearly(t)), 0)
                roots[k] = select((state.mode[k] == 0) & ((k in self.chosen) | ~self.at[k]), edge, roots[k])
        for k, here in self.on.items():
            rate = model.approach(k, t, y, state, f)
            sign = 1 - state.mode[k] if model.switches[k].unilateral else state.mode[k]
            part = 0 if state.part[k] is None else state.part[k]
            size = model.sizes(lambda t, y, k=k: model.h(k, t, y), t, y, jnp.ones_like(t), f)[part]
            fresh = select(jnp.abs(rate) > jnp.sqrt(jnp.finfo(t.dtype).eps) * size, 1, 2)
            if model.conditional(k):
                sign = select(sign == OFF, 0, sign)
            settled = jnp.zeros((), bool) if k in self.chosen else self.at.get(k, jnp.zeros((), bool))
            roots[k] = select(here & ~settled & (sign != 0), fresh, roots[k]).astype(jnp.int32)
        return roots
