"""Curves of equilibria, N equations for N + 1 unknowns: the compiled parts of a pseudo-arclength continuation."""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._numerics._bracket import bracketed
from ..._numerics._compile import interactive
from ..._numerics._lapack import slogdet, solve, svd
from ..._numerics._linalg import bialternate
from ..._numerics._root import find_root, Newton
from ..._numerics._select import select
from ._equations import EquilibriumCurve as Curve


TOLERANCE = 1e-12


class Probe(NamedTuple):
    """Test functions at a point, and their derivatives along the curve."""

    values: Float[Array, " tests"]
    slopes: Float[Array, " tests"]


class Step(NamedTuple):
    """From a point, at which the test functions are `here`, to the next."""

    u: Float[Array, " n+1"]
    tangent: Float[Array, " n+1"]
    here: Probe
    there: Probe
    record: Any
    good: Bool[Array, ""]


def _tangent(curve: Curve, u: Array, border: Array, mode: Array) -> Array:
    """Of length one, and along `border`."""
    whole = jnp.concatenate([jax.jacfwd(curve.residual)(u, mode), border[None]])
    tangent = solve(whole, jnp.zeros_like(u).at[-1].set(1))
    return tangent / jnp.linalg.norm(tangent)


def distances(curve: Curve, u: Array) -> Array:
    """The guards, divided by their gradients."""
    gradients = jnp.linalg.norm(jax.lax.stop_gradient(jax.jacfwd(curve.guards)(u)), axis=-1)
    return curve.guards(u) / select(gradients == 0, 1, gradients)


def _determinants(curve: Curve, u: Array, border: Array, mode: Array) -> tuple[Array, Array]:
    """Signs and logarithms of those for branch points and for pairs, which may be out of range themselves."""
    motion = curve.motion(u, mode)
    sums = 2 * bialternate(motion, jnp.eye(len(motion), dtype=u.dtype))
    whole = jnp.concatenate([jax.jacfwd(curve.residual)(u, mode), border[None]])
    pairs = slogdet(sums) if len(motion) > 1 else (jnp.ones((), u.dtype), jnp.zeros((), u.dtype))
    signs, logs = zip(slogdet(whole), pairs)
    return jnp.stack(signs), jnp.stack(logs)


def _scale(curve: Curve, origin: Array, border: Array, mode: Array) -> Array:
    """What determinants are divided by along a step."""
    logs = _determinants(curve, origin, border, mode)[1]
    return select(jnp.isfinite(logs), logs, 0)


def _tests(curve: Curve, u: Array, border: Array, mode: Array, scale: Array) -> Array:
    tangent = _tangent(curve, u, border, mode)
    signs, logs = _determinants(curve, u, border, mode)
    first = jnp.stack([u[-1], 1 - u[-1], u[-1] - curve.mark, tangent[-1]])
    return jnp.concatenate([first, signs * jnp.exp(logs - scale), distances(curve, u)])


def _probe(curve: Curve, u: Array, border: Array, mode: Array, scale: Array) -> Probe:
    tangent = _tangent(curve, u, border, mode)
    return Probe(*jax.jvp(lambda u: _tests(curve, u, border, mode, scale), (u,), (tangent,)))


def _corrected(curve: Curve, origin: Array, tangent: Array, s: Array, guess: Array, mode: Array) -> tuple[Array, Array]:
    """The point of the curve at the distance `s` from `origin` along its tangent."""
    slopes = jax.jacfwd(curve.residual)(guess, mode)
    # Equations in units of the unknowns, so that tolerances mean the same for all.
    rows = jnp.max(jnp.abs(slopes), axis=1)
    rows = select(rows == 0, 1, rows)

    def residual(u: Array, _: Any) -> Array:
        return jnp.append(curve.residual(u, mode) / rows, tangent @ (u - origin) - s)

    return find_root(residual, guess, None, Newton(TOLERANCE, 12))


@ft.partial(interactive, host=True)
def _step(curve: Curve, u: Array, tangent: Array, s: Array, guess: Array, mode: Array) -> Step:
    end, good = _corrected(curve, u, tangent, s, guess, mode)
    ahead, scale = _tangent(curve, end, tangent, mode), _scale(curve, u, tangent, mode)
    # A loop of two turns: written out twice, the test functions were a third of the time that all of it compiles.
    probes = jax.lax.map(lambda u: _probe(curve, u, tangent, mode, scale), jnp.stack([u, end]))
    here, there = (jax.tree.map(lambda x, i=i: x[i], probes) for i in range(2))
    good = good & jnp.all(jnp.isfinite(ahead)) & jnp.all(jnp.isfinite(there.values))
    return Step(end, ahead, here, there, curve.record(end, mode), good)


def step_along(curve: Curve, u: Array, tangent: Array, s: float, mode: Array) -> Step:
    """One step of length `s` along the curve."""
    return _step(curve, u, tangent, np.asarray(s, u.dtype), u + s * tangent, mode)


class Place(NamedTuple):
    """A point found on the curve, and the tangent just before it."""

    s: float
    u: Float[Array, " n+1"]
    tangent: Float[Array, " n+1"]
    value: float


class Chord:
    """The points of a step, by their distance `s` along the tangent at its beginning: each is computed once.

    They come from the program of the step itself. One of its own for zeros took as long to compile as all the others
    together.
    """

    def __init__(self, curve: Curve, step: Step, origin: Array, tangent: Array, mode: Array):
        self._call = lambda s, guess: _step(curve, origin, tangent, np.asarray(s, origin.dtype), guess, mode)
        self._origin, self._along = origin, (step.u - origin) / (tangent @ (step.u - origin))
        self._seen: dict[float, Step] = {}

    def at(self, s: float) -> Step:
        if s not in self._seen:
            self._seen[s] = self._call(s, self._origin + s * self._along)
        return self._seen[s]

    def zero(self, low: float, high: float, read: Callable[[Probe], Any]) -> Place:
        """Where what is `read` of the test functions vanishes between two distances. That needs no derivative of it,
        and the equations of the curve are regular there. If it has one sign at both, it does so at the lower one, to
        rounding."""

        def value(step: Step) -> float:
            found = float(read(step.there))
            return found if math.isfinite(found) else 0.0  # the equations are singular exactly there

        s, ends = low, (self.at(low), self.at(high))
        if value(ends[0]) * value(ends[1]) <= 0:
            s = bracketed({s: step for s, step in self._seen.items() if low <= s <= high}, self.at, value)
        found = self.at(s)
        if not np.all(np.isfinite(found.u)):  # a place beside it is known
            s -= 1e-7 * (high - low)
            found = self.at(s)
        # The tangent with which it is reached: on the surface itself a field may have a kink that no switch tells of.
        return Place(s, found.u, self.at(s * (1 - 1e-6)).tangent, float(read(found.there)))


@ft.partial(interactive, host=True)
def on_surface(curve: Curve, u: Array, mode: Array, which: Array) -> Array:
    """The point of the curve, next to `u`, at which a guard vanishes."""

    def residual(u: Array, _: Any) -> Array:
        return jnp.append(curve.residual(u, mode), distances(curve, u)[which])

    found, good = find_root(residual, u, None, Newton(TOLERANCE, 12))
    return select(good, found, u)


@ft.partial(interactive, host=True)
def branch_point(curve: Curve, u: Array, mode: Array) -> tuple[Array, Bool[Array, ""]]:
    """A simple branch point near `u`: with ψ the left null vector of DF, F + β ψ = 0, ψᵀ DF = 0, |ψ| = 1 are regular
    equations there, where F = 0 itself is not; Moore (1980)."""
    left = svd(jax.jacfwd(curve.residual)(u, mode))[0][:, -1]

    def residual(z: tuple, _: Any) -> tuple:
        u, psi, beta = z
        pull = jax.vjp(lambda u: curve.residual(u, mode), u)[1](psi)[0]
        return curve.residual(u, mode) + beta * psi, pull, psi @ psi - 1

    (u, _, beta), good = find_root(residual, (u, left, jnp.zeros((), u.dtype)), None, Newton(TOLERANCE, 20))
    return u, good & (jnp.abs(beta) < 1e-9)


@ft.partial(interactive, host=True)
def linearised(curve: Curve, u: Array, mode: Array) -> tuple[Array, Array]:
    """F and DF."""
    return curve.residual(u, mode), jax.jacfwd(curve.residual)(u, mode)


@ft.partial(interactive, host=True)
def row_sizes(curve: Curve, u: Array, mode: Array) -> Array:
    """Of the rows of DF: what they have, or would have a unit further on, where all of a row vanishes here."""
    first = jax.jacfwd(curve.residual)
    df, bends = first(u, mode), jax.jacfwd(first)(u, mode)
    # What a linear equation fixes by itself does not vary: as the value of a switch on one side of its surface. (In
    # the middle of a rotor's stator the field of contact has no derivative; but there is no contact.)
    alone = (df != 0) & (jnp.sum(df != 0, axis=1, keepdims=True) == 1) & ~jnp.any(bends, axis=(1, 2))[:, None]
    varies = ~jnp.any(alone, axis=0)
    bends = select(varies[:, None] & varies[None, :], bends, 0)
    size = jnp.max(jnp.abs(df), axis=1) + jnp.max(jnp.abs(bends), axis=(1, 2))
    return select(size > 0, size, 1)


@ft.partial(interactive, host=True)
def branching(curve: Curve, u: Array, kernel: Float[Array, "2 n+1"], left: Array, mode: Array) -> Float[Array, "2 2"]:
    """ψᵀ D²F φ_i φ_j for the kernel φ_1, φ_2 of DF and ψ of its transpose: the branches through a simple branch point
    have the directions a φ_1 + b φ_2 on which this vanishes; Keller (1977)."""

    def along(a: Array, b: Array) -> Array:
        return left @ curve.residual(u + a * kernel[0] + b * kernel[1], mode)

    zero = jnp.zeros((), u.dtype)
    return jnp.stack([jnp.stack(row) for row in jax.hessian(along, (0, 1))(zero, zero)])


near = interactive(distances, host=True)
kept = interactive(lambda curve, u, mode: curve.record(u, mode), host=True)
motion = interactive(lambda curve, u, mode: curve.motion(u, mode), host=True)
