"""Whether a surface attracts the solution that it holds, or repels it: alone, and while others hold it too."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._numerics._autodiff import frozen
from ..._numerics._linalg import linear_solve, parallel
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem


Pairs = dict[tuple[int, int], tuple[Bool[Array, ""], Float[Array, ""]]]
"""Of two positions in `SwitchedSystem.holdable`: whether surfaces coincide, and the sign of the ratio of their h."""


def reach(model: SwitchedSystem, matrix: Float[Array, "m m"]) -> Float[Array, " m"]:
    """How much the values of all `sgn` switches together may change dh/dt of each surface."""
    return jnp.sum(select(np.array([k not in model.contacts for k in model.holdable]), jnp.abs(matrix), 0), axis=1)


def negligible(rate: Scalar, span: Scalar) -> Bool[Array, ""]:
    """Whether a rate counts as zero beside that which switches may add: forces that cancel leave their rounding."""
    return jnp.abs(rate) <= float(jnp.finfo(rate.dtype).eps) ** 0.5 * span


def coinciding(model: SwitchedSystem, rates: Float[Array, " m"], matrix: Float[Array, "m m"]) -> Pairs:
    """Which surfaces are one: at any values of the switches their h change in proportion. `rates` and `matrix` are
    `SwitchedSystem.linear` at some of these values."""
    size = reach(model, matrix)
    out = {}
    for i, j in model.pairs:
        ratio = jnp.sign(matrix[i] @ matrix[j])
        alike = negligible(rates[i] * size[j] - ratio * rates[j] * size[i], size[i] * size[j])
        out[i, j] = alike & parallel(matrix[i], matrix[j]) & (ratio != 0), ratio
    return out


def attraction(
    model: SwitchedSystem, matrix: Float[Array, "m m"], held: Bool[Array, " m"], pairs: Pairs
) -> Float[Array, " m"]:
    """dh_k'/ds_k for each holdable switch while the others that are `held` stay on their surfaces.

    That is the Schur complement of M_ij = dh_i'/ds_j over these others. Where it is negative surface k attracts, where
    it is positive it repels (2.25): its diagonal entry M_kk says so only if nothing else is slid on.
    """
    groups, m = model.coupling.groups, len(held)
    if all(len(block) == 1 for group in groups for block in group):
        return matrix[0] if m == 1 else jnp.diagonal(matrix)
    if groups == ((tuple(range(m)),),):
        return _within_block(matrix, held, pairs)
    parts = []
    for group in groups:
        index, block = np.array(group), group[0]
        of = {(block.index(i), block.index(j)): found for (i, j), found in pairs.items() if i in block}
        inner = matrix[index[:, :, None], index[:, None, :]]
        found = jax.vmap(lambda matrix, held, of=of: _within_block(matrix, held, of), out_axes=1)(inner, held[index])
        parts.append([x[0] for x in found] if len(group) == 1 else found)
    return jnp.asarray(model.coupling.joined(parts))


def _within_block(matrix: Float[Array, "m m"], held: Bool[Array, " m"], pairs: Pairs) -> Float[Array, " m"]:
    """The same for one block of values that act on each other's surfaces."""
    m = len(held)
    whole, first = _as_one(matrix, held, pairs)
    inverse, inner = _inverse(whole, first)
    free = jnp.diag(whole) - jnp.sum((whole @ inner) * whole.T, axis=1)
    out = select(first, 1 / jnp.diag(inverse), free)
    size = jnp.sum(jnp.abs(matrix), axis=1)
    for (i, j), (same, _) in pairs.items():
        out = select(same & (np.arange(m) == j), out[i] * size[j] / size[i], out)
    return out


def _as_one(
    matrix: Float[Array, "m m"], held: Bool[Array, " m"], pairs: Pairs
) -> tuple[Float[Array, "m m"], Bool[Array, " m"]]:
    """The effects of switches that leave coinciding surfaces together, each to its side; and which are held, of those
    that coincide the first only."""
    m = len(held)
    whole, first = matrix, held
    for (i, j), (same, ratio) in pairs.items():
        swap = np.arange(m)
        swap[[i, j]] = j, i
        whole = whole + select(same & (swap != np.arange(m)), ratio, 0) * matrix[:, swap]
        first = first & ~(same & held[i] & (np.arange(m) == j))
    return whole, first


def _inverse(whole: Float[Array, "m m"], first: Bool[Array, " m"]) -> tuple[Float[Array, "m m"], Float[Array, "m m"]]:
    """The inverse over what is held, with the identity for the rest and with zero."""
    eye, both = jnp.eye(len(first), dtype=whole.dtype), first[:, None] & first[None, :]
    inverse = jax.vmap(linear_solve, in_axes=(None, 0), out_axes=1)(select(both, whole, eye), eye)
    return inverse, select(both, inverse, 0)


def escapes(model: SwitchedSystem, t: Scalar, y: Y, state: ModeState) -> Bool[Array, ""]:
    """Whether a solution that slides may leave at any time: a surface repels, and what else holds can go on doing so
    when it is let go to one of its sides. So it is beyond a two-fold, where the fields on both sides have become
    tangent to the surface (n · f⁺ = n · f⁻ = 0): M_kk changes its sign there."""
    model, t, y = frozen((model, t, y))
    which = model.holdable
    s = model.values(t, y, state)
    rates, matrix = model.linear(t, y, state, s)
    held = jnp.stack([model.held(k, state.mode[k]) for k in which])
    pairs = coinciding(model, rates, matrix)
    repels = held & (attraction(model, matrix, held, pairs) > 0)
    repels = repels & np.array([k not in model.contacts for k in which])
    if len(which) == 1:
        return repels[0]
    whole, first = _as_one(matrix, held, pairs)
    _, inner = _inverse(whole, first)
    values = jnp.stack([s[k] for k in which])
    out = jnp.zeros((), bool)
    for i in range(len(which)):
        follow = inner[:, i] / select(first[i], inner[i, i], 1)  # dλ_l/ds_i
        for side in (1, -1):
            then = values + follow * (side - values[i])
            fine = jnp.ones((), bool)
            for n, k in enumerate(which):
                within = then[n] >= 0 if k in model.contacts else jnp.abs(then[n]) <= model.bound(k)
                fine = fine & (within | ~first[n])
            out = out | (repels[i] & first[i] & (side * values[i] < 1) & fine)
    return out
