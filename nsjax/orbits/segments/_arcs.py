"""The smooth arcs of an orbit, each followed in its own mode, whatever surfaces do to the flow."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._compile import interactive
from ..._numerics._minima import grouped, in_order, Minima, minima, places_of, THETA
from ..._numerics._select import select
from ..._numerics._text import between, shown, written
from ..._types import Scalar, Y
from ...flow._integrator import Integrator
from ...flow._mode_flow import ModeFlow
from ...flow._results import is_okay
from ...flow._save import times_between
from ...flow._solve import integrate
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._system import System


SAMPLES = 65  # of an arc, to be drawn
TRUSTED = 1e2  # dense output may err by this many tolerances of the steps


@shown
class Arcs(NamedTuple):
    """The arcs of an orbit between its events, in rows; those past the last have no length.

    **Attributes:**

    - `begin`, `end`: times, shape `(arcs,)`. (Where impacts accumulate the next arc begins later than this one ends.)
    - `mode`: the mode, shape `(arcs, switches)`.
    - `y`: states at the beginnings of the pieces of equal length into which each arc is divided; leaves with two
        leading axes `(arcs, pieces)`.
    """

    begin: Float[Array, " arcs"]
    end: Float[Array, " arcs"]
    mode: Int[Array, "arcs switches"]
    y: Y

    def __str__(self) -> str:
        real = np.asarray(self.begin != self.end)
        return f"arcs of an orbit: {real.sum()}, t = {between(np.stack([self.begin, self.end])[:, real])}"


@shown
class Path(NamedTuple):
    """An orbit along its arcs: leaves with two leading axes, for arcs and times."""

    t: Float[Array, "arcs times"]
    y: Y
    mode: Int[Array, "arcs switches"]

    def __str__(self) -> str:
        real = np.asarray(self.t[..., 0] != self.t[..., -1])
        head = f"path of an orbit, t = {between(self.t)}: arcs {real.sum()}, times on each {self.t.shape[-1]}"
        return f"{head}\n  states  {written(self.y, self.t.ndim)}"


class Flows(eqx.Module):
    """The smooth flows of all arcs of a system, each divided into `pieces` of equal length."""

    system: System
    within: ModeState
    t0: Scalar
    y0: Y
    sizes: Float[Array, " n"]  # of the state, for the tolerances of the solver
    pieces: int = eqx.field(static=True)
    integrator: Integrator = eqx.field(static=True)

    @property
    def model(self) -> SwitchedSystem:
        return SwitchedSystem.forwards(self.system, self.t0, self.y0, smooth=True)

    def piece(self, a: Scalar, b: Scalar, x: Array, state: ModeState, saveat: dfx.SaveAt) -> Any:
        unravel = jfu.ravel_pytree(self.y0)[1]
        smooth = ModeFlow(self.model, state, unravel(self.sizes))
        relative = self.integrator.in_sizes(x.dtype)
        sol = integrate(smooth, a, b, unravel(x / self.sizes), relative, saveat=saveat)
        flat = jax.vmap(lambda y: jfu.ravel_pytree(y)[0] * self.sizes)(sol.ys)
        return jax.tree.map(lambda y: select(is_okay(sol.result), y, jnp.nan), flat)

    def rows(self, fn: Any, begin: Array, end: Array, x: Array) -> Any:
        """`fn(a, b, x, state)` for every piece of every arc."""

        def row(a: Scalar, b: Scalar, x: Array, state: ModeState) -> Any:
            starts = a + (b - a) * jnp.arange(self.pieces, dtype=a.dtype) / self.pieces
            return jax.vmap(lambda a, b, x: fn(a, b, x, state))(starts, jnp.append(starts[1:], b), x)

        return jax.vmap(row)(begin, end, x, self.within)

    def paths(self, begin: Array, end: Array, x: Array, samples: int = SAMPLES) -> tuple[Array, Array]:
        """Times and states along every arc."""

        def along(a: Scalar, b: Scalar, x: Array, state: ModeState) -> tuple[Array, Array]:
            a, b, ts = times_between(a, b, np.linspace(0, 1, samples))
            return ts, self.piece(a, b, x, state, dfx.SaveAt(ts=ts))

        ts, xs = self.rows(along, begin, end, x)
        return ts.reshape(len(begin), -1), xs.reshape(len(begin), -1, x.shape[-1])

    def minima(
        self, a: Scalar, b: Scalar, x: Array, state: ModeState,
        functions: Callable[[Scalar, Array], list[list[Scalar]]], below: Callable[[Array], Array],
    ) -> Minima:  # fmt: skip
        """The least values along a piece of functions `[function][part]` of time and state, each the largest of its
        parts (`below` as for `minima`)."""
        controller = self.integrator.stepsize_controller
        rtol, atol = (getattr(controller, name, 0.0) for name in ("rtol", "atol"))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], x.shape)
        unit, _ = jfu.ravel_pytree(jax.tree.map(lambda y, tol: jnp.full_like(y, tol), self.y0, _spread(atol, self.y0)))
        ratio, _ = jfu.ravel_pytree(jax.tree.map(lambda y, tol: jnp.full_like(y, tol), self.y0, _spread(rtol, self.y0)))

        def sample(first: Scalar, last: Scalar, x: Array) -> tuple[Array, Array, tuple]:
            begin, end, ts = times_between(a + (b - a) * first, select(last < 1, a + (b - a) * last, b), THETA)
            return ts, self.piece(begin, end, x, state, dfx.SaveAt(ts=ts)), ()

        def groups(ts: Array, xs: Array) -> tuple[list[Array], Array]:
            near = xs + TRUSTED * jnp.asarray(signs, x.dtype) * (unit + ratio * jnp.abs(xs))
            rows = jax.vmap(functions)(jnp.concatenate([ts, ts]), jnp.concatenate([xs, near]))
            both = grouped(rows)
            off = [jnp.max(jnp.abs(v[..., : len(ts)] - v[..., len(ts) :]), axis=(1, 2)) for v in both]
            return [v[..., : len(ts)] for v in both], jnp.concatenate(off)

        places = places_of(jax.eval_shape(functions, a, x))
        orders = jnp.zeros((2, len(places)), x.dtype)
        return in_order(minima(sample, groups, x, orders, below), places)


def _spread(tolerance: Any, y: Y) -> Y:
    """A tolerance for every leaf: it may be one for all."""
    return jax.tree.map(lambda _: tolerance, y) if jax.tree.structure(tolerance).num_leaves < 2 else tolerance


def flows_of(system: System, arcs: Arcs, integrator: Integrator) -> tuple[Flows, Float[Array, "arcs pieces n"]]:
    """The flows along the arcs of an orbit, and the states at the beginnings of their pieces."""
    y0, first = (jax.tree.map(lambda y, i=i: y[i], arcs.y) for i in ((0, 0), (slice(None), 0)))
    model = SwitchedSystem.forwards(system, arcs.begin[0], y0, smooth=True)
    within = jax.vmap(lambda t, y, mode: model.state_at(t, y, tuple(mode)))(arcs.begin, first, arcs.mode)
    x = jax.vmap(jax.vmap(lambda y: jfu.ravel_pytree(y)[0]))(arcs.y)
    first, last = arcs.begin[0], jnp.max(arcs.end)
    field, _ = jfu.ravel_pytree(model.flow(first, y0, jax.tree.map(lambda leaf: leaf[0], within)))
    sizes = frozen(integrator.sizes_of(jnp.max(jnp.abs(x), axis=(0, 1)), field, last - first))
    return Flows(system, within, first, y0, sizes, x.shape[1], integrator), x


@interactive
def path_of(system: System, arcs: Arcs, samples: int, integrator: Integrator) -> Path:
    """States along the arcs."""
    flows, x = flows_of(system, arcs, integrator)
    ts, xs = flows.paths(arcs.begin, arcs.end, x, samples)
    return Path(ts, jax.vmap(jax.vmap(jfu.ravel_pytree(flows.y0)[1]))(xs), arcs.mode)
