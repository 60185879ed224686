"""Where exactly the first event of a step is."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._barrier import once
from ..._numerics._bernstein import at, deflate, falls, first_roots, largest, lowest
from ..._numerics._jaxpr import dependence
from ..._numerics._linalg import coloured
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ..steppers._stepper import Stepper


NEAR = 0.1  # of the size of a guard on a step: only those that come so near to zero count for `Solution.margin`
# (To look at all of them made sweeps of S1 by Dopri8 1.7 times as long.)


class Interval(NamedTuple):
    """A step in one mode, on which guards may fall to zero."""

    t: Scalar
    t_next: Scalar
    y: Y  # at its beginning
    f: Y  # the field there
    state: ModeState
    polynomials: Any  # of the guards, a list of arrays `(slots, parts)`: one for each Bernstein coefficient
    noise: Any  # their rounding, `(slots, parts)`


class Located(NamedTuple):
    """The first event on an interval."""

    found: Bool[Array, ""]
    t: Scalar
    y: Y  # before it
    slot: Int[Array, ""]  # of the guard that fires
    part: Int[Array, " slots"]  # of each guard the component that is active there
    missed: Float[Array, " slots"]  # of each guard its least value, if it comes near to zero before and rises again


def step_to(te: Scalar, stepper: Stepper, args: tuple) -> tuple[Y, list[Y]]:
    model, t, y, f0, state, *_ = args
    step = stepper(model, state, t, te, y, f0)
    return step.y1, step.ks


def _guard(te: Scalar, y: Y, args: tuple) -> Scalar:
    model, _, _, _, state, slot, part, _ = args
    return model.stacked(model.guards(te, y, state), -jnp.inf)[slot, part]


@eqx.filter_custom_jvp
def _arrival(te: Scalar, y_end: Y, stepper: Stepper, args: Any) -> tuple[Scalar, Y]:
    """The time of an event and the state there, differentiated by the implicit rule.

    With g the guard that fires, dte = -dg / (dg/dt along the flow), where dg is its change at fixed time; the state
    moves along the flow by dte. The rule refers to this function again, so that derivatives of every order are right.
    At a tangency dg/dt = 0 and they are infinite, as they should be.
    """
    return te, y_end


@_arrival.def_jvp
def _arrival_jvp(primals: Any, tangents: Any) -> tuple[tuple[Scalar, Y], tuple[Scalar, Y]]:
    te, y_end, stepper, args = primals
    te, y_end = _arrival(te, y_end, stepper, args)
    model, state, found = args[0], args[4], args[7]
    moved = eqx.filter_jvp(lambda args: step_to(te, stepper, args)[0], (args,), (tangents[3],))[1]
    moved = jax.tree.map(lambda y, d: jnp.zeros_like(y) if d is None else d, y_end, moved)
    change = eqx.filter_jvp(lambda y, args: _guard(te, y, args), (y_end, args), (moved, tangents[3]))[1]
    change = jnp.zeros_like(te) if change is None else change
    f = model.flow(te, y_end, state)
    slope = jax.jvp(lambda t, y: _guard(t, y, args), (te, y_end), (jnp.ones_like(te), f))[1]
    shift = -change / select(found, slope, 1)
    return (te, y_end), (shift, jax.tree.map(lambda d, f: d + f * shift, moved, f))


def locate(model: SwitchedSystem, stepper: Stepper, step: Interval) -> Located:
    """The earliest event of a step; without one, the guard that comes nearest to zero and rises again.

    The root on the dense output is only where to look: the step is taken again to it, and one Newton step with the true
    field corrects the time, and with it the order of events closer than the dense output can tell. The state follows by
    its Taylor series to second order, so that what remains is of third order in the (small) error of the dense output.
    """
    t, t_next, y, f0, state, polynomials, noise = step
    known = model.stacked(model.known_roots(state), 0)
    # The same search finds where each guard that comes near to zero is least, for `Solution.margin`.
    single = jnp.asarray([slot.switch not in model.clocks and model.parts[slot.switch] == 1 for slot in model.slots])
    single = single & (known[:, 0] == 0)
    first = jnp.arange(known.shape[1]) == 0
    near = (once(lowest(polynomials) - NEAR * largest(polynomials)) < 0) & single[:, None]
    lows = [select(first, select(near, x, 1.0), -1.0) for x in falls(polynomials)]
    both = [jnp.concatenate(pair) for pair in zip(deflate(polynomials, known), lows)]
    (found, turns), (root, low) = (jnp.split(x, 2) for x in first_roots(both))
    turns = turns & (low > 0) & single
    args = (model, t, y, f0, state)
    frozen_model, start, y_start, f_start, _ = frozen(args)

    def field_and_guards(t: Scalar, y: Y) -> tuple[Y, Array]:
        s, f = frozen_model.values_and_flow(t, y, state)
        return f, model.stacked(frozen_model.guards(t, y, state, s=s), -jnp.inf)

    # A multiplier that stays at its bound, or a guard which begins with a double root, has no sign if it does not rise
    # above rounding on the whole step.
    least = jnp.asarray([0 if slot.holding else 2 for slot in model.slots], known.dtype)[:, None]
    found = found & ~jnp.any((once(largest(polynomials)) <= noise) & (known >= least), axis=-1)
    root = select(found, root, jnp.inf)
    earliest = jnp.min(root)
    length = lax.stop_gradient(t_next) - start
    met = jnp.any(found)
    dips = select(turns & (low < earliest), at(polynomials, low)[:, 0], jnp.inf)
    nearest = jnp.argmin(dips / once(largest(polynomials))[:, 0])
    guess = start + select(met, jnp.minimum(earliest, 1), select(turns[nearest], low[nearest], 1)) * length

    y_guess = stepper(frozen_model, state, start, guess, y_start, f_start).y1
    f = frozen_model.flow(guess, y_guess, state)
    (_, values), (bend, rates) = jax.jvp(field_and_guards, (guess, y_guess), (jnp.ones_like(guess), f))
    part = jnp.argmax(values, axis=-1)
    value = jnp.take_along_axis(values, part[:, None], axis=-1)[:, 0]
    rate = jnp.take_along_axis(rates, part[:, None], axis=-1)[:, 0]
    shift = -value / select(rate == 0, 1, rate)
    # Finite where no root was found, too: in reverse mode what is not used is multiplied by zero, and inf - inf is NaN.
    plain = select(found, root - earliest, 0) * length
    # The dense output is nearly right: a Newton step that rises, or is long, belongs to a tangency or to another root,
    # and the root of the polynomial stands. So does a root more than 1e-4 of the step after the first one, where the
    # field at the first one says little.
    trusted = (rate < 0) & (jnp.abs(shift) <= 1e-2 * length) & (plain <= 1e-4 * length)
    shift = select(trusted, shift, plain)
    # Of events at one instant the first in the order of declaration: as long as no guard has fallen below its rounding.
    blur = jnp.take_along_axis(noise, part[:, None], axis=-1)[:, 0] / select(rate == 0, 1, jnp.abs(rate))
    latest = jnp.min(select(found, shift + select(trusted, blur, 0), jnp.inf))
    slot = select(met, jnp.argmax(found & (shift <= latest)), nearest).astype(jnp.int32)
    # The dense output tells how near each comes; without an event the step was taken again to the nearest of them.
    missed = select(~met & (jnp.arange(len(dips)) == nearest) & (dips < jnp.inf), value, dips)
    if model.clocks:  # at a tick a guard may jump away from zero as it comes to it
        ticks = met & jnp.asarray([k in model.clocks for k, _, _ in model.slots])[slot]
        falls_on = ticks & single & (value > 0) & (rate < 0)
        missed = select(falls_on, jnp.minimum(missed, value), missed)
    te = jnp.clip(guess + shift[slot], start, start + length)
    dt = te - guess
    y_end = jax.tree.map(lambda y, f, b: y + dt * (f + 0.5 * dt * b), y_guess, f, bend)
    te, y_end = _arrival(te, y_end, stepper, (*args, slot, part[slot], met))
    # At the very start of the step the event is a consequence of the one before: it has the same time and derivative.
    at_once = jnp.isfinite(root[slot]) & (root[slot] <= 0)
    te, y_end = jax.tree.map(lambda a, b: select(at_once, a, b), (t, y), (te, y_end))
    return Located(met, te, y_end, slot, part, missed)


def seen_numbers(model: SwitchedSystem, t: Scalar, y: Y, state: ModeState) -> tuple[tuple[int, ...], ...]:
    """`[slot][colour]`: the number of the state of which a guard takes notice, whatever the state, in the sum of the
    directions of a colour; or -1."""
    flat, unravel = jfu.ravel_pytree(y)
    rows = model.guards(t, y, state)
    touches = dependence(lambda x: [g for row in model.guards(t, unravel(x), state) for g in row], flat)
    owner = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    touches = np.stack([touches[owner == i].any(axis=0) for i in range(len(rows))])
    found = np.full((len(rows), len(colours := coloured(touches))), -1)
    for c, columns in enumerate(colours):
        for j in columns:
            found[touches[:, j], c] = j
    return tuple(map(tuple, found.tolist()))


class Encounter(NamedTuple):
    """How each guard falls, in the mode that ends."""

    cosine: Float[Array, " slots"]  # between the trajectory and the normal of its surface, in time and state
    rate: Float[Array, " slots"]  # of the guard
    slack: Float[Array, " slots"]  # what an error of the state within the tolerance makes of it
    size: Float[Array, " slots"]  # of its terms that depend on the state


def encounter(
    model: SwitchedSystem,
    t: Scalar,
    y: Y,
    state: ModeState,
    part: Int[Array, " slots"],
    tolerance: Any,
    seen: tuple[tuple[int, ...], ...],
) -> Encounter:
    """`tolerance`: relative and absolute. `seen`: `seen_numbers` of a model with many switches, else empty."""
    model, t, y = frozen((model, t, y))
    flat, unravel = jfu.ravel_pytree(y)

    def guards_and_field(t: Scalar, x: Array) -> tuple[Float[Array, " slots"], Array]:
        s, f = model.values_and_flow(t, unravel(x), state)
        rows = model.stacked(model.guards(t, unravel(x), state, s=s), -jnp.inf)
        return rows[np.arange(len(model.slots)), part], jfu.ravel_pytree(f)[0]

    rtol, atol = tolerance
    error, size = atol + rtol * jnp.abs(flat), jnp.abs(flat)
    if not seen:
        (h_t, n), f = jax.jacfwd(guards_and_field, argnums=(0, 1), has_aux=True)(t, flat)
        cosines = jax.vmap(cosine, (0, 0, None))(h_t, n, f)
        return Encounter(cosines, h_t + n @ f, jnp.abs(n) @ error, jnp.abs(n) @ size)
    table = np.array(seen)
    number = np.arange(len(flat))
    seeds = jnp.asarray([np.isin(number, column) for column in table.T], flat.dtype)

    def moved(dt: Scalar, dx: Array) -> tuple[Float[Array, " slots"], Array]:
        return jax.jvp(guards_and_field, (t, flat), (dt, dx), has_aux=True)[1:]

    h_t, f = moved(jnp.ones_like(t), jnp.zeros_like(flat))
    n = jax.vmap(lambda dx: moved(jnp.zeros_like(t), dx)[0], out_axes=1)(seeds)
    n, near = select(table < 0, 0, n), jnp.maximum(table, 0)
    # (Sums of a few columns, written out: XLA's products of so short rows take ten times as long.)
    zero, columns = jnp.zeros_like(h_t), list(zip(n.T, f[near].T, error[near].T, size[near].T))

    def total(fn: Any) -> Array:
        return sum((fn(*column) for column in columns), zero)

    square, along = total(lambda n, f, error, size: n * n), total(lambda n, f, error, size: n * f)
    slack, terms = (total(lambda n, f, *sizes, i=i: jnp.abs(n) * sizes[i]) for i in (0, 1))
    return Encounter(_cosine(h_t, square, along, f @ f), h_t + along, slack, terms)


def cosine(h_t: Scalar, n: Float[Array, " n"], f: Float[Array, " n"]) -> Scalar:
    """Between the trajectory and the normal (h_t, n) of a surface."""
    return _cosine(h_t, n @ n, n @ f, f @ f)


def _cosine(h_t: Scalar, square: Scalar, along: Scalar, speed: Scalar) -> Scalar:
    """From |n|², n·f and |f|²."""
    size = (square + h_t**2) * (speed + select(h_t == 0, 0, 1))
    return jnp.abs(along + h_t) / jnp.sqrt(size)
