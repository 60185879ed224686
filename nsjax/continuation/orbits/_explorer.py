"""The branches of periodic orbits that hang together, found by following every half-branch of every node once."""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...orbits.segments._equations import OrbitCurve
from ..equilibria._branch import CLOSED
from ._bifurcation import OrbitBifurcation
from ._branch import OrbitStrand, Point
from ._branch_switching import admissible, Half, Node, tracer_for
from ._record import Recorder
from ._test_functions import CORNERS, PASSED
from ._tracer import alike, Arc, OrbitPoint, OrbitTracer, SAME, turned
from .corners._corner import node_at
from .corners._grazing import exactly


NEARBY = 10  # points to a corner from where a half-branch was entered
Place = tuple[int, int]  # of a half-branch: the number of its node, and its own


class Exit(NamedTuple):
    """Where a course ends at a corner, `corner`, and virtual orbits go on: at `spot`, the same in that course."""

    name: str
    curve: OrbitCurve
    corner: OrbitPoint
    spot: OrbitPoint


@dataclasses.dataclass(frozen=True)
class Frontier:
    """What grows: the second strand of the last branch, or after that its first.

    - `arc`: the last arc of the strand, on a `curve`.
    - `origin`: the half-branch on which the branch set out; None for the start.
    - `back`: whether it is the first strand.
    - `virtual`: whether it goes on where its orbits are none.
    """

    curve: OrbitCurve
    arc: Arc
    origin: Place | None = None
    back: bool = False
    virtual: bool = False


@dataclasses.dataclass(frozen=True)
class OrbitTree:
    """What is known so far. It is a value, from which `OrbitExplorer.further` makes the next: whatever interrupts it,
    there is no half of a step.

    - `start`: the orbit on which all began.
    - `branches`: two strands each, which set out from one point.
    - `nodes`: the points at which half-branches meet, and which of these were `used`: set out upon, or arrived on.
    - `exits`: where virtual branches are to begin.
    - `walk`: what is under way; None when all is done.
    """

    start: OrbitPoint
    branches: tuple[tuple[OrbitStrand, OrbitStrand], ...]
    walk: Frontier | None
    nodes: tuple[Node, ...] = ()
    used: tuple[Place, ...] = ()
    exits: tuple[Exit, ...] = ()

    @property
    def strand(self) -> OrbitStrand:
        """That which grows."""
        assert self.walk is not None
        return self.branches[-1][0 if self.walk.back else 1]

    def growing(self, strand: OrbitStrand) -> "OrbitTree":
        """With this one in its place."""
        assert self.walk is not None
        back, ahead = self.branches[-1]
        pair = (strand, ahead) if self.walk.back else (back, strand)
        return dataclasses.replace(self, branches=(*self.branches[:-1], pair))

    def half(self, place: Place) -> Half:
        node, number = place
        return self.nodes[node].halves[number]

    def places(self) -> Iterator[Place]:
        """Of half-branches that nobody has been on, and that do not leave the interval at once."""
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

    def planted(self, spot: OrbitPoint) -> OrbitTree:
        """Nothing but a first orbit."""
        spot = spot if spot.look.tangent[-1] >= 0 else turned(spot)
        ahead = OrbitStrand((self.point(spot, self.tracer.curve),))
        walk = Frontier(self.tracer.curve, Arc((spot,), begin=spot))
        return OrbitTree(spot, ((OrbitStrand(end="the start"), ahead),), walk)

    def further(self, tree: OrbitTree) -> tuple[OrbitTree, OrbitPoint | None]:
        """The next point; or None where a branch does something else than going on."""
        walk = tree.walk
        assert walk is not None
        if walk.arc.over:
            return self.turn(tree, walk), None
        tracer = dataclasses.replace(tracer_for(self.tracer, walk.curve), virtual=walk.virtual)
        arc = tracer.further(walk.arc)
        tree = dataclasses.replace(tree, walk=dataclasses.replace(walk, arc=arc))
        if len(arc.spots) == len(walk.arc.spots):
            return tree, None
        spot = arc.spots[-1]
        strand = tree.strand.then(self.point(spot, walk.curve, not walk.virtual or admissible(walk.curve, spot)))
        if arc.at is not None and arc.at.test.kind in PASSED:
            tree, made = self.passed(tree, tracer, arc)
            strand = strand if made is None else strand.noting(made)
        return tree.growing(strand), spot

    def point(self, spot: OrbitPoint, curve: OrbitCurve, admissible: bool = True) -> Point:
        return Point(spot, int(curve.order), self.recorder(curve, spot), admissible)

    def passed(self, tree: OrbitTree, tracer: OrbitTracer, arc: Arc) -> tuple[OrbitTree, OrbitBifurcation | None]:
        """A bifurcation through which the branch goes on as it is."""
        zero, curve = arc.at, tracer.curve
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
            side = 1 if arc.spots[-2].parameter > zero.spot.parameter else -1
        return tree, OrbitBifurcation.smooth(zero.test.kind, self.name, zero.spot, curve, [], side)

    def turn(self, tree: OrbitTree, walk: Frontier) -> OrbitTree:
        """What there is at the end of an arc: a way on through a corner or a branch point, or the end of the strand."""
        arc, zero = walk.arc, walk.arc.end
        tracer, order = tracer_for(self.tracer, walk.curve), int(walk.curve.order)
        if zero is None:
            return self.ended(tree, CLOSED if arc.closed else arc.why)
        if zero.test.kind in ("low", "high"):
            return self.ended(tree, f"{self.name} = {zero.spot.parameter:.6g}")
        zero = exactly(tracer, zero) or zero
        at = next((i for i, node in enumerate(tree.nodes) if node.is_at(zero, walk.curve)), len(tree.nodes))
        if at == len(tree.nodes):
            node = node_at(tracer, self.name, zero, max(1, self.max_order // order))
            if node is None:
                tree = tree.growing(tree.strand.ending(self.point(zero.spot, walk.curve)))
                why = f"{zero.test.kind} at {self.name} = {zero.spot.parameter:.10g}"
                return self.ended(self.left(tree, Exit(why, walk.curve, zero.spot, outwards(arc))), why)
            tree = dataclasses.replace(tree, nodes=(*tree.nodes, node))
        node = tree.nodes[at]
        if node.bifurcation.discontinuous:
            tree = self.left(tree, Exit(self.named(node), walk.curve, zero.spot, outwards(arc)))
        arrived = self.arrived(tracer, node, arc)
        last = dataclasses.replace(zero.spot, stable=tree.strand.points[-2].spot.stable)
        ahead = None
        if arrived is not None:
            tree = dataclasses.replace(tree, used=(*tree.used, (at, arrived)))
            ahead = tree.partner((at, arrived))
            if node.bifurcation.discontinuous:
                last = dataclasses.replace(last, multipliers=node.halves[arrived].multipliers)
        tree = tree.growing(tree.strand.ending(self.point(last, walk.curve)).noting(node.bifurcation))
        return self.ended(tree, self.named(node)) if ahead is None else self.departed(tree, ahead, arc.begin)

    def departed(self, tree: OrbitTree, place: Place, begin: OrbitPoint | None = None) -> OrbitTree:
        """On a half-branch: with the point itself, and the multipliers that the half-branch has there."""
        walk, (at, _) = tree.walk, place
        assert walk is not None
        node, half = tree.nodes[at], tree.half(place)
        spot = node.spot
        if node.bifurcation.discontinuous:
            spot = dataclasses.replace(spot, multipliers=half.multipliers, stable=half.spot.stable)
        strand = tree.strand.then(self.point(spot, half.curve))
        if len(strand.points) == 1:
            strand = strand.noting(node.bifurcation)
        strand = strand.then(self.point(half.spot, half.curve))
        walk = dataclasses.replace(walk, curve=half.curve, arc=Arc((half.spot,), begin=begin))
        if node.bifurcation.discontinuous and self.virtual:
            behind = self.behind(node, half)
            tree = tree if behind is None else self.left(tree, Exit(self.named(node), half.curve, node.spot, behind))
        return dataclasses.replace(tree.growing(strand), walk=walk, used=(*tree.used, place))

    def ended(self, tree: OrbitTree, why: str) -> OrbitTree:
        """The strand is done: on with the next."""
        walk = tree.walk
        assert walk is not None
        tree = tree.growing(dataclasses.replace(tree.strand, end=why))
        if walk.virtual:
            return self.escaped(tree)
        if not walk.back and walk.origin is None and why != CLOSED:
            spot = turned(tree.start)
            walk = Frontier(self.tracer.curve, Arc((spot,), begin=spot), back=True)
            tree = dataclasses.replace(tree, walk=walk)
            return tree.growing(OrbitStrand((self.point(spot, walk.curve),)))
        if not walk.back and walk.origin is not None:
            partner = tree.partner(walk.origin)
            if partner is not None:
                tree = dataclasses.replace(tree, walk=dataclasses.replace(walk, back=True))
                return self.departed(tree.growing(OrbitStrand()), partner)
        place = next(tree.places(), None)
        if place is None or len(tree.branches) >= self.max_branches:
            return self.escaped(tree)
        new = OrbitStrand(end=self.named(tree.nodes[place[0]])), OrbitStrand()
        walk = dataclasses.replace(walk, origin=place, back=False)
        return self.departed(dataclasses.replace(tree, branches=(*tree.branches, new), walk=walk), place)

    def left(self, tree: OrbitTree, exit: Exit) -> OrbitTree:
        """A course, at a corner: if virtual orbits are asked for."""
        return dataclasses.replace(tree, exits=(*tree.exits, exit)) if self.virtual else tree

    def behind(self, node: Node, half: Half) -> OrbitPoint | None:
        """A corner in the course of a half-branch that leaves it, looking the other way."""
        tracer, arc = tracer_for(self.tracer, half.curve), Arc((turned(half.spot),))
        while not arc.over and len(arc.spots) < NEARBY:
            arc = tracer.further(arc)
        zero = arc.end
        if zero is None or zero.test.kind not in CORNERS:
            return None
        found = exactly(tracer, zero) or zero
        return outwards(arc) if node.is_at(found, half.curve) else None

    def escaped(self, tree: OrbitTree) -> OrbitTree:
        """When all else is done: beyond a corner, in the course that ends there."""
        if not tree.exits:
            return dataclasses.replace(tree, walk=None)
        exit, *others = tree.exits
        new = OrbitStrand(end=exit.name), OrbitStrand((self.point(exit.corner, exit.curve, False),))
        walk = Frontier(exit.curve, Arc((exit.spot,)), virtual=True)
        return dataclasses.replace(tree, branches=(*tree.branches, new), exits=tuple(others), walk=walk)

    def arrived(self, tracer: OrbitTracer, node: Node, arc: Arc) -> int | None:
        """On which half-branch the branch came: that which has the same orbit at the same parameter."""
        curve, order = tracer.curve, int(tracer.curve.order)
        for number, half in enumerate(node.halves):
            if int(half.curve.order) != order:
                continue
            target = half.spot.parameter
            for a, b in zip(arc.spots[-2::-1], arc.spots[:0:-1]):
                if not min(a.parameter, b.parameter) <= target <= max(a.parameter, b.parameter):
                    continue
                here = tracer.between(a, b, target) if len(a.look.u) == len(b.look.u) else None
                if here is not None and alike(here, half.spot, curve, SAME):
                    return number
                break
            # Beside a branch point the way from the other side is safer.
            last, end = arc.spots[-2:]
            step = tracer.at(half.spot, 1.5 * float(np.linalg.norm(last.look.u - end.look.u)))
            here = None if step is None else tracer.between(half.spot, step, last.parameter)
            if here is not None and alike(here, last, curve, SAME):
                return number
        # Through a corner there is one curve in each course.
        key = arc.spots[-1].course.key()
        same = [
            i for i, half in enumerate(node.halves) if int(half.curve.order) == order and half.spot.course.key() == key
        ]
        return same[0] if len(same) == 1 and node.bifurcation.discontinuous else None

    def named(self, node: Node) -> str:
        return f"{node.bifurcation.name} at {self.name} = {node.bifurcation.value:.6g}"


def outwards(arc: Arc) -> OrbitPoint:
    """The last point of an arc, with the way that the arc came for its tangent: at a corner that touches at several
    places at once the equations are singular, a segment of no length at each going its own way."""
    before, at = arc.spots[-2:]
    chord = at.look.u - before.look.u
    if not np.any(chord):  # where the orbit shrinks to a point
        return at
    return dataclasses.replace(at, look=at.look._replace(tangent=chord / np.linalg.norm(chord)))
