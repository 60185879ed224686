"""The largest value that a quantity takes along an orbit."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp

from .._numerics._autodiff import frozen
from .._numerics._minima import NODES
from .._numerics._select import select
from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..system._system import System
from .segments._arcs import Arcs, flows_of


REFINEMENTS = 2  # steps of Newton's method from where the polynomials are largest: each doubles its digits


def largest(system: System, arcs: Arcs, integrator: Integrator, fn: Callable[[Scalar, Y], Scalar]) -> Scalar:
    """The maximum of `fn(t, y)`; its derivatives of first and second order are right where the maximum is one alone."""
    flows, x = flows_of(system, arcs, integrator)
    still, points = frozen((flows, x))
    unravel = jfu.ravel_pytree(flows.y0)[1]

    def highest(a: Scalar, b: Scalar, x: Any, state: Any) -> tuple[Scalar, Scalar]:
        found = still.minima(a, b, x, state, lambda t, x: [[-fn(t, unravel(x))]], lambda most: most + jnp.inf)
        return -found.least[0], found.share[0]

    values, shares = still.rows(highest, *frozen((arcs.begin, arcs.end)), points)
    row, piece = jnp.unravel_index(jnp.argmax(values), values.shape)
    share = shares[row, piece]

    def pick(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[row], tree)

    def ends(arcs: Arcs) -> tuple[Scalar, Scalar]:
        begin, length = arcs.begin[row], (arcs.end[row] - arcs.begin[row]) / flows.pieces
        return begin + piece.astype(length.dtype) * length, length

    def at(flows: Any, x: Any, arcs: Arcs, share: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """`fn` and its first two derivatives by time, a share of the way along the piece."""
        state, (begin, length) = pick(flows.within), ends(arcs)
        t = begin + share * length
        (x_t,) = flows.piece(begin, t, pick(x)[piece], state, dfx.SaveAt(t1=True))
        model = flows.model

        def along(g: Callable[..., Scalar]) -> Callable[..., Scalar]:
            def rate(t: Scalar, y: Y) -> Scalar:
                return jax.jvp(g, (t, y), (jnp.ones_like(t), model.flow(t, y, state)))[1]

            return rate

        y = unravel(x_t)
        return fn(t, y), along(fn)(t, y), along(along(fn))(t, y)

    calm = frozen(arcs)
    _, length = ends(calm)
    for _ in range(REFINEMENTS):
        _, slope, bend = at(still, points, calm, share)
        move = select(bend < 0, -slope / select(bend < 0, bend, 1), 0) / select(length > 0, length, 1)
        # The polynomials gave its place to within a node.
        share = jnp.clip(share + jnp.clip(move, -1 / NODES, 1 / NODES), 0, 1)
    value, slope, bend = at(flows, x, arcs, frozen(share))
    inside = (share > 0) & (share < 1) & (bend < 0)
    # The place moves with the parameters, which matters from the second derivative on.
    return value - select(inside, 0.5 * slope**2 / select(inside, bend, 1), 0)
