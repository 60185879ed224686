"""Branches that meet one another, found by following every half-branch of every node once."""

import abc
import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar

from ._branch import BranchSegment, CLOSED
from ._tracer import Trace, Zero


Place = tuple[int, int]  # of a half-branch: the number of its node, and its own


@dataclasses.dataclass(frozen=True)
class Tree:
    """What is known so far, and what grows: the second segment of the last branch, or after that its first. It is a
    value, from which `AbstractExplorer.further` makes the next: whatever interrupts it, there is no half of a step.

    - `branches`: two segments each, which set out from one point.
    - `tracer`, `trace`: what follows the segment that grows, and its last trace; None when all is done.
    - `start`: the point on which the branch began; `origin`: or on which half-branch it did.
    - `back`: whether it is the first segment that grows.
    - `alone`: whether it is all that is followed of its branch.
    - `nodes`: the points at which half-branches meet, and which of these were `used`: set out upon, or arrived on.
    - `waiting`: from where else branches are to begin when all these are done.
    """

    branches: tuple[tuple[BranchSegment, BranchSegment], ...] = ()
    tracer: Any = None
    trace: Any = None
    start: Any = None
    origin: Place | None = None
    back: bool = False
    alone: bool = False
    nodes: tuple[Any, ...] = ()
    used: tuple[Place, ...] = ()
    waiting: tuple[Any, ...] = ()

    @property
    def segment(self) -> BranchSegment:
        """That which grows."""
        return self.branches[-1][0 if self.back else 1]

    def with_segment(self, segment: BranchSegment, **changes: Any) -> "Tree":
        """With this one in its place."""
        back, ahead = self.branches[-1]
        pair = (segment, ahead) if self.back else (back, segment)
        return dataclasses.replace(self, branches=(*self.branches[:-1], pair), **changes)

    def with_branch(self, back: BranchSegment, ahead: BranchSegment, **changes: Any) -> "Tree":
        """With another branch, which is to grow."""
        known = dict(start=None, origin=None, back=False, alone=False) | changes
        return dataclasses.replace(self, branches=(*self.branches, (back, ahead)), **known)

    def with_special(self, special: Any) -> "Tree":
        """With the last point as a special one."""
        return self.with_segment(self.segment.noting(special))

    def half(self, place: Place) -> Any:
        return self.nodes[place[0]].halves[place[1]]

    def places(self) -> Iterator[Place]:
        """Half-branches that were not yet followed, and lead into the interval."""
        every = ((i, j) for i, node in enumerate(self.nodes) for j in range(len(node.halves)))
        return (p for p in every if p not in self.used and self.half(p).leads_on)

    def partner(self, place: Place) -> Place | None:
        """On which half-branch it goes on from there; None if that is known already."""
        partner = self.half(place).partner
        return next((p for p in self.places() if self.half(p) is partner), None)


@dataclasses.dataclass
class AbstractExplorer(abc.ABC):
    """How branches are explored. `name` is that of the parameter."""

    tracer: Any
    name: str
    max_branches: int

    borders: ClassVar[tuple[Any, ...]]  # the test functions of the ends of the interval

    @abc.abstractmethod
    def segment_point(self, tree: Tree, point: Any) -> Any:
        """What a segment keeps of a point."""

    @abc.abstractmethod
    def pass_by(self, tree: Tree, zero: Zero, point: Any) -> tuple[Tree, Any]:
        """With the special point that was just passed, if it is one; and the last point, as it then is."""

    @abc.abstractmethod
    def reason(self, tree: Tree) -> str:
        """Why and where the trace ends, if not at a zero of a test function."""

    @abc.abstractmethod
    def node_at(self, tree: Tree, zero: Zero) -> Any:
        """The node at the end of the trace; None where it is not known what that is."""

    @abc.abstractmethod
    def arrival(self, tree: Tree, node: Any) -> int | None:
        """On which of its half-branches the trace came to a node."""

    @abc.abstractmethod
    def arrive(self, tree: Tree, zero: Zero, node: Any, number: int | None) -> Tree:
        """With what is known of the last point at the node, to which the trace came on the half-branch `number`."""

    @abc.abstractmethod
    def depart(self, tree: Tree, place: Place, begin: Any = None) -> Tree:
        """On a half-branch, with the node itself and what the half-branch has there."""

    @abc.abstractmethod
    def rest(self, tree: Tree) -> Tree:
        """When every half-branch is done: on with what is waiting."""

    def exact_zero(self, tree: Tree, zero: Zero) -> Zero:
        """The zero with which the trace ends, as exactly as it can be."""
        return zero

    def no_node(self, tree: Tree, zero: Zero) -> Tree:
        """Where there is no node at the end of the trace."""
        return self.end(tree, self.tracer.lost)

    def label(self, special: Any) -> str:
        return f"{special.name} at {self.name} = {special.value:.6g}"

    def further(self, tree: Tree) -> tuple[Tree, Any]:
        """The next point; or None where a branch does something else than going on."""
        if tree.trace.over:
            return self.turn(tree, tree.trace), None
        trace, point = tree.tracer.further(tree.trace), None
        tree, count = dataclasses.replace(tree, trace=trace), len(tree.trace.points)
        if len(trace.points) > count:
            point = trace.points[-1]
            tree = tree.with_segment(tree.segment.then(self.segment_point(tree, point)))
        return self.pass_by(tree, trace.at, point) if trace.passed else (tree, point)

    def turn(self, tree: Tree, trace: Trace) -> Tree:
        """What there is at the end of a trace: a way on through a node, or the end of it all."""
        zero, ahead = trace.end, None
        if zero is None:
            return self.end(tree, CLOSED if trace.closed else self.reason(tree))
        if zero.test in self.borders:
            return self.end(tree, f"{self.name} = {zero.point.parameter:.6g}")
        zero = self.exact_zero(tree, zero)
        at = next((i for i, n in enumerate(tree.nodes) if n.is_at(zero, tree.tracer.curve)), len(tree.nodes))
        if at == len(tree.nodes):
            node = self.node_at(tree, zero)
            if node is None:
                return self.no_node(tree, zero)
            tree = dataclasses.replace(tree, nodes=(*tree.nodes, node))
        node = tree.nodes[at]
        # A half-branch on which a branch arrived must not be followed a second time, from this side.
        number = self.arrival(tree, node)
        if number is not None:
            tree = dataclasses.replace(tree, used=(*tree.used, (at, number)))
            ahead = tree.partner((at, number))
        tree = self.arrive(tree, zero, node, number)
        return self.end(tree, self.label(node.bifurcation)) if ahead is None else self.depart(tree, ahead, trace.begin)

    def end(self, tree: Tree, why: str) -> Tree:
        """The segment is done: on with the next. Both ways from one point make one branch: a start has two of them, and
        a half-branch goes on in its partner."""
        tree = tree.with_segment(dataclasses.replace(tree.segment, end=why))
        if tree.back or tree.alone:
            return self.go_on(tree)
        if tree.origin is None:
            return self.go_on(tree) if why == CLOSED else self.set_out(tree, tree.start.turned, back=True)
        partner = tree.partner(tree.origin)
        if partner is None:
            return self.go_on(tree)
        return self.depart(dataclasses.replace(tree, back=True).with_segment(BranchSegment()), partner)

    def go_on(self, tree: Tree) -> Tree:
        """With a branch from the first half-branch that was not yet followed."""
        place = next(tree.places(), None)
        if place is None or len(tree.branches) >= self.max_branches:
            return self.rest(tree)
        back = BranchSegment(end=self.label(tree.nodes[place[0]].bifurcation))
        return self.depart(tree.with_branch(back, BranchSegment(), origin=place), place)

    def begin(self, tree: Tree, start: Any) -> Tree:
        """A branch from a point that is no node: one way first."""
        return self.set_out(tree.with_branch(BranchSegment(end="the start"), BranchSegment(), start=start), start)

    def set_out(self, tree: Tree, start: Any, back: bool = False) -> Tree:
        tree = dataclasses.replace(tree, tracer=self.tracer, trace=Trace((start,), begin=start), back=back)
        return tree.with_segment(BranchSegment((self.segment_point(tree, start),)))
