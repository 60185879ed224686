"""Branches of periodic orbits."""

import dataclasses
import math
from typing import Any, Generic, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ..._numerics._text import components, shown
from ..._types import StateT, Y
from ...flow._archive import table
from ...orbits._find_orbit import find_orbit
from ...orbits._orbit import Orbit
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._guess import Segment
from ...orbits.segments._itinerary import GRAZING, REPELLING_EXIT, TIME
from ...setvalued._crossing import EigenvalueCrossing
from ...system._parameter import parameter_path, put_parameter
from ...system._system import System
from .._branch import AbstractBranch, BranchSegment, descends, named_apart
from ._bifurcation import OrbitBifurcation, OrbitHalfBranch, Origin
from ._branch_switching import itinerary_text
from ._record import states_of
from ._tracer import midpoint, OrbitPoint


@shown
class OrbitBranch(AbstractBranch[OrbitBifurcation], Generic[StateT]):
    """A curve of periodic orbits over a parameter.

    **Attributes:**

    - `system`, `parameter`: the model, and the name of the parameter.
    - `values`: of the parameter, at each point.
    - `periods`: of the orbits [time]. `orders`: over that of the forcing; ones if there is none.
    - `ts`, `ys`: a time, and the state of each orbit then, away from events and from where it sticks; leaves with a
        leading axis.
    - `low`, `high`, `mean`: of each component of the state along the orbit, in the structure of `ys`.
    - `multipliers`: shape `(points, n)`, largest modulus first; infinite on orbits that are infinitely unstable.
    - `stable`: whether all but the trivial one are inside the unit circle.
    - `admissible`: whether they are orbits of the system: false along a virtual branch, on which the segments of the
        orbits at a corner are followed beyond it, whatever surfaces they pass, or with a negative duration.
    - `itineraries`: the modes that each orbit passes through, as text.
    - `segments`: of each orbit, from its time in `ts` on: a guess for `find_orbit`.
    - `records`: what the functions `record` of `continue_orbit` gave, by name; arrays with a leading axis.
    - `special`: the special points on it, in their order.
    - `indices`: at which point of the branch each is. A corner is there with the limits of its multipliers from both
        sides, at `indices` and the point after.
    - `ends`: why it begins and ends where it does.
    - `others`: the other branches that were found, on the one that `continue_orbit` returns.
    """

    system: System
    parameter: str
    values: Float[np.ndarray, " points"]
    periods: Float[np.ndarray, " points"]
    orders: Int[np.ndarray, " points"]
    ts: Float[np.ndarray, " points"]
    ys: Y
    low: Y
    high: Y
    mean: Y
    multipliers: Complex[np.ndarray, "points n"]
    stable: Bool[np.ndarray, " points"]
    admissible: Bool[np.ndarray, " points"]
    itineraries: tuple[str, ...]
    segments: tuple[tuple[Segment, ...], ...]
    records: dict[str, np.ndarray]
    special: tuple[OrbitBifurcation, ...]
    indices: tuple[int, ...]
    ends: tuple[str, str]
    others: "tuple[OrbitBranch[StateT], ...]" = ()

    not_saved = (Origin,)

    def system_at(self, index: int) -> System:
        """The model with the parameter's value at a point."""
        path = parameter_path(self.system, self.parameter)
        return put_parameter(self.system, path, jnp.asarray(self.values[index]))

    def orbit(self, index: int, **options: Any) -> Orbit[StateT]:
        """The orbit at a point of the branch, for all that can be done with an `Orbit`.

        **Arguments:**

        - `index`: which point.
        - `options`: for `find_orbit`. The orbit is found in segments, however unstable it is, which is a program for
            each number of them; with `method="shooting"`, for orbits that are not very unstable, it is one for all.

        **Returns:** the `Orbit`, of `system_at(index)`.

        **Raises:** `ValueError` for a point of a virtual branch.
        """
        if not self.admissible[index]:
            raise ValueError(
                f"Argument `index` must be that of an orbit of the system, but point {index} of this branch is virtual."
            )
        system, t0 = self.system_at(index), self.ts[index]
        guess: dict[str, Any] = dict(segments=self.segments[index])
        if options.get("method") == "shooting":
            guess = dict(period=self.periods[index]) if system.period is None else {}
        y0 = jax.tree.map(lambda x: jnp.asarray(x[index]), self.ys)
        return find_orbit(system, y0, t0=t0, order=int(self.orders[index]), **guess, **options)

    def _further(self) -> dict[str, np.ndarray]:
        columns = dict(period=self.periods, order=self.orders, t=self.ts)
        columns |= named_apart(components(self.ys, 1), self.parameter)
        for name in ("low", "high", "mean"):
            columns |= {f"{name}.{part}": x for part, x in components(getattr(self, name), 1).items()}
        columns |= dict(multiplier=self.multipliers, admissible=self.admissible)
        columns |= dict(itinerary=np.array(self.itineraries, dtype=object))
        return columns | {f"record.{name}": values for name, values in self.records.items()}

    def _headline(self) -> str:
        count = sum(bool(branch.admissible.any()) for branch in self.branches)
        virtual = f", {len(self.branches) - count} virtual" if count < len(self.branches) else ""
        owner = type(self.system).__name__
        return f"{count} {'branch' if count == 1 else 'branches'} of periodic orbits of {owner}{virtual}"

    def _period(self) -> str:
        return f"period {int(self.orders[0])}, " if self.system.period is not None else ""

    def _words(self) -> list[str]:
        return [word if real else "virtual" for word, real in zip(super()._words(), self.admissible)]


OrbitBranch.saved = table(OrbitBranch, OrbitBifurcation, OrbitHalfBranch, EigenvalueCrossing, Segment)


class Point(NamedTuple):
    """A point of a piece, of how many periods of the forcing its orbit is, the user's measures of it, and whether the
    system has such an orbit."""

    spot: OrbitPoint
    order: int
    record: dict[str, np.ndarray]
    admissible: bool

    @property
    def parameter(self) -> float:
        return self.spot.parameter


def _reversed(segment: BranchSegment) -> BranchSegment:
    """With the first of the two for the index of a corner that is there twice."""
    found = segment.reversed()
    values, last = [point.parameter for point in found.points], len(found.points) - 1

    def index(i: int) -> int:
        twice = 0 < i <= last and math.isclose(values[i], values[i - 1], rel_tol=1e-10)
        return i - 1 if twice else i

    return dataclasses.replace(found, special=tuple((index(i), b) for i, b in found.special))


def orbit_branch(curve: OrbitCurve, parameter: str, back: BranchSegment, ahead: BranchSegment) -> OrbitBranch:
    """Two pieces that set out from one point as one branch: upwards, if there is a choice; a virtual one, away from
    where it begins."""
    ends = (back.end, ahead.end)
    first, keep = _reversed(back), len(back.points)
    common = bool(first.special and ahead.special) and first.special[-1][1] is ahead.special[0][1]
    if keep and ahead.points and not common:
        keep -= first.points[-1].spot.look.u is ahead.points[0].spot.look.u
    piece = first.join(ahead, keep, first.special[-1][1] if common else None)
    if piece.points[0].admissible and descends([point.parameter for point in piece.points]):
        piece, ends = _reversed(piece), ends[::-1]
    spots = [point.spot for point in piece.points]

    def column(rows: list[np.ndarray]) -> Any:
        return states_of(curve.like, np.stack(rows))

    bases = [midpoint(curve, spot, spot.itinerary.rows) for spot in spots]
    texts: dict[int, str] = {}
    return OrbitBranch(
        system=curve.model.system,
        parameter=parameter,
        values=np.array([spot.parameter for spot in spots]),
        periods=np.array([float(spot.look.period) for spot in spots]),
        orders=np.array([point.order for point in piece.points]),
        ts=np.array([t for t, _, _ in bases]),
        ys=column([x for _, x, _ in bases]),
        low=column([spot.look.low for spot in spots]),
        high=column([spot.look.high for spot in spots]),
        mean=column([spot.look.mean for spot in spots]),
        multipliers=np.stack([np.asarray(spot.multipliers, complex) for spot in spots]),
        stable=np.array([spot.stable for spot in spots]),
        admissible=np.array([point.admissible for point in piece.points]),
        segments=tuple(segments_of(curve, spot, t) for spot, (t, _, _) in zip(spots, bases)),
        itineraries=tuple(texts.setdefault(id(s.itinerary), itinerary_text(curve, s.itinerary)) for s in spots),
        records={name: np.stack([point.record[name] for point in piece.points]) for name in piece.points[0].record},
        special=tuple(b for _, b in piece.special),
        indices=tuple(i for i, _ in piece.special),
        ends=ends,
    )


def segments_of(curve: OrbitCurve, spot: OrbitPoint, t: float) -> tuple[Segment, ...]:
    """The segments of an orbit from a time within one of them on; that one comes first and last."""
    look, itinerary, model = spot.look, spot.itinerary, curve.model
    modes = [tuple(itinerary.mode[i].tolist()) for i in itinerary.rows]
    lengths = [float(look.end[i] - look.begin[i]) for i in itinerary.rows]
    if itinerary.ends[0] == TIME:
        return (Segment(modes[0], lengths[0]),)
    middles = (look.begin + look.end)[: len(modes)] / 2
    first = int(np.argmin(np.abs(middles - t)))
    out, duration = [], float(look.end[first] - t)
    for i in [*range(first, len(modes)), *range(first)]:
        if i != first:
            duration += lengths[i]
        if itinerary.ends[i] != GRAZING:  # a cut that changes nothing
            switch = model.switches[model.slots[int(itinerary.slot[i])].switch].name
            out.append(Segment(modes[i], duration, switch, bool(itinerary.ends[i] == REPELLING_EXIT)))
            duration = 0.0
    return (*out, Segment(modes[first], duration + float(t - look.begin[first])))
