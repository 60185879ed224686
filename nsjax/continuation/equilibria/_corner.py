"""Points at which branches meet: corners, where they cross surfaces, and simple branch points."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ...setvalued._crossing import EigenvalueCrossing
from ...setvalued._eigenvalue_crossings import eigenvalue_crossings
from .._tracer import Zero
from ._bifurcation import Bifurcation, classify, HalfBranch, kind_by_count, odd_one, unstable_number
from ._corrector import branching, kept, linearised, motion, near, row_sizes, Step, step_along
from ._equations import EquilibriumCurve, first_lyapunov_coefficient, Record


ACTIVE = 1e-8  # distance at which a point lies on a surface: it is located to some 1e-12
NEAR = 3e-8  # distance within which two points are one
SINGULAR = 1e-8  # of the equations in units of what they are nearby
PROBE = 1e-4  # length of the step by which a half-branch is tried: nothing is read off it but signs
CONTINUUM = 1e-12  # a smaller change of the parameter in such a step counts as zero
MODES = 6561  # the largest number of combinations of sides that are tried


class EquilibriumPoint(NamedTuple):
    """A point of a branch: the unknowns, the tangent, the mode, what is kept of it, and the step that led to it."""

    u: Any
    tangent: Any
    mode: np.ndarray
    record: Record
    step: Step | None = None

    @property
    def parameter(self) -> float:
        return float(self.record.parameter)

    @property
    def turned(self) -> "EquilibriumPoint":
        return self._replace(tangent=-self.tangent)


@dataclasses.dataclass(eq=False)
class Departure:
    """A half-branch, with what it takes to follow it."""

    u: Any
    tangent: Any
    mode: np.ndarray
    step: Step
    regular: bool
    side: int
    unstable: int
    index: int
    partner: "Departure | None" = None

    @property
    def leads_on(self) -> bool:
        """Not along one value of the parameter."""
        return self.side != 0


@dataclasses.dataclass
class Node:
    """A point at which half-branches meet, those that go on into one another being partners."""

    u: Any
    halves: list[Departure]
    bifurcation: Bifurcation

    def is_at(self, zero: Zero[EquilibriumPoint], curve: EquilibriumCurve) -> bool:
        here, there = curve.parts(self.u), curve.parts(zero.point.u)
        x = np.abs(here[0] - there[0]) / curve.units[: len(here[0])]
        return bool((np.max(x) < NEAR) & (np.abs(here[2] - there[2]) / curve.units[-1] < NEAR))


def active(curve: EquilibriumCurve, u: Any, mode: np.ndarray) -> np.ndarray:
    """Which guards that matter in this mode vanish."""
    return (np.abs(np.asarray(near(curve, u))) <= ACTIVE) & (curve.armed(mode) != 0)


def kernel(curve: EquilibriumCurve, u: Any, mode: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """The null space of DF, the left singular vector that belongs to it if it has two dimensions, and whether F = 0."""
    f, df = (np.asarray(x) for x in linearised(curve, u, mode))
    rows = np.asarray(row_sizes(curve, u, mode))
    left, sizes, right = np.linalg.svd(df / rows[:, None])
    rank = int(np.sum(sizes > SINGULAR))
    return right[rank:], left[:, -1] / rows, bool(np.all(np.abs(f) <= 1e-7 * rows))


def directions(curve: EquilibriumCurve, u: Any, mode: np.ndarray) -> tuple[list[np.ndarray], bool]:
    """The tangents of the branches through a point in one mode, and whether it is a regular point of its branch."""
    null, left, solves = kernel(curve, u, mode)
    if not solves:
        return [], True
    if len(null) == 1:
        return [null[0], -null[0]], True
    if len(null) != 2:
        return [], False
    form = np.asarray(branching(curve, u, np.asarray(null), np.asarray(left), mode))
    values, axes = np.linalg.eigh((form + form.T) / 2)
    if not values[0] * values[1] < 0 or -values[0] * values[1] < 1e-12 * np.abs(values).max() ** 2:
        return [], False
    ratio = np.sqrt(-values[0] / values[1])
    found = [axes[:, 0] + ratio * axes[:, 1], axes[:, 0] - ratio * axes[:, 1]]
    tangents = [v @ null / np.linalg.norm(v) for v in found]
    return [sign * v for v in tangents for sign in (1, -1)], False


def _half(
    curve: EquilibriumCurve, u: Any, mode: np.ndarray, tangent: Any, regular: bool, length: float = PROBE
) -> Departure | None:
    """The half-branch in a direction, if there is one: if its first step stays on the right sides."""
    signs = curve.armed(mode)
    here = np.asarray(near(curve, u))
    matters = np.abs(signs) == 1
    if np.any(matters & (signs * here < -ACTIVE)):
        return None
    mode_array, direction = mode, np.asarray(tangent)
    step = step_along(curve, u, direction, length, mode_array)
    if not step.good:
        return None
    if abs(float(step.u[-1] - u[-1])) <= CONTINUUM and length < 1e-2:
        longer = _half(curve, u, mode, tangent, regular, 10 * length)
        if longer is not None and longer.side:
            return longer
    there = np.asarray(near(curve, step.u))
    # In a surface along which the field has a kink both sides have the branch, and the first is taken.
    if np.any(matters & (np.abs(here) <= ACTIVE) & (signs * there < -1e-11)):
        return None
    move = float(step.u[-1] - u[-1])
    slopes = np.asarray(linearised(curve, step.u, mode_array)[1])[:, :-1]
    # Not the tangent itself: a field may have kinks that no switch tells of on this very surface.
    secant = (step.u - u) / np.linalg.norm(step.u - u)
    return Departure(
        u=u,
        tangent=secant,
        mode=mode,
        step=step,
        regular=regular,
        side=0 if abs(move) <= CONTINUUM else int(np.sign(move)),
        unstable=int(unstable_number(step.record.eigenvalues)),
        index=int(np.linalg.slogdet(slopes)[0]),
    )


def node_at(curve: EquilibriumCurve, name: str, u: Any, mode: np.ndarray, arriving: Any = None) -> Node:
    """The half-branches that meet at a point on all combinations of sides of the surfaces on which it lies: each is a
    piecewise-linear problem DF d = 0 of its own, or the algebraic branching equation where that leaves two dimensions.

    `arriving` is the tangent with which the point was reached: one half-branch for certain.
    """
    on = active(curve, u, mode)
    modes, surfaces, continuous = curve.modes_at(u, mode, on)
    if len(modes) > MODES:
        raise ValueError(
            f"At {name} = {float(curve.parts(u)[2]):.12g} {len(surfaces)} surfaces meet, whose {len(modes)} "
            f"combinations of sides are more than the {MODES} that are tried."
        )
    halves: list[Departure] = []
    degenerate = False
    for other in modes:
        there = curve.entered(u, other)
        tangents, regular = directions(curve, there, other)
        degenerate |= not regular and not tangents
        for tangent in tangents:
            half = _half(curve, there, other, tangent, regular)
            if half is not None and not any(_same(curve, half, known) for known in halves):
                halves.append(half)
    if arriving is not None and matching(halves, mode, -arriving) is None:
        half = _half(curve, u, mode, -np.asarray(arriving), not degenerate)
        halves += [half] if half is not None and not any(_same(curve, half, known) for known in halves) else []
    if degenerate and arriving is not None and not surfaces:
        half = _half(curve, u, mode, np.asarray(arriving), False)
        halves += [half] if half is not None else []
    left = _left(curve, halves)
    first = _partners(halves)
    met = tuple(k for k in surfaces if k in left) if halves else tuple(surfaces)
    smooth = () if all(half.regular for half in halves) else ("branch point",)
    bifurcation = _described(curve, name, u, halves, first, surfaces=met, continuous=continuous, smooth=smooth)
    if degenerate and not met:
        bifurcation = dataclasses.replace(bifurcation, kind="degenerate branch point", evidence="crossing")
    return Node(u, halves, bifurcation)


def _left(curve: EquilibriumCurve, halves: list[Departure]) -> set[str]:
    """The switches whose surfaces (or bounds) some half-branch leaves, instead of running along it."""
    names = [k.name for k in curve.model.switches]
    left = set()
    for half in halves:
        away = np.abs(np.asarray(near(curve, half.step.u))) > 1e-11
        left |= {names[k] for (k, _, _), on, far in zip(curve.slots(), curve.armed(half.mode), away) if on and far}
    return left


def _same(curve: EquilibriumCurve, a: Departure, b: Departure) -> bool:
    n = len(curve.parts(a.u)[0])
    where = np.r_[0:n, len(a.u) - 1]
    return bool(np.max(np.abs(np.asarray(a.step.u - b.step.u))[where]) < 1e-3 * PROBE)


def matching(halves: list[Departure], mode: np.ndarray, tangent: Any) -> Departure | None:
    """That which points this way in this mode."""
    same = [half for half in halves if np.array_equal(half.mode[0], mode[0])]
    best = max(same, key=lambda half: float(half.tangent @ tangent), default=None)
    return best if best is not None and float(best.tangent @ tangent) > 0.99 else None


def _partners(halves: list[Departure]) -> tuple[Departure, Departure] | None:
    """Who goes on into whom; the first pair is the one whose eigenvalues tell most. What is on both sides of the point
    comes first, and changes its stability, as far as there is a choice; then the straightest."""

    def rank(pair: tuple[Departure, Departure]) -> tuple:
        a, b = pair
        through = a.side * b.side == -1
        middle = any(half is odd for half in pair for odd in odds)
        changes = a.index != b.index
        return (not middle, not (through and changes), not through, round(float(a.tangent @ b.tangent), 9))

    sides = [[half for half in halves if half.side == side] for side in (-1, 1)]
    odds = [odd_one(side) for side in sides if len(side) == 3 and len(halves) == 4]  # type: ignore[arg-type]
    odds = [odd for odd in odds if odd is not None]
    pairs = [(a, b) for i, a in enumerate(halves) for b in halves[i + 1 :] if a.side and b.side]
    # The middle branch of a pitchfork goes on into the one alone on its side.
    pairs = [p for p in pairs if not odds or (any(h is odds[0] for h in p) == (p[0].side != p[1].side))]
    first = None
    for a, b in sorted(pairs, key=rank):
        if a.partner is None and b.partner is None:
            a.partner, b.partner = b, a
            first = first or (a, b)
    return first


def _described(
    curve: EquilibriumCurve,
    name: str,
    u: Any,
    halves: list[Departure],
    first: tuple[Departure, Departure] | None,
    *,
    surfaces: tuple[str, ...] = (),
    continuous: bool = True,
    smooth: tuple[str, ...] = (),
) -> Bifurcation:
    """`smooth`: what a smooth point is by its singular equations; where eigenvalues jump, their crossings tell."""
    public = [_public(curve, half) for half in halves]
    by_count, criticality = kind_by_count(public)
    crossings: list[EigenvalueCrossing] = []
    places: list[dict[str, float]] = []
    by_crossing: tuple[str, ...] | None = None if surfaces else smooth
    if surfaces and continuous and len(halves) > 1:
        by_crossing, crossings, places = _crossed(curve, *_ordered(first or (halves[0], halves[1])))
    kind, evidence = classify(by_count, by_crossing)
    omegas = [c.eigenvalue.imag for c in crossings if c.kind == "pair" and c.direction]
    return Bifurcation(
        kind=kind,
        discontinuous=bool(surfaces),
        criticality=criticality,
        evidence=evidence,
        by_count=by_count,
        by_crossing=by_crossing,
        parameter=name,
        value=float(curve.parts(u)[2]),
        y=curve.state_from(curve.parts(u)[0]),
        count=(sum(half.side < 0 for half in halves), sum(half.side > 0 for half in halves)),
        surfaces=surfaces,
        crossings=crossings,
        places=places,
        halves=public,
        period=2 * np.pi / omegas[0] if omegas else None,
    )


def fold_at(
    curve: EquilibriumCurve, name: str, u: Any, mode: np.ndarray, tangent: Any, length: float = 10 * PROBE
) -> Bifurcation:
    """A point at which the branch is vertical: whether it turns back is seen a step further on either side."""
    both = [_half(curve, u, mode, way * tangent, True, min(10 * PROBE, length)) for way in (-1, 1)]
    found = _described(curve, name, u, [half for half in both if half is not None], None, smooth=("saddle-node",))
    if found.kind != "none":
        return found
    return dataclasses.replace(found, kind="hysteresis point", by_crossing=("saddle-node", "saddle-node"))


def hopf_at(
    curve: EquilibriumCurve, name: str, u: Any, mode: np.ndarray, tangent: Any, length: float = PROBE
) -> Bifurcation | None:
    """A point at which two eigenvalues cancel, or several pairs do; None for a neutral saddle, whose eigenvalues are
    real, and where none of them changes sides, as in a conservative system."""
    record = kept(curve, u, mode)
    roots = np.asarray(record.eigenvalues)
    roots = roots[np.isfinite(roots)]
    sums = np.abs(roots[:, None] + roots) + np.diag(np.full(len(roots), np.inf))
    i, j = np.unravel_index(np.argmin(sums), sums.shape)
    omega = abs(roots[i].imag)
    if roots[i].imag * roots[j].imag >= 0:
        return None
    both = [_half(curve, u, mode, way * tangent, True, min(PROBE, length)) for way in (-1, 1)]
    halves = [half for half in both if half is not None]
    pairs = abs(halves[0].unstable - halves[1].unstable) // 2 if len(halves) == 2 else 1
    # Of pairs that cross next to one another one may be beside the axis here.
    if not pairs or (pairs == 1 and abs(roots[i].real) > 1e-6 * omega):
        return None
    found = _described(curve, name, u, halves, None)
    # On a surface that holds the state the plane of the pair is not that of the coordinates.
    held = int(record.held) > 0
    coefficient = 0.0 if held else float(first_lyapunov_coefficient(curve, u, mode))
    criticality = None if abs(coefficient) < 1e-9 else "supercritical" if coefficient < 0 else "subcritical"
    criticality = criticality if pairs == 1 else None
    by_crossing = ("Hopf",) * pairs
    kind, evidence = classify(found.by_count, by_crossing)
    known = dict(kind=kind, evidence=evidence, by_crossing=by_crossing, criticality=criticality)
    return dataclasses.replace(found, **known, period=float(2 * np.pi / omega))


def start_at(curve: EquilibriumCurve, name: str, u: Any, mode: np.ndarray, tangent: Any) -> Bifurcation | None:
    """What a start is, if it is a fold or a Hopf point: where a branch sets out nothing changes its sign."""
    if abs(float(tangent[-1])) < 1e-9:
        return fold_at(curve, name, u, mode, tangent)
    roots = kept(curve, u, mode).eigenvalues
    pairs = np.isfinite(roots.real) & (np.abs(roots.imag) > 0)
    if bool(np.any(pairs & (np.abs(roots.real) <= 1e-9 * np.abs(roots)))):
        return hopf_at(curve, name, u, mode, tangent)
    return None


def _public(curve: EquilibriumCurve, half: Departure) -> HalfBranch:
    move = np.asarray(half.tangent * curve.units)
    n = len(curve.parts(half.u)[0])
    y = curve.state_from(move[:n])
    record = half.step.record
    return HalfBranch(
        side=half.side,
        mode=half.mode[0],
        tangent=(y, float(move[-1])),
        eigenvalues=np.asarray(record.eigenvalues),
        unstable=half.unstable,
        stable=bool(record.stable),
        index=half.index,
    )


def _ordered(pair: tuple[Departure, Departure]) -> tuple[Departure, Departure]:
    """From below to above; on one side of the point from that side of the surfaces where h < 0."""
    a, b = sorted(pair, key=lambda half: (half.side, tuple(half.mode[0])))
    return a, b


def _crossed(
    curve: EquilibriumCurve, a: Departure, b: Departure
) -> tuple[tuple[str, ...], list[EigenvalueCrossing], list[dict[str, float]]]:
    """What the eigenvalues do on the way from one half-branch to the other, at the point itself."""
    first, second = (motion(curve, half.u, half.mode) for half in (a, b))
    found = eigenvalue_crossings(first, second)
    ends = [linearised(curve, half.u, half.mode)[1] for half in (a, b)]
    kinds, places = [], []
    names = [k.name for k in curve.model.switches]
    for crossing in found:
        q = crossing.q
        differ = [k for k in range(len(names)) if a.mode[0, k] != b.mode[0, k]]
        places.append({names[k]: q if a.mode[0, k] < 0 else 1 - q for k in differ})
        if crossing.until != q:
            continue
        if crossing.kind == "pair":
            kinds += ["Hopf"] * bool(crossing.direction)
            continue
        # Where ∂f/∂μ has no part that the singular J(q) cannot reach, branches meet (section 5.4).
        whole = (1 - q) * ends[0] + q * ends[1]
        scale = np.abs(ends).max(axis=(0, 2))[:, None]
        scale = np.where(scale > 0, scale, 1)
        left = np.linalg.svd(whole[:, :-1] / scale)[0][:, -1]
        reached = abs(left @ (whole / scale)[:, -1]) <= 1e-8
        kinds += ["branch point" if reached else "saddle-node"] * bool(crossing.direction)
    return tuple(kinds), found, places
