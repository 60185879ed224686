"""Branches of periodic orbits that meet one another, and the virtual ones beyond their corners."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ...orbits.segments._equations import OrbitCurve
from .._branch import BranchSegment
from .._explorer import AbstractExplorer, Place, Tree
from .._tracer import Trace, Zero
from ._bifurcation import OrbitBifurcation
from ._branch import Point
from ._branch_switching import admissible, Departure, Node, tracer_for
from ._collapse import hopf_end, limits
from ._record import Recorder
from ._test_functions import CORNERS, Test
from ._tracer import alike, OrbitPoint, OrbitTracer, SAME
from .corners._corner import held_beyond, node_at
from .corners._grazing import exactly


NEARBY = 10  # points to a corner from where a half-branch was entered


class Exit(NamedTuple):
    """Where an itinerary ends at a `corner`, and virtual orbits go on: at `spot`, the same in that itinerary."""

    name: str
    curve: OrbitCurve
    corner: OrbitPoint
    spot: OrbitPoint


@dataclasses.dataclass
class OrbitExplorer(AbstractExplorer):
    """How branches of orbits are explored. When all else is done the virtual ones wait at their exits."""

    tracer: OrbitTracer
    max_order: int
    recorder: Recorder
    virtual: bool

    borders = (Test("low"), Test("high"))

    def segment_point(self, tree: Tree, spot: OrbitPoint) -> Point:
        curve = tree.tracer.curve
        return self.point(spot, curve, not tree.alone or admissible(curve, spot))

    def point(self, spot: OrbitPoint, curve: OrbitCurve, admissible: bool = True) -> Point:
        return Point(spot, int(curve.order), self.recorder(curve, spot), admissible)

    def pass_by(self, tree: Tree, zero: Zero, point: Any) -> tuple[Tree, Any]:
        tracer, trace, side = tree.tracer, tree.trace, 0
        if zero.test.kind == "flip":
            node = next((n for n in tree.nodes if n.is_at(zero, tracer.curve)), None)
            if node is None:
                node = node_at(tracer, self.name, zero, 2)
                if node is not None and 2 * int(tracer.curve.order) <= self.max_order:
                    tree = dataclasses.replace(tree, nodes=(*tree.nodes, node))
            return tree if node is None else tree.with_special(node.bifurcation), point
        if zero.test.kind == "fold":
            hopf = hopf_end(self.name, tracer.curve, trace)
            if hopf is not None:
                last, made = hopf
                tree = tree.with_segment(tree.segment.ending(self.point(last, tracer.curve)).noting(made))
                return self.end(tree, self.label(made)), last
            side = 1 if trace.points[-2].parameter > zero.point.parameter else -1
        made = OrbitBifurcation.smooth(zero.test.kind, self.name, zero.point, tracer.curve, [], side)
        return tree.with_special(made), point

    def reason(self, tree: Tree) -> str:
        last, curve = tree.trace.points[-1], tree.tracer.curve
        held = tree.trace.why == self.tracer.lost and held_beyond(curve, last, -int(np.sign(last.look.tangent[-1])))
        beside = ", beside a continuum of orbits that friction holds" if held else ""
        return f"{tree.trace.why}, at {last.parameter:.10g}{beside}"

    def exact_zero(self, tree: Tree, zero: Zero) -> Zero:
        return limits(tree.tracer, tree.trace, exactly(tree.tracer, zero) or zero)

    def node_at(self, tree: Tree, zero: Zero) -> Node | None:
        return node_at(tree.tracer, self.name, zero, max(1, self.max_order // int(tree.tracer.curve.order)))

    def no_node(self, tree: Tree, zero: Zero) -> Tree:
        curve, why = tree.tracer.curve, f"{zero.test.kind} at {self.name} = {zero.point.parameter:.10g}"
        tree = tree.with_segment(tree.segment.ending(self.point(zero.point, curve)))
        return self.end(self.leave(tree, Exit(why, curve, zero.point, outwards(tree.trace))), why)

    def arrive(self, tree: Tree, zero: Zero, node: Node, number: int | None) -> Tree:
        curve, segment, made = tree.tracer.curve, tree.segment, node.bifurcation
        last = dataclasses.replace(zero.point, stable=segment.points[-2].spot.stable)
        if made.discontinuous:
            tree = self.leave(tree, Exit(self.label(made), curve, zero.point, outwards(tree.trace)))
            if number is not None:
                last = dataclasses.replace(last, multipliers=node.halves[number].multipliers)
        return tree.with_segment(segment.ending(self.point(last, curve)).noting(made))

    def depart(self, tree: Tree, place: Place, begin: Any = None) -> Tree:
        """With the multipliers that the half-branch has at the point."""
        node, half = tree.nodes[place[0]], tree.half(place)
        spot, made = node.spot, node.bifurcation
        if made.discontinuous:
            spot = dataclasses.replace(spot, multipliers=half.multipliers, stable=half.spot.stable)
        segment = tree.segment.then(self.point(spot, half.curve))
        if len(segment.points) == 1:
            segment = segment.noting(made)
        segment = segment.then(self.point(half.spot, half.curve))
        tracer, trace = tracer_for(self.tracer, half.curve), Trace((half.spot,), begin=begin)
        if made.discontinuous and self.virtual:
            behind = self.behind(node, half)
            tree = tree if behind is None else self.leave(tree, Exit(self.label(made), half.curve, node.spot, behind))
        return tree.with_segment(segment, tracer=tracer, trace=trace, used=(*tree.used, place))

    def leave(self, tree: Tree, exit: Exit) -> Tree:
        """A itinerary, at a corner: if virtual orbits are asked for."""
        return dataclasses.replace(tree, waiting=(*tree.waiting, exit)) if self.virtual else tree

    def behind(self, node: Node, half: Departure) -> OrbitPoint | None:
        """A corner in the itinerary of a half-branch that leaves it, looking the other way."""
        tracer, trace = tracer_for(self.tracer, half.curve), Trace((half.spot.turned,))
        while not trace.over and len(trace.points) < NEARBY:
            trace = tracer.further(trace)
        zero = trace.end if trace.over else None
        if zero is None or zero.test.kind not in CORNERS:
            return None
        found = exactly(tracer, zero) or zero
        return outwards(trace) if node.is_at(found, half.curve) else None

    def rest(self, tree: Tree) -> Tree:
        """Beyond a corner, in the itinerary that ends there."""
        if not tree.waiting:
            return dataclasses.replace(tree, trace=None)
        exit, *others = tree.waiting
        tracer, trace = dataclasses.replace(self.tracer, curve=exit.curve, virtual=True), Trace((exit.spot,))
        back, ahead = BranchSegment(end=exit.name), BranchSegment((self.point(exit.corner, exit.curve, False),))
        return tree.with_branch(back, ahead, tracer=tracer, trace=trace, alone=True, waiting=tuple(others))

    def arrival(self, tree: Tree, node: Node) -> int | None:
        """That which has the same orbit at the same parameter."""
        trace, tracer, curve = tree.trace, tree.tracer, tree.tracer.curve
        own = [(i, half) for i, half in enumerate(node.halves) if int(half.curve.order) == int(curve.order)]
        for number, half in own:
            target = half.spot.parameter
            for a, b in zip(trace.points[-2::-1], trace.points[:0:-1]):
                if not min(a.parameter, b.parameter) <= target <= max(a.parameter, b.parameter):
                    continue
                here = tracer.between(a, b, target) if len(a.look.u) == len(b.look.u) else None
                if here is not None and alike(here, half.spot, curve, SAME):
                    return number
                break
            # Beside a branch point the way from the other side is safer.
            last, end = trace.points[-2:]
            step = tracer.at(half.spot, 1.5 * float(np.linalg.norm(last.look.u - end.look.u)))
            here = None if step is None else tracer.between(half.spot, step, last.parameter)
            if here is not None and alike(here, last, curve, SAME):
                return number
        # Through a corner there is one curve in each itinerary.
        key = trace.points[-1].itinerary.key()
        same = [i for i, half in own if half.spot.itinerary.key() == key]
        return same[0] if len(same) == 1 and node.bifurcation.discontinuous else None


def outwards(trace: Trace) -> OrbitPoint:
    """The last point of a trace, with the way that the trace came for its tangent: at a corner that touches at several
    places at once the equations are singular, a segment of no length at each going its own way."""
    before, at = trace.points[-2:]
    chord = at.look.u - before.look.u
    if not np.any(chord):  # where the orbit shrinks to a point
        return at
    return dataclasses.replace(at, look=at.look._replace(tangent=chord / np.linalg.norm(chord)))
