"""Branches of equilibria that meet one another, from each of several starts."""

import dataclasses
from typing import Any

import numpy as np

from .._explorer import AbstractExplorer, Place, Tree
from .._tracer import Trace, Zero
from ._corner import active, directions, EquilibriumPoint, matching, Node, node_at, start_at
from ._corrector import kept
from ._test_functions import HIGH, LOW, MARK
from ._tracer import EquilibriumTracer


ALONE = (
    "Argument `start` must be an isolated equilibrium, or a simple branch point, but there are others next to it at "
    "the same value of the parameter (as sticking friction makes them)."
)


@dataclasses.dataclass
class EquilibriumExplorer(AbstractExplorer):
    """How branches of equilibria are explored. The starts wait, except those that branches have passed."""

    tracer: EquilibriumTracer

    borders = (LOW, HIGH)

    def segment_point(self, tree: Tree, point: EquilibriumPoint) -> EquilibriumPoint:
        return point._replace(step=None)

    def pass_by(self, tree: Tree, zero: Zero, point: Any) -> tuple[Tree, Any]:
        return self.without_start(tree, zero.point.u) if zero.test == MARK else tree.with_special(zero.special), point

    def without_start(self, tree: Tree, u: Any) -> Tree:
        """Without the starts that are the same equilibrium."""
        x = self.tracer.curve.parts(u)[0]
        sizes = self.tracer.curve.units[: len(x)]
        others = (self.tracer.curve.parts(start[0])[0] for start in tree.waiting)
        far = [not bool(np.max(np.abs(x - other) / sizes) < 1e-6) for other in others]
        return dataclasses.replace(tree, waiting=tuple(s for s, other in zip(tree.waiting, far) if other))

    def reason(self, tree: Tree) -> str:
        value = float(self.tracer.curve.parts(tree.trace.points[-1].u)[2])
        return f"{tree.trace.why}, {self.name} = {value:.6g}"

    def node_at(self, tree: Tree, zero: Zero) -> Node:
        u, tangent, mode, *_ = zero.point
        return node_at(self.tracer.curve, self.name, u, mode, tangent)

    def arrival(self, tree: Tree, node: Node) -> int | None:
        end = tree.trace.points[-1]
        half = matching(node.halves, end.mode, -end.tangent)
        return None if half is None else node.halves.index(half)

    def arrive(self, tree: Tree, zero: Any, node: Node, number: int | None) -> Tree:
        """Unless it is a point like any other, as where the branch runs along a surface."""
        plain = node.bifurcation.kind == "none" and not node.bifurcation.discontinuous
        return tree if plain else tree.with_special(node.bifurcation)

    def depart(self, tree: Tree, place: Place, begin: Any = None) -> Tree:
        node, half, segment = tree.nodes[place[0]], tree.half(place), tree.segment
        first = not segment.points
        if first or node.bifurcation.discontinuous:
            record = kept(self.tracer.curve, half.u, half.mode)
            if not half.regular:  # an eigenvalue is zero there, whose sign would be that of rounding
                record = record._replace(eigenvalues=half.step.record.eigenvalues, stable=half.step.record.stable)
            segment = segment.then(EquilibriumPoint(half.u, half.tangent, half.mode, record))
        # Where the equations are singular, a branch is entered by its first step. (That is no point of the branch; what
        # is known of the node counts as the point before, for what a step might hide.)
        u, tangent = (half.u, half.tangent) if half.regular else (half.step.u, half.step.tangent)
        start = EquilibriumPoint(u, tangent, half.mode, segment.points[-1].record)
        trace = Trace((start,), begin=begin, before=len(segment.points) - 1)
        tree = tree.with_segment(segment, tracer=self.tracer, trace=trace, used=(*tree.used, place))
        return self.arrive(tree, None, node, None) if first else tree

    def rest(self, tree: Tree) -> Tree:
        """From the next start."""
        if not tree.waiting:
            if not tree.branches:
                raise ValueError(ALONE)
            return dataclasses.replace(tree, trace=None)
        curve, (u, mode) = self.tracer.curve, tree.waiting[0]
        tree = self.without_start(dataclasses.replace(tree, waiting=tree.waiting[1:]), u)
        tangents, regular = directions(curve, u, mode)
        # Upwards first. (At a node tangents may be missing, and are not needed.)
        tangent = np.asarray(max(tangents, key=lambda d: d[-1], default=np.zeros_like(u)))
        point = EquilibriumPoint(u, tangent, mode, kept(curve, u, mode))
        if np.any(active(curve, u, mode)) or not regular:
            if not any(node.is_at(Zero(0.0, None, point), curve) for node in tree.nodes):
                tree = dataclasses.replace(tree, nodes=(*tree.nodes, node_at(curve, self.name, u, mode)))
            return self.go_on(tree)
        if len(tangents) != 2:
            raise ValueError(ALONE)
        special = start_at(curve, self.name, u, mode, tangent)
        tree = self.begin(tree, point)
        return tree if special is None else tree.with_special(special)
