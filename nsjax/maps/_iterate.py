"""Maps of a solution onto itself, applied over and over: Poincaré maps and what they give."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._select import select
from .._numerics._text import between, listed, positive, shown, written
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._results import is_okay, outcomes, raise_if, RESULTS
from ..flow._solution import Solution
from ..flow.events._initial_mode import start_mode
from ..system._checks import check_model
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System


@shown
class Iterate(NamedTuple):
    """An iterate of a Poincaré map; several have a leading axis.

    **Attributes:**

    - `t`: its time [time].
    - `y`: the state there; NaN where there is none.
    - `mode`: one value for each switch, as `mode=` of `poincare_map` and `solve` takes it.
    - `result`: `RESULTS`.
    """

    t: Scalar
    y: Y
    mode: Int[Array, " switches"]
    result: RESULTS

    def __str__(self) -> str:
        axes = jnp.ndim(self.t)
        if axes:
            head = f"{self.t.size} iterates from t = {between(self.t)}"
            return f"{head}\n  states  {written(self.y, axes)}\n  result  {outcomes(self.result)}"
        mode = f"; mode ({listed(self.mode)})" if len(self.mode) else ""
        return f"iterate at t = {float(self.t):.10g}: {written(self.y)}{mode}; {outcomes(self.result)}"


class Start(NamedTuple):
    """Where iterates begin."""

    t0: Scalar  # of the solution
    t: Scalar
    y: Y
    mode: Int[Array, " switches"]
    result: RESULTS
    named: tuple[bool, ...]  # which switches `mode=` of `solve` may name

    def given(self, system: System, mode: Array) -> dict[str, Array]:
        """A later mode, as `solve` takes it."""
        return {k.name: mode[i] for i, k in enumerate(system.switches) if self.named[i]}


class PoincareMap(eqx.Module):
    """A Poincaré map, applied over and over."""

    integrator: Integrator

    @abc.abstractmethod
    def flow_of(self, system: System) -> System:
        """The system to be solved."""

    @abc.abstractmethod
    def passage(
        self, system: System, here: tuple[Scalar, Scalar, Y], mode: Any, still: bool = False
    ) -> tuple[Scalar, Y, RESULTS, Solution]:
        """To the next iterate after the one at (t, y), of a solution that began at t0: its time, state and result, and
        the solution on the way there.

        **Arguments:**

        - `here`: t0, t, y.
        - `still`: whether only the state has derivatives.
        """

    def once(self, system: System, t: Scalar, t0: Scalar, y: Y, mode: Any) -> tuple[Scalar, Y, Array, RESULTS]:
        """The next iterate after the one at (t, y), of a solution that began at t0."""
        later, y, result, sol = self.passage(system, (t0, t, y), mode)
        return later, y, sol.mode1, result

    @abc.abstractmethod
    def horizon(self, system: System, t: Scalar) -> Scalar:
        """How long one application may take."""

    def start(self, system: System, t: Scalar, y: Y, given: dict[str, Any]) -> Start:
        """What `iterates` begins with."""
        one = jnp.ones_like(t)
        t = check_model(system, t, y, one)
        system = self.flow_of(system)
        still, t_still, y_still = frozen((system, t, y))
        model = SwitchedSystem(still, one, t_still, y_still)
        named = _named(model)
        given = {s.name: given[s.name] for s, may in zip(model.switches, named) if may and s.name in given}
        state, _, _, result = start_mode(model, t_still, y_still, given, self.horizon(still, t))
        modes = [m.astype(jnp.int32) for m in self.sides(model, t_still, y_still, state)]
        return Start(t, t, y, jnp.stack(modes) if modes else jnp.zeros(0, jnp.int32), result, named)

    def named(self, system: System, t: Scalar, y: Y) -> tuple[bool, ...]:
        """`Start.named`, which depends on nothing but the structure of the model."""
        return _named(SwitchedSystem.forwards(self.flow_of(system), t, y))

    def sides(self, model: SwitchedSystem, t: Scalar, y: Y, state: ModeState) -> tuple[Array, ...]:
        """The mode in which a solution sets out."""
        return state.mode

    def iterates(self, system: System, start: Start, number: int, each: int = 1) -> Iterate:
        """So many iterates, of the `each`-th power of the map, from what `start` returned."""
        begin, step = self._stepping(system, start)
        _, rows = lax.scan(lambda here, _: (step(here),) * 2, begin, None, length=number * each)
        t, y, mode, result = jax.tree.map(lambda x: x[each - 1 :: each], rows)
        t = jax.vmap(unless_failed)(result, t)
        return Iterate(t, y, mode[:, : len(system.switches)], result)

    def skip(self, system: System, start: Start, number: int) -> Start:
        """So many iterates later."""
        begin, step = self._stepping(system, start)
        now = lax.fori_loop(0, number, lambda _, here: step(here), begin)
        t, y, mode, result = now
        return Start(start.t0, t, y, mode, result, start.named)

    def _stepping(self, system: System, start: Start) -> tuple[tuple, Callable[[tuple], tuple]]:
        system = self.flow_of(system)

        def step(here: tuple) -> tuple:
            t, y, mode, result = here
            later, y, mode, now = self.once(system, t, start.t0, y, start.given(system, mode))
            # What has failed stays failed; it goes on from NaN, which takes no step.
            result = RESULTS.where(is_okay(result) & (now != RESULTS.successful), now, result)
            return select(is_okay(result), later, t), unless_failed(result, y), mode, result

        return (start.t, start.y, start.mode, start.result), step


def _named(model: SwitchedSystem) -> tuple[bool, ...]:
    """An impact that cannot be rested upon has one mode only, of which `solve` wants to hear nothing."""
    return tuple(k in model.contacts or not s.unilateral for k, s in enumerate(model.switches))


@interactive
def _apply(
    step: PoincareMap, system: System, t0: Scalar, y0: Y, given: dict[str, Any], number: int | None, each: int
) -> Iterate:
    rows = step.iterates(system, step.start(system, t0, y0, given), number or 1, each)
    return jax.tree.map(lambda x: x[0], rows) if number is None else rows


def iterated(
    make: Callable[[System, Scalar, Y], PoincareMap],
    system: System,
    start: tuple[Any, Y, Any],
    iterates: int | None,
    each: int,
    throw: bool,
) -> Iterate:
    """Checks what the two maps have in common, and applies them from a `start`: time, state, mode."""
    if iterates is not None:
        positive("iterates", iterates)
    t0, y0, given = checked_start(system, *start)
    system = arrays_of(system, t0.dtype)
    out = _apply(make(system, t0, y0), system, t0, y0, given, iterates, each)
    if throw:
        last = jax.tree.map(lambda x: x if iterates is None else x[-1], out.result)
        out = raise_if(~is_okay(last), last, out)
    return out


def unless_failed(result: RESULTS, tree: Any) -> Any:
    """`tree`, or NaN, derivatives included."""
    return jax.tree.map(lambda x: x * select(is_okay(result), 1, jnp.nan).astype(x.dtype), tree)
