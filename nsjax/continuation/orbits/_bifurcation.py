"""Special points of branches of periodic orbits."""

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.flatten_util as jfu
import numpy as np

from ..._numerics._text import listed, shown
from ..._types import Y
from ...maps._corner_normal_form import CornerKind
from ...orbits.segments._equations import OrbitCurve
from ...setvalued._crossing import EigenvalueCrossing
from .._special_point import AbstractHalfBranch, AbstractSpecialPoint
from ._test_functions import Test
from ._tracer import OrbitPoint


SMOOTH = {kind: kind for kind in ("fold", "flip", "Neimark-Sacker")}  # and the test function that tells it
ONES = ("fold", "symmetry breaking", "transcritical", "branch point", "3 to 1", "1 to 3")
# At a fold or a branch point a multiplier is nearer to 1 than this, at a flip to -1. (Two that coincide, as at a fold
# of autonomous orbits, are known to the root of the error of the matrix only.)
NEAR = 1e-2
ROUNDING = 1e-12  # of a multiplier, over the largest
TWINS = 1e-3  # the relative difference of multipliers of two orbits that are each other's image by a symmetry


class Origin(NamedTuple):
    """A special point as the continuation saw it: what vanishes there, where, and on which curve."""

    test: Test
    spot: OrbitPoint
    curve: OrbitCurve

    def __repr__(self) -> str:
        return f"Origin({self.test.kind})"


@shown
class OrbitHalfBranch(AbstractHalfBranch):
    """A branch on one side of a special point.

    **Attributes:**

    - `side`: -1 if it lies below the point's parameter value, +1 above it.
    - `laps`: its period over that of the orbit at the point.
    - `multipliers`: the limits of its multipliers, at the point.
    - `stable`: whether its orbits are, next to the point.
    - `itinerary`: the modes it passes through.
    """

    side: int
    laps: int
    multipliers: np.ndarray
    stable: bool
    itinerary: str

    def __str__(self) -> str:
        way = textwrap.shorten(self.itinerary, 60, placeholder=" ...") or "no events"
        multipliers = listed(self.multipliers, 4, 2)
        return f"{self.place}, period {self.laps}: {way}; multipliers {multipliers}"


@shown
class OrbitBifurcation(AbstractSpecialPoint):
    """A special point of a branch of periodic orbits.

    **Attributes:**

    - `kind`: "fold", "flip", "Neimark-Sacker", "symmetry breaking", "transcritical"; "Hopf" where the orbits shrink to
        an equilibrium (the period and the multipliers are those of its linearisation); "fold-flip" where set-valued
        multipliers cross the circle at both 1 and -1 (section 6.9); "infinitely unstable fold" where one jumps from 0
        to infinity (section 6.7); "multiple crossing", or "3 to 1" (the numbers below and above) for what has no
        name; "none" where the itinerary changes without a bifurcation; "end" where there is no orbit nearby beyond,
        "continuum" where beyond friction holds every state of a continuum; "unresolved" where a test function changes
        its sign and no multiplier is at 1 or -1, as between special points that are too close together, and at a corner
        whose normal form is in doubt if not all orbits that it foretells are there.
    - `discontinuous`: whether it is a corner: multipliers jump there.
    - `criticality`: "supercritical", "subcritical", or None if the kind knows no such thing.
    - `evidence`: what supports the kind: "count" of the orbits (Definition 5.1), "crossing" of the unit circle by
        set-valued multipliers (Conjecture 6.2; at a smooth point by multipliers), or "both".
    - `by_count`: the kind that the number of orbits on each side suggests: (periods below, periods above) in `count`.
    - `by_crossing`: the kinds that the crossings suggest; None if a multiplier jumps to infinity.
    - `transition`: for a corner at which sliding begins or ends, "sliding": a topological transition, also where it is
        no bifurcation (section 7.2).
    - `parameter`, `value`: its name, and the value at the point.
    - `period`: of the orbit there. `y`: a state on it (at its first event), at the time `t`.
    - `count`: the periods of the orbits that meet there, as multiples of that of the orbit, below and above.
    - `surfaces`: the switches whose surfaces the orbit touches.
    - `multipliers`: one-sided limits: of the branch that came, and of its continuation.
    - `monodromies`: the matrices that belong to them: the ends of the set-valued one (6.13).
    - `crossings`: of the unit circle on the way from one to the other.
    - `halves`: the half-branches that meet there.
    - `origin`: what `continue_bifurcation` sets out from; None at a Hopf bifurcation, or if the point was loaded.
    """

    plain = {
        "end": "end of the branch", "continuum": "end of the branch in a continuum of orbits",
        "unresolved": "unresolved special points within 1e-6",
    }  # fmt: skip

    kind: str
    discontinuous: bool
    criticality: str | None
    evidence: str
    by_count: str
    by_crossing: tuple[str, ...] | None
    transition: str | None
    parameter: str
    value: float
    period: float
    t: float
    y: Y
    count: tuple[tuple[int, ...], tuple[int, ...]]
    surfaces: tuple[str, ...]
    multipliers: tuple[np.ndarray, np.ndarray]
    monodromies: tuple[np.ndarray, np.ndarray]
    crossings: Sequence[EigenvalueCrossing]
    halves: Sequence[OrbitHalfBranch]
    origin: "Origin | None" = None

    def _what_happens(self) -> str:
        jump = not np.allclose(*self.multipliers, rtol=1e-5, atol=1e-6)
        plain = "the multipliers jump" if jump else "the itinerary changes"
        return "sliding-mode transition" if self.transition else plain

    def __str__(self) -> str:
        lines = [f"{self.name} at {self.parameter} = {self.value:.12g}, period {self.period:.12g}"]
        if self.surfaces:
            lines.append(f"  surfaces     {', '.join(self.surfaces)}")
        below, above = (" ".join(map(str, side)) or "none" for side in self.count)
        lines.append(f"  evidence     {self.evidence}: periods {below} | {above} ({self.by_count})")
        before, after = (listed(side, 8) for side in self.multipliers)
        lines.append(f"  multipliers  {before} | {after}" if self.discontinuous else f"  multipliers  {before}")
        lines += [f"  crossing     {crossing}" for crossing in self.crossings]
        return "\n".join(lines)

    @classmethod
    def smooth(
        cls, kind: str, name: str, spot: Any, curve: Any, halves: Sequence[OrbitHalfBranch], side: int = 0
    ) -> "OrbitBifurcation":
        """A point at which a multiplier crosses the circle without a jump; of a fold, on which side its orbits are."""
        below, above = (tuple(sorted(h.laps for h in halves if h.side == side)) for side in (-1, 1))
        if kind == "flip":
            below, above = tuple(sorted((1, *below))), tuple(sorted((1, *above)))
        if kind == "fold":
            below, above = ((), (1, 1)) if side > 0 else ((1, 1), ())
        alone = kind == "Neimark-Sacker"  # of what is born there nothing is periodic
        if alone:
            below = above = (1,)
        test = Test(SMOOTH.get(kind, "branch"))
        if kind == "symmetry breaking" and not _are_images(*_twins(halves)):
            kind = "branch point"
        by_count, by_crossing = "none" if alone else kind, (kind,)
        if not (alone or _has_multiplier(spot.multipliers, -1.0 if kind == "flip" else 1.0, curve.autonomous)):
            kind, by_crossing = "unresolved", ()
        evidence = "count" if kind == "unresolved" else "both" if halves else "crossing"
        criticality = None
        born = [h for h in halves if h.laps == 2] if kind == "flip" else _twins(halves)
        if kind in ("flip", "symmetry breaking") and born:
            criticality = "supercritical" if born[0].stable else _criticality(spot, born[0])
        return _made(
            name, spot, curve, kind, (below, above), discontinuous=False, criticality=criticality, halves=halves,
            evidence=evidence, by_count=by_count, by_crossing=by_crossing, origin=Origin(test, spot, curve),
        )  # fmt: skip

    @classmethod
    def corner(
        cls, name: str, spot: Any, curve: Any, halves: Sequence[OrbitHalfBranch], by_count: CornerKind,
        crossings: Sequence[EigenvalueCrossing] | None, *, surfaces: tuple[str, ...],
        monodromies: tuple[np.ndarray, np.ndarray], multipliers: tuple[np.ndarray, np.ndarray], transition: str | None,
    ) -> "OrbitBifurcation":  # fmt: skip
        """A corner, by the number of orbits on each side, and by the crossings of the unit circle (Conjecture 6.2)."""
        names = {"+1": "fold", "-1": "flip", "pair": "Neimark-Sacker"}
        by_crossing = None if crossings is None else tuple(names[c.kind] for c in crossings)
        kind, evidence = by_count.kind, "count"
        entered = tuple(tuple(sorted(h.laps for h in halves if h.side == side)) for side in (-1, 1))
        if not by_count.certain and entered != (tuple(sorted(by_count.below)), tuple(sorted(by_count.above))):
            kind = "unresolved"
        if by_crossing is not None:
            expected = {
                "none": [], "fold": ["fold"], "flip": ["flip"], "fold-flip": ["flip", "fold"],
                "symmetry breaking": ["fold"], "transcritical": ["fold"],
            }.get(kind)  # fmt: skip
            evidence = "both" if expected == sorted(by_crossing) else "count"
            pairs = [k for k in by_crossing if k not in ("fold", "flip")]
            if kind == "none" and pairs:
                kind, evidence = pairs[0], "crossing"
        return _made(
            name, spot, curve, kind, (by_count.below, by_count.above), criticality=by_count.criticality, halves=halves,
            evidence=evidence, by_count=by_count.kind, by_crossing=by_crossing, transition=transition,
            surfaces=surfaces, crossings=crossings or [], multipliers=multipliers, monodromies=monodromies,
        )  # fmt: skip

    @classmethod
    def repelled(
        cls, name: str, spot: Any, curve: Any, halves: Sequence[OrbitHalfBranch], surfaces: tuple[str, ...]
    ) -> "OrbitBifurcation":
        below, above = (tuple(1 for h in halves if h.side == side) for side in (-1, 1))
        kind = "infinitely unstable fold" if len(below) != len(above) else "none"
        return _made(
            name, spot, curve, kind, (below, above), evidence="both" if kind != "none" else "count", halves=halves,
            by_count="fold" if kind != "none" else "none", by_crossing=("fold",), transition="sliding",
            surfaces=surfaces, multipliers=(halves[0].multipliers, halves[1].multipliers),
            monodromies=(spot.monodromy, np.full_like(spot.monodromy, np.inf)),
        )  # fmt: skip

    @classmethod
    def hopf(cls, name: str, spot: Any, curve: Any, side: int, criticality: str) -> "OrbitBifurcation":
        """Where the orbits on one side shrink to an equilibrium."""
        known = dict(criticality=criticality, evidence="both", by_crossing=("Hopf",))
        return _made(name, spot, curve, "Hopf", _one_side(side), discontinuous=False, **known)

    @classmethod
    def end(
        cls, name: str, spot: Any, curve: Any, surfaces: tuple[str, ...], side: int, kind: str
    ) -> "OrbitBifurcation":
        """Where the orbits on one side have none nearby to go on to, or a continuum."""
        return _made(name, spot, curve, kind, _one_side(side), by_count="end", surfaces=surfaces)


def _one_side(side: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return ((1,), ()) if side < 0 else ((), (1,) * (side > 0))


def _made(
    name: str, spot: Any, curve: Any, kind: str, count: tuple[tuple[int, ...], tuple[int, ...]], **given: Any
) -> OrbitBifurcation:
    """With what is so at most of them."""
    look, twice = spot.look, dict(multipliers=(spot.multipliers,) * 2, monodromies=(spot.monodromy,) * 2)
    point = dict(
        parameter=name, value=spot.parameter, period=float(look.period), t=float(look.begin[0]),
        y=jfu.ravel_pytree(curve.like)[1](np.asarray(look.x[0])), discontinuous=True, criticality=None,
        evidence="count", by_count=kind, by_crossing=None, transition=None, surfaces=(), crossings=[], halves=[],
    )  # fmt: skip
    return OrbitBifurcation(kind=kind, count=count, **(point | twice | given))


def _has_multiplier(multipliers: np.ndarray, value: float, autonomous: bool) -> bool:
    """Whether one of them is at 1 or -1, beside the trivial one; True where one of them is not finite."""
    size = np.abs(multipliers)
    if not np.isfinite(size).all():
        return True
    wanted = 2 if autonomous and value > 0 else 1
    return int(np.sum(np.abs(multipliers - value) < NEAR + ROUNDING * size.max(initial=0))) >= wanted


def _are_images(a: OrbitHalfBranch, b: OrbitHalfBranch) -> bool:
    """Whether two orbits have the same multipliers, as the images of each other by a symmetry have."""
    first, second = (np.sort_complex(half.multipliers.astype(complex)) for half in (a, b))
    return bool(np.allclose(first, second, rtol=TWINS, atol=1e-6))


def _twins(halves: Sequence[OrbitHalfBranch]) -> Sequence[OrbitHalfBranch]:
    """The two that one branch has on the same side of a branch point, of half-branches in pairs that go on into one
    another."""
    pairs = (halves[:2], halves[2:])
    return next((pair for pair in pairs if len(pair) == 2 and pair[0].side == pair[1].side), ())


def _criticality(spot: Any, born: OrbitHalfBranch) -> str:
    unstable = int(np.sum(np.abs(born.multipliers) > 1 + 1e-9))
    at = int(np.sum(np.abs(spot.multipliers) > 1 + 1e-6))
    return "supercritical" if unstable <= at else "subcritical"
