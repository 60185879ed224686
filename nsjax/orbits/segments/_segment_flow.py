"""The flow of one mode from one time to another, with its derivatives: what segments of an orbit are made of.

Where the field of the mode is affine in the state it is the matrix exponential, else steps of the solver; derivatives
by the state and by the arrays of the model are those of the variational equation, by the times exact.
"""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._numerics._compile import interactive
from ..._numerics._minima import NODES, THETA, WEIGHTS
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...flow._integrator import Integrator
from ...flow._mode_flow import ModeFlow, VariedModeFlow
from ...flow._results import is_okay
from ...flow._save import times_between
from ...flow._solve import integrate
from ...flow.steppers._exponential import affine_parts, expm, forcing_of, generator
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._parameter import FreeParameters
from ...system._ticking import ticking


TRUSTED = 1e2  # dense output may err by this many tolerances of the steps
NEVER, FREE_MODES, ALWAYS = range(3)  # when a mode's flow is known by its exponential


class SegmentFlow(eqx.Module):
    """The flow of each mode of a model, for a value of its free parameter (or of several). Derivatives are those by the
    value, and by arrays of the model."""

    base: SwitchedSystem
    free: FreeParameters
    value: Array
    like: Y
    sizes: Float[Array, " n"]  # of the state, for the tolerances of the solver
    integrator: Integrator = eqx.field(static=True)
    exact: bool = eqx.field(static=True)
    slides: bool = eqx.field(static=True)  # whether modes that are held occur

    @property
    def model(self) -> SwitchedSystem:
        return self.base.with_system(self.free.put(self.base.system, self.value))

    @property
    def missed(self) -> float:
        """By which part of a state of size one its dense output may be wrong."""
        found = [getattr(self.relative.stepsize_controller, name, 0.0) for name in ("rtol", "atol")]
        worst = max(float(np.max(x)) for tolerance in found for x in jax.tree.leaves(tolerance) or [0.0])
        return 0.0 if self.exact else TRUSTED * worst

    @property
    def relative(self) -> Integrator:
        """The integrator for states that are measured in `sizes`."""
        return self.integrator.in_sizes(self.sizes.dtype)

    def unravel(self, x: Array) -> Y:
        return jfu.ravel_pytree(self.like)[1](x)

    def in_mode(self, state: ModeState) -> ModeFlow:
        """Returns the flow of one mode as a system whose state is measured in `sizes`."""
        return ModeFlow(self.model, state, self.unravel(self.sizes))

    def field(self, t: Scalar, x: Array, state: ModeState) -> Array:
        model = self.model
        if self.exact and not self.slides:
            model = model.within(state.mode)
            return jfu.ravel_pytree(model.field(t, self.unravel(x), model.signs(t, state)))[0]
        return jfu.ravel_pytree(model.flow(t, self.unravel(x), state))[0]

    def generator(self, a: Scalar, b: Scalar, x: Array, state: ModeState) -> tuple:
        """Of the exact flow from time a to b, see `generator`."""
        f, timed = self.field(a, x, state), forcing_of(self.model, a, self.unravel(x))
        assert timed is not None  # see `exactness`
        return generator(lambda t, x: self.field(t, x, state), a, x, f, b - a, timed)

    def arrive(self, a: Scalar, b: Scalar, x: Array, state: ModeState) -> Array:
        """The state at time b of the flow from `x` at time a."""
        return _arrive(self, a, b, x, state)

    def along(self, a: Scalar, b: Scalar, x: Array, state: ModeState) -> tuple[Array, Array, Array]:
        """Times and states at the nodes `THETA` of the way (between steps they are those of the solver's dense output,
        less exact than the steps); and the integrals of the state and of its square."""
        a, b, ts = times_between(a, b, THETA)
        if self.exact:
            xs = _samples(self, a, b, x, state)
        else:
            span = jnp.abs(b - a)
            # Of a segment without length every point is its beginning.
            far = select(span > 0, b, jnp.nextafter(a, jnp.inf))
            smooth, saveat = self.in_mode(state), dfx.SaveAt(ts=select(span > 0, ts, a))
            sol = integrate(smooth, a, far, self.unravel(x / self.sizes), self.relative, saveat=saveat)
            xs = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(sol.ys) * self.sizes
            xs = select(span > 0, xs, x)
        weights = jnp.asarray(WEIGHTS, x.dtype)[:, None] * (b - a)
        return ts, xs, jnp.stack([jnp.sum(weights * xs, axis=0), jnp.sum(weights * xs**2, axis=0)])


@interactive
def exactness(model: SwitchedSystem, t: Scalar, y: Y) -> int:
    """Which modes have fields that are affine in the state, with a constant matrix and forcing that the exponential
    knows. (A program without operations: it is asked once of models of one kind.)"""
    zero = jnp.zeros((), jnp.int32)
    parts = tuple(zero if n > 1 else None for n in model.parts)
    state = ModeState(tuple(zero for _ in model.switches), parts, tuple(zero for _ in model.switches))
    if not all(affine_parts(lambda t, y: model.field(t, y, model.signs(t, state)), t, y)):
        return NEVER
    if forcing_of(model, t, y) is None or ticking(model.system, t, y) is not model.system:
        return NEVER
    return ALWAYS if all(affine_parts(lambda t, y: model.flow(t, y, state), t, y)) else FREE_MODES


@interactive
def states_along(flow: SegmentFlow, a: Scalar, b: Scalar, x: Array, state: ModeState) -> Array:
    """States along a segment, see `SegmentFlow.along`."""
    return flow.along(a, b, x, state)[1]


def _exponential(
    flow: SegmentFlow, a: Scalar, b: Scalar, x: Array, state: ModeState
) -> tuple[Array, Float[Array, "n n"]]:
    """The state at the end, and its derivative by that at the beginning."""
    m, scale = flow.generator(a, b, x, state)
    n, e = len(x), expm(m)
    return x + scale * e[:n, n], e[:n, :n]


def _samples(flow: SegmentFlow, a: Scalar, b: Scalar, x: Array, state: ModeState) -> Float[Array, "nodes n"]:
    """States at the nodes: from those at equal distances, with three derivatives, by Hermite's polynomials of degree
    seven, which miss a 10321920th of the eighth power of the phase between two of them."""
    m, scale = flow.generator(a, b, x, state)
    n, step = len(x), expm(m / NODES)
    z = jnp.zeros((len(m), 1), x.dtype).at[n, 0].set(1)
    while z.shape[1] <= NODES:
        z = jnp.concatenate([z, step @ z[:, : NODES + 1 - z.shape[1]]], axis=1)
        step = step @ step
    first = m @ z / NODES
    second = m @ first / NODES
    third = m @ second / NODES
    # Where each node lies between which two samples.
    cell = np.minimum((THETA * NODES).astype(int), NODES - 1)
    weights = jnp.asarray(_hermite(THETA * NODES - cell), x.dtype)
    rows = [part[:n, cell + k] for k in (0, 1) for part in (z, first, second, third)]
    out = sum(w * row for w, row in zip(weights, rows))
    return (x[:, None] + scale * out).T


def _hermite(s: np.ndarray) -> np.ndarray:
    """The polynomials of degree seven that belong to value and three derivatives at 0, and at 1."""
    powers = np.arange(8)
    factors = np.cumprod([np.ones(8), powers, powers - 1, powers - 2], axis=0)
    at_zero = np.eye(4, 8) * factors
    coefficients = np.linalg.inv(np.concatenate([at_zero, factors]))
    return (s[:, None] ** powers @ coefficients).T


@eqx.filter_custom_jvp
def _arrive(flow: SegmentFlow, a: Any, b: Any, x: Any, state: Any) -> Array:
    if flow.exact:
        return _exponential(flow, a, b, x, state)[0]
    sol = integrate(flow.in_mode(state), a, b, flow.unravel(x / flow.sizes), flow.relative)
    return select(is_okay(sol.result), jfu.ravel_pytree(sol.y1)[0] * flow.sizes, jnp.nan)


@_arrive.def_jvp
def _arrive_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """By the variational equation; by the times exactly, as the flow knows no beginning."""
    flow, a, b, x, state = primals
    dflow, da, db, dx, _ = tangents
    # None where an array is not perturbed: it has no columns in the variational equation. (`like` is structure only.)
    perturbed = dflow.base, dflow.value
    dmodel = jax.tree.leaves(perturbed)
    end, by_x, by_model = _varied(flow, perturbed, a, b, x, state)
    out = jnp.zeros_like(x)
    if db is not None:
        out = out + flow.field(b, end, state) * db
    if dx is not None:
        out = out + by_x @ dx
    if da is not None:
        out = out - by_x @ flow.field(a, x, state) * da
    if dmodel:
        out = out + by_model @ jnp.concatenate([jnp.ravel(d).astype(x.dtype) for d in dmodel])
    return end, out


def _varied(
    flow: SegmentFlow, perturbed: Any, a: Scalar, b: Scalar, x: Array, state: ModeState
) -> tuple[Array, Float[Array, "n n"], Float[Array, "n arrays"]]:
    """The state at the end, and its derivatives by that at the beginning, and by the numbers in those arrays of the
    model, and values of parameters, that are `perturbed`."""
    mask = jax.tree.map(lambda d: d is not None, perturbed, is_leaf=lambda d: d is None)
    changed, still = eqx.partition((flow.base, flow.value), mask)
    values, unravel = jfu.ravel_pytree(changed)
    n, m = len(x), values.size

    def at(values: Array) -> SegmentFlow:
        base, value = eqx.combine(unravel(values), still)
        return dataclasses.replace(flow, base=base, value=value)

    if flow.exact:

        def end(values: Array) -> tuple[Array, tuple[Array, Array]]:
            end, by_x = _exponential(at(values), a, b, x, state)
            return end, (end, by_x)

        if not m:
            return *_exponential(flow, a, b, x, state), jnp.zeros((n, 0), x.dtype)
        by_model, (out, by_x) = jax.jacfwd(end, has_aux=True)(values)
        return out, by_x, by_model
    eye = jnp.eye(n + m, dtype=x.dtype)
    moved = None
    if m:
        depends = jax.tree.map(lambda new, old: new is not old, at(values).model, flow.base)
        numbers = jax.linearize(lambda values: eqx.filter(at(values).model, depends), values)[1]
        moved = jax.vmap(numbers)(eye[:, n:].astype(values.dtype))
    columns = jax.vmap(flow.unravel)(eye[:, :n])
    smooth = VariedModeFlow(flow.model, state, flow.unravel(flow.sizes), moved)
    sol = integrate(smooth, a, b, (flow.unravel(x / flow.sizes), columns), flow.relative)
    y, along = sol.y1
    out = select(is_okay(sol.result), jfu.ravel_pytree(y)[0] * flow.sizes, jnp.nan)
    phi = jax.vmap(lambda c: jfu.ravel_pytree(c)[0], out_axes=1)(along) * flow.sizes[:, None]
    return out, phi[:, :n] / flow.sizes, phi[:, n:]
