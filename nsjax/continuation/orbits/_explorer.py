"""Branches of periodic orbits that meet one another, found by following every half-branch of every node once."""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...orbits.segments._equations import OrbitCurve
from ..equilibria._branch import CLOSED
from ._bifurcation import OrbitBifurcation
from ._branch import OrbitBranchSegment, Point
from ._branch_switching import admissible, Departure, Node, tracer_for
from ._collapse import hopf_end, limits
from ._record import Recorder
from ._test_functions import CORNERS, PASSED
from ._tracer import alike, LAST_FOUND, OrbitPoint, OrbitTracer, SAME, Trace, turned
from .corners._corner import held_beyond, node_at
from .corners._grazing import exactly


NEARBY = 10  # points to a corner from where a half-branch was entered
Place = tuple[int, int]  # of a half-branch: the number of its node, and its own


class Exit(NamedTuple):
    """Where an itinerary ends at a `corner`, and virtual orbits go on: at `spot`, the same in that itinerary."""

    name: str
    curve: OrbitCurve
    corner: OrbitPoint
    spot: OrbitPoint


@dataclasses.dataclass(frozen=True)
class Frontier:
    """What grows: the second piece of the last branch, or after that its first.

    - `trace`: the last trace of the piece, on a `curve`.
    - `origin`: the half-branch on which the branch set out; None for the start.
    - `back`: whether it is the first piece.
    - `virtual`: whether it goes on where its orbits are none.
    """

    curve: OrbitCurve
    trace: Trace
    origin: Place | None = None
    back: bool = False
    virtual: bool = False


@dataclasses.dataclass(frozen=True)
class OrbitTree:
    """What is known so far. It is a value, from which `OrbitExplorer.further` makes the next: whatever interrupts it,
    there is no half of a step.

    - `start`: the orbit on which all began.
    - `branches`: two pieces each, which set out from one point.
    - `nodes`: the points at which half-branches meet, and which of these were `used`: set out upon, or arrived on.
    - `exits`: where virtual branches are to begin.
    - `walk`: what is under way; None when all is done.
    """

    start: OrbitPoint
    branches: tuple[tuple[OrbitBranchSegment, OrbitBranchSegment], ...]
    walk: Frontier | None
    nodes: tuple[Node, ...] = ()
    used: tuple[Place, ...] = ()
    exits: tuple[Exit, ...] = ()

    @property
    def piece(self) -> OrbitBranchSegment:
        """That which grows."""
        assert self.walk is not None
        return self.branches[-1][0 if self.walk.back else 1]

    def growing(self, piece: OrbitBranchSegment) -> "OrbitTree":
        """With this one in its place."""
        assert self.walk is not None
        back, ahead = self.branches[-1]
        pair = (piece, ahead) if self.walk.back else (back, piece)
        return dataclasses.replace(self, branches=(*self.branches[:-1], pair))

    def half(self, place: Place) -> Departure:
        node, number = place
        return self.nodes[node].halves[number]

    def places(self) -> Iterator[Place]:
        """Half-branches that were not yet followed, and do not leave the interval at once."""
        every = ((i, j) for i, node in enumerate(self.nodes) for j in range(len(node.halves)))
        return (p for p in every if p not in self.used and 0 <= self.half(p).spot.look.u[-1] <= 1)

    def partner(self, place: Place) -> Place | None:
        """On which half-branch it goes on from there; None if that is known already."""
        partner = self.half(place).partner
        return next((p for p in self.places() if self.half(p) is partner), None)


@dataclasses.dataclass
class OrbitExplorer:
    """How branches are explored."""

    tracer: OrbitTracer
    name: str  # of the parameter
    max_branches: int
    max_order: int
    recorder: Recorder
    virtual: bool

    def first_tree(self, spot: OrbitPoint) -> OrbitTree:
        """Nothing but a first orbit."""
        spot = spot if spot.look.tangent[-1] >= 0 else turned(spot)
        ahead = OrbitBranchSegment((self.point(spot, self.tracer.curve),))
        walk = Frontier(self.tracer.curve, Trace((spot,), begin=spot))
        return OrbitTree(spot, ((OrbitBranchSegment(end="the start"), ahead),), walk)

    def further(self, tree: OrbitTree) -> tuple[OrbitTree, OrbitPoint | None]:
        """The next point; or None where a branch does something else than going on."""
        walk = tree.walk
        assert walk is not None
        if walk.trace.over:
            return self.turn(tree, walk), None
        tracer = dataclasses.replace(tracer_for(self.tracer, walk.curve), virtual=walk.virtual)
        trace = tracer.further(walk.trace)
        tree = dataclasses.replace(tree, walk=dataclasses.replace(walk, trace=trace))
        if len(trace.spots) == len(walk.trace.spots):
            return tree, None
        spot = trace.spots[-1]
        piece = tree.piece.then(self.point(spot, walk.curve, not walk.virtual or admissible(walk.curve, spot)))
        if trace.at is not None and trace.at.test.kind == "fold":
            hopf = hopf_end(self.name, walk.curve, trace)
            if hopf is not None:
                last, made = hopf
                piece = piece.ending(self.point(last, walk.curve)).noting(made)
                return self.end(tree.growing(piece), f"{made.name} at {self.name} = {made.value:.6g}"), last
        if trace.at is not None and trace.at.test.kind in PASSED:
            tree, made = self.passed(tree, tracer, trace)
            piece = piece if made is None else piece.noting(made)
        return tree.growing(piece), spot

    def point(self, spot: OrbitPoint, curve: OrbitCurve, admissible: bool = True) -> Point:
        return Point(spot, int(curve.order), self.recorder(curve, spot), admissible)

    def passed(self, tree: OrbitTree, tracer: OrbitTracer, trace: Trace) -> tuple[OrbitTree, OrbitBifurcation | None]:
        """A bifurcation through which the branch goes on as it is."""
        zero, curve = trace.at, tracer.curve
        assert zero is not None
        if zero.test.kind == "flip":
            node = next((n for n in tree.nodes if n.is_at(zero, curve)), None)
            if node is None:
                node = node_at(tracer, self.name, zero, 2)
                if node is not None and 2 * int(curve.order) <= self.max_order:
                    tree = dataclasses.replace(tree, nodes=(*tree.nodes, node))
            return tree, None if node is None else node.bifurcation
        side = 0
        if zero.test.kind == "fold":
            side = 1 if trace.spots[-2].parameter > zero.spot.parameter else -1
        return tree, OrbitBifurcation.smooth(zero.test.kind, self.name, zero.spot, curve, [], side)

    def turn(self, tree: OrbitTree, walk: Frontier) -> OrbitTree:
        """What there is at the end of a trace: a way on through a corner or a branch point, or the end of it all."""
        trace, zero = walk.trace, walk.trace.end
        tracer, order = tracer_for(self.tracer, walk.curve), int(walk.curve.order)
        if zero is None:
            why, last = CLOSED if trace.closed else trace.why, trace.spots[-1]
            if why.startswith(LAST_FOUND) and held_beyond(walk.curve, last, -int(np.sign(last.look.tangent[-1]))):
                why += ", beside a continuum of orbits that friction holds"
            return self.end(tree, why)
        if zero.test.kind in ("low", "high"):
            return self.end(tree, f"{self.name} = {zero.spot.parameter:.6g}")
        zero = limits(tracer, trace, exactly(tracer, zero) or zero)
        at = next((i for i, node in enumerate(tree.nodes) if node.is_at(zero, walk.curve)), len(tree.nodes))
        if at == len(tree.nodes):
            node = node_at(tracer, self.name, zero, max(1, self.max_order // order))
            if node is None:
                tree = tree.growing(tree.piece.ending(self.point(zero.spot, walk.curve)))
                why = f"{zero.test.kind} at {self.name} = {zero.spot.parameter:.10g}"
                return self.end(self.leave(tree, Exit(why, walk.curve, zero.spot, outwards(trace))), why)
            tree = dataclasses.replace(tree, nodes=(*tree.nodes, node))
        node = tree.nodes[at]
        if node.bifurcation.discontinuous:
            tree = self.leave(tree, Exit(self.label(node), walk.curve, zero.spot, outwards(trace)))
        arrived = self.arrival(tracer, node, trace)
        last = dataclasses.replace(zero.spot, stable=tree.piece.points[-2].spot.stable)
        ahead = None
        if arrived is not None:
            tree = dataclasses.replace(tree, used=(*tree.used, (at, arrived)))
            ahead = tree.partner((at, arrived))
            if node.bifurcation.discontinuous:
                last = dataclasses.replace(last, multipliers=node.halves[arrived].multipliers)
        tree = tree.growing(tree.piece.ending(self.point(last, walk.curve)).noting(node.bifurcation))
        return self.end(tree, self.label(node)) if ahead is None else self.depart(tree, ahead, trace.begin)

    def depart(self, tree: OrbitTree, place: Place, begin: OrbitPoint | None = None) -> OrbitTree:
        """On a half-branch: with the point itself, and the multipliers that the half-branch has there."""
        walk, (at, _) = tree.walk, place
        assert walk is not None
        node, half = tree.nodes[at], tree.half(place)
        spot = node.spot
        if node.bifurcation.discontinuous:
            spot = dataclasses.replace(spot, multipliers=half.multipliers, stable=half.spot.stable)
        piece = tree.piece.then(self.point(spot, half.curve))
        if len(piece.points) == 1:
            piece = piece.noting(node.bifurcation)
        piece = piece.then(self.point(half.spot, half.curve))
        walk = dataclasses.replace(walk, curve=half.curve, trace=Trace((half.spot,), begin=begin))
        if node.bifurcation.discontinuous and self.virtual:
            behind = self.behind(node, half)
            tree = tree if behind is None else self.leave(tree, Exit(self.label(node), half.curve, node.spot, behind))
        return dataclasses.replace(tree.growing(piece), walk=walk, used=(*tree.used, place))

    def end(self, tree: OrbitTree, why: str) -> OrbitTree:
        """The piece is done: on with the next."""
        walk = tree.walk
        assert walk is not None
        tree = tree.growing(dataclasses.replace(tree.piece, end=why))
        if walk.virtual:
            return self.try_exits(tree)
        if not walk.back and walk.origin is None and why != CLOSED:
            spot = turned(tree.start)
            walk = Frontier(self.tracer.curve, Trace((spot,), begin=spot), back=True)
            tree = dataclasses.replace(tree, walk=walk)
            return tree.growing(OrbitBranchSegment((self.point(spot, walk.curve),)))
        if not walk.back and walk.origin is not None:
            partner = tree.partner(walk.origin)
            if partner is not None:
                tree = dataclasses.replace(tree, walk=dataclasses.replace(walk, back=True))
                return self.depart(tree.growing(OrbitBranchSegment()), partner)
        place = next(tree.places(), None)
        if place is None or len(tree.branches) >= self.max_branches:
            return self.try_exits(tree)
        new = OrbitBranchSegment(end=self.label(tree.nodes[place[0]])), OrbitBranchSegment()
        walk = dataclasses.replace(walk, origin=place, back=False)
        return self.depart(dataclasses.replace(tree, branches=(*tree.branches, new), walk=walk), place)

    def leave(self, tree: OrbitTree, exit: Exit) -> OrbitTree:
        """A itinerary, at a corner: if virtual orbits are asked for."""
        return dataclasses.replace(tree, exits=(*tree.exits, exit)) if self.virtual else tree

    def behind(self, node: Node, half: Departure) -> OrbitPoint | None:
        """A corner in the itinerary of a half-branch that leaves it, looking the other way."""
        tracer, trace = tracer_for(self.tracer, half.curve), Trace((turned(half.spot),))
        while not trace.over and len(trace.spots) < NEARBY:
            trace = tracer.further(trace)
        zero = trace.end
        if zero is None or zero.test.kind not in CORNERS:
            return None
        found = exactly(tracer, zero) or zero
        return outwards(trace) if node.is_at(found, half.curve) else None

    def try_exits(self, tree: OrbitTree) -> OrbitTree:
        """When all else is done: beyond a corner, in the itinerary that ends there."""
        if not tree.exits:
            return dataclasses.replace(tree, walk=None)
        exit, *others = tree.exits
        new = OrbitBranchSegment(end=exit.name), OrbitBranchSegment((self.point(exit.corner, exit.curve, False),))
        walk = Frontier(exit.curve, Trace((exit.spot,)), virtual=True)
        return dataclasses.replace(tree, branches=(*tree.branches, new), exits=tuple(others), walk=walk)

    def arrival(self, tracer: OrbitTracer, node: Node, trace: Trace) -> int | None:
        """On which half-branch the branch came: that which has the same orbit at the same parameter."""
        curve, order = tracer.curve, int(tracer.curve.order)
        for number, half in enumerate(node.halves):
            if int(half.curve.order) != order:
                continue
            target = half.spot.parameter
            for a, b in zip(trace.spots[-2::-1], trace.spots[:0:-1]):
                if not min(a.parameter, b.parameter) <= target <= max(a.parameter, b.parameter):
                    continue
                here = tracer.between(a, b, target) if len(a.look.u) == len(b.look.u) else None
                if here is not None and alike(here, half.spot, curve, SAME):
                    return number
                break
            # Beside a branch point the way from the other side is safer.
            last, end = trace.spots[-2:]
            step = tracer.at(half.spot, 1.5 * float(np.linalg.norm(last.look.u - end.look.u)))
            here = None if step is None else tracer.between(half.spot, step, last.parameter)
            if here is not None and alike(here, last, curve, SAME):
                return number
        # Through a corner there is one curve in each itinerary.
        key = trace.spots[-1].itinerary.key()
        same = [
            i
            for i, half in enumerate(node.halves)
            if int(half.curve.order) == order and half.spot.itinerary.key() == key
        ]
        return same[0] if len(same) == 1 and node.bifurcation.discontinuous else None

    def label(self, node: Node) -> str:
        return f"{node.bifurcation.name} at {self.name} = {node.bifurcation.value:.6g}"


def outwards(trace: Trace) -> OrbitPoint:
    """The last point of a trace, with the way that the trace came for its tangent: at a corner that touches at several
    places at once the equations are singular, a segment of no length at each going its own way."""
    before, at = trace.spots[-2:]
    chord = at.look.u - before.look.u
    if not np.any(chord):  # where the orbit shrinks to a point
        return at
    return dataclasses.replace(at, look=at.look._replace(tangent=chord / np.linalg.norm(chord)))
