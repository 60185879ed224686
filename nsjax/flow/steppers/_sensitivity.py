"""The error of derivatives in the choice of steps: forward sensitivities are kept to a tolerance of their own.

Where the state stands still its error says nothing, and steps that it alone had chosen would grow without bound; the
derivatives at an equilibrium move all the same. Without differentiation nothing limits the steps but the state.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._barrier import once, stored
from ..._numerics._jaxpr import is_constant
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState, put
from ...system._model import SwitchedSystem


NEVER_BELOW = 0.01  # the phase that a step may always have, whatever the error of derivatives seems to be
SLACK = 100  # derivatives may err by this many tolerances a step, so that they seldom are what makes it shorter


@custom_vmap
def _of_all_directions(worst: Scalar, state: Scalar) -> Scalar:
    """The largest of `worst` among the directions of a derivative, which have their `state` in common."""
    return worst


@_of_all_directions.def_vmap
def _of_a_batch(size: int, batched: list[bool], worst: Array, state: Array) -> tuple[Array, bool]:
    if batched[1]:  # lanes, each with its own state
        worst = worst if batched[0] else jnp.broadcast_to(worst, (size, *worst.shape))
        return _of_all_directions(worst, state), True
    # (XLA's code for a maximum along an axis takes as long as all stages of a step.)
    most = ft.reduce(jnp.maximum, list(worst)) if size <= 16 else jnp.max(worst, axis=0)
    return _of_all_directions(most, state), False


@jax.custom_jvp
def largest_so_far(swing: Scalar, y: Y) -> Scalar:
    """A number that means nothing; its derivative is the largest that any number of the state has had so far."""
    return swing


@largest_so_far.defjvp
def _largest_so_far_jvp(primals: tuple[Scalar, Y], tangents: tuple[Scalar, Y]) -> tuple[Scalar, Scalar]:
    largest, dy = frozen(tangents)
    for x in jax.tree.leaves(dy):
        largest = jnp.maximum(largest, jnp.max(select(jnp.isfinite(x), jnp.abs(x), 0)))
    return largest_so_far(*primals), largest


class Sensed(NamedTuple):
    """A step as its derivatives see it."""

    model: SwitchedSystem
    state: ModeState
    t: Scalar
    length: Scalar
    y: Y
    y1: Y
    estimate: Y  # its derivative is the error of the derivatives
    swing: Scalar  # `largest_so_far`
    kept: Bool[Array, ""]  # whether it is accurate enough for the state; else that alone says how long the next is


@eqx.filter_custom_jvp
def trusted(step: Sensed, tolerance: tuple[Any, Any], order: int) -> Scalar:
    """Up to which length a step may go. Without differentiation any; with it, as far as the error of derivatives, which
    grows with that power of the length, stays below their tolerance.

    That is a part of the derivative's size, and its absolute part one of the largest size so far: the same for any unit
    of the parameter, and without care for what has been forgotten.
    """
    return jnp.full_like(step.length, jnp.inf)


@trusted.def_jvp
def _trusted_jvp(primals: Any, tangents: Any) -> tuple[Scalar, Scalar]:
    step, (rtol, atol), order = frozen(primals)

    def derivative(part: Callable[[Any], Any]) -> Y:
        return jax.tree.map(lambda x, d: jnp.zeros_like(x) if d is None else d, part(step), part(frozen(tangents[0])))

    errors, largest = derivative(lambda s: s.estimate), derivative(lambda s: s.swing)
    dys = [derivative(lambda s: s.y), derivative(lambda s: s.y1)]
    sizes = jax.tree.map(lambda *dys: ft.reduce(jnp.maximum, map(jnp.abs, dys)), *dys)
    largest = ft.reduce(jnp.maximum, map(jnp.max, jax.tree.leaves(sizes)), largest)
    # (A derivative of zero has no error, and one that does not exist must not end the solution.)
    floor = atol * largest + jnp.finfo(step.t.dtype).tiny
    ratios = jax.tree.map(lambda e, size: jnp.max(jnp.abs(e) / (floor + rtol * size)), stored(errors), sizes)
    worst = once(ft.reduce(jnp.maximum, jax.tree.leaves(ratios)))  # for each direction, not in one kernel for all
    lane = sum(jnp.sum(x) for x in jax.tree.leaves(step.y))
    worst = select(step.kept & (worst < jnp.inf), worst, 0) / SLACK
    doubted, worst = worst > 1, once(_of_all_directions(worst, lane))
    # Far below the tolerance the error of one step says little of the next.
    far = select(worst > 0.1, step.length * jnp.maximum(worst, 0.1) ** (-1 / order), jnp.inf)
    far = jnp.maximum(far, _surely(worst > 1, doubted, step, frozen(tangents[0]).model, lane))
    return jnp.minimum(far, trusted(*primals)), jnp.zeros_like(far)


def _surely(any_doubted: Bool[Array, ""], doubted: Bool[Array, ""], step: Sensed, moved: Any, lane: Scalar) -> Scalar:
    """The length over which no derivative of this mode turns by more than `NEVER_BELOW`. Where terms cancel, as in a
    mode that is held, derivatives that are zero are rounding, which no step is short enough to resolve.

    `any_doubted`: whether the error is too large in any direction of the derivative; `doubted`: whether it is in this
    direction, for which the tangent of the model is `moved`. (The forcing ∂f/∂p of a direction whose error is small may
    pass through zero at this time, where its relative rate of change is infinite.)
    """
    dynamic, static = eqx.partition((step.model, step.state, step.t, step.y, moved, doubted), eqx.is_array)
    timed = not is_constant(lambda t: step.model.flow(t, step.y, step.state), step.t)

    def length(dynamic: Any) -> Scalar:
        model, state, t, y, moved, doubted = eqx.combine(dynamic, static)
        x, unravel = jfu.ravel_pytree(y)
        m = jax.jacfwd(lambda x: jfu.ravel_pytree(model.flow(t, unravel(x), state))[0])(x)
        size, rate = jnp.ones_like(t), jnp.full_like(t, jnp.inf)
        for power in (1, 2, 4, 8):  # |m^k|^(1/k): what is nilpotent has no rate
            norm = jnp.max(jnp.sum(jnp.abs(m), axis=1))
            size = size * norm ** (1 / power)
            rate = jnp.minimum(rate, size)
            m = m / select(norm > 0, norm, 1)
            m = m @ m
        if timed:
            forced = select(doubted, _forced_rate(model, moved, state, t, y), 0)
            rate = jnp.maximum(rate, _of_all_directions(forced, lane))
        return select(rate > 0, NEVER_BELOW / select(rate > 0, rate, 1), jnp.inf)

    none = jnp.zeros_like(step.t)
    return select(any_doubted, lax.cond(eqxi.unvmap_any(any_doubted), length, lambda _: none, dynamic), none)


def _forced_rate(model: SwitchedSystem, moved: Any, state: ModeState, t: Scalar, y: Y) -> Scalar:
    """How fast what drives a derivative changes in time: ∂f/∂p (for the tangent `moved` of the model), which has a time
    scale of its own where the mode has none, as that of a rigid body, or a slower one. Zero if ∂f/∂p is rounding."""
    s, zero, one = model.values(t, y, state), jnp.zeros_like(t), jnp.ones_like(t)

    def tangent(fn: Callable[[SwitchedSystem], Y]) -> Array:
        change = eqx.filter_jvp(fn, (model,), (moved,))[1]
        leaves = [jnp.zeros_like(x) if d is None else d for x, d in zip(jax.tree.leaves(y), _leaves(change))]
        return jnp.concatenate([jnp.ravel(x) for x in leaves])

    def drive(t: Scalar) -> Array:
        return tangent(lambda model: model.flow(t, y, state))

    def slope(t: Scalar) -> tuple[Array, Array]:
        return jax.jvp(drive, (t,), (one,))

    (value, first), (_, second) = jax.jvp(slope, (t,), (one,))
    size, first, second = (jnp.max(jnp.abs(x)) for x in (value, first, second))
    terms = jnp.max(jnp.abs(tangent(lambda model: model.field(t, y, s))))
    if model.holdable:
        terms = jnp.maximum(terms, _by_multipliers(model, moved, state, t, y, s))
    eps = float(jnp.finfo(t.dtype).eps)
    driven = size > 1e5 * eps * terms
    size = select(driven, size, one)
    return select(driven, jnp.maximum(first / size, jnp.sqrt(second / size)), zero)


def _by_multipliers(
    model: SwitchedSystem, moved: Any, state: ModeState, t: Scalar, y: Y, s: tuple[Scalar, ...]
) -> Scalar:
    """Returns the size of the terms by which a parameter changes the field through the multipliers of held switches.

    These terms may cancel, as they do for the unit of a surface, which changes no multiplier; what is left is rounding.
    """
    held = [model.held(k, state.mode[k]) for k in model.holdable]
    free = put(s, model.holdable, [select(on, 0, s[k]) for k, on in zip(model.holdable, held)])

    def rates(model: SwitchedSystem) -> list[Scalar]:
        return list(model.rates(model.holdable, t, y, state, free))

    values, changes = eqx.filter_jvp(rates, (model,), (moved,))
    shares = [
        jnp.abs(change) * select(on & (value != 0), 1 / select(value == 0, 1, jnp.abs(value)), 0)
        for value, change, on in zip(values, changes, held)
        if change is not None
    ]
    pull = jax.tree.map(lambda a, b: jnp.max(jnp.abs(a - b)), model.field(t, y, s), model.field(t, y, free))
    return ft.reduce(jnp.maximum, shares, jnp.zeros_like(t)) * ft.reduce(jnp.maximum, jax.tree.leaves(pull))


def _leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree, is_leaf=lambda x: x is None)
