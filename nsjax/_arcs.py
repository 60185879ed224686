"""The smooth arcs of an orbit, each followed in its own mode, whatever surfaces do to the flow."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._filippov import Model, State
from ._jacobian import dense_jacobian
from ._results import is_okay
from ._saltation import states
from ._solve import solve
from ._system import System
from ._types import Scalar, Y


SAMPLES = 65  # of an arc, between which nothing is looked at


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


class Path(NamedTuple):
    """An orbit along its arcs: leaves with two leading axes, for arcs and times."""

    t: Float[Array, "arcs times"]
    y: Y
    mode: Int[Array, "arcs switches"]


class Smooth(System):
    """The field of one mode."""

    model: Model
    state: State

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        return self.model.flow(t, y, self.state)


def model_of(system: System, t: Scalar, y: Y) -> Model:
    return Model(system, jnp.ones_like(t), t, y)


class Flows(eqx.Module):
    """The smooth flows of all arcs of a system, each divided into `pieces` of equal length."""

    system: System
    within: State
    t0: Scalar
    y0: Y
    pieces: int = eqx.field(static=True)
    how: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    @property
    def model(self) -> Model:
        return model_of(self.system, self.t0, self.y0)

    def piece(self, a: Scalar, b: Scalar, x: Array, state: State, saveat: dfx.SaveAt) -> Any:
        unravel = jfu.ravel_pytree(self.y0)[1]
        smooth = Smooth(self.model, state)
        sol = solve(smooth, a, b, unravel(x), saveat=saveat, throw=False, **dict(self.how))
        flat = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(sol.ys)
        return jax.tree.map(lambda y: jnp.where(is_okay(sol.result), y, jnp.nan), flat)

    def rows(self, fn: Any, begin: Array, end: Array, x: Array) -> Any:
        """`fn(a, b, x, state)` for every piece of every arc."""

        def row(a: Scalar, b: Scalar, x: Array, state: State) -> Any:
            starts = a + (b - a) * jnp.arange(self.pieces, dtype=a.dtype) / self.pieces
            return jax.vmap(lambda a, b, x: fn(a, b, x, state))(starts, jnp.append(starts[1:], b), x)

        return jax.vmap(row)(begin, end, x, self.within)

    def ends(self, begin: Array, end: Array, x: Array) -> Float[Array, "rows pieces n"]:
        def last(flows: Flows, a: Scalar, b: Scalar, x: Array, state: State) -> Array:
            return flows.piece(a, b, x, state, dfx.SaveAt(t1=True))[0]

        return self.rows(lambda *args: dense_jacobian(last, self, *args), begin, end, x)

    def paths(self, begin: Array, end: Array, x: Array, samples: int = SAMPLES) -> tuple[Array, Array]:
        """Times and states along every arc."""

        def along(a: Scalar, b: Scalar, x: Array, state: State) -> tuple[Array, Array]:
            ts = jnp.linspace(a, b, samples)
            return ts, self.piece(a, b, x, state, dfx.SaveAt(ts=ts))

        ts, xs = self.rows(along, begin, end, x)
        return ts.reshape(len(begin), -1), xs.reshape(len(begin), -1, x.shape[-1])

    def derivatives(self, begin: Array, end: Array, x: Array) -> tuple[Array, Float[Array, "rows pieces n n"]]:
        """The ends of all pieces, and their derivatives by the beginnings."""

        def one(a: Scalar, b: Scalar, x: Array, state: State) -> tuple[Array, Array]:
            def last(x: Array) -> tuple[Array, Array]:
                (end,) = self.piece(a, b, x, state, dfx.SaveAt(t1=True))
                return end, end

            phi, end = jax.jacfwd(last, has_aux=True)(x)
            return end, phi

        return self.rows(one, begin, end, x)

    def at(self, times: Array, begin: Array, end: Array, x: Array) -> Float[Array, "times n"]:
        """States at given times of the orbit."""
        starts = (
            begin[:, None] + (end - begin)[:, None] * jnp.arange(self.pieces, dtype=end.dtype) / self.pieces
        ).ravel()

        def one(t: Scalar) -> Array:
            i = jnp.maximum(jnp.searchsorted(starts, t, side="right") - 1, 0)
            state = jax.tree.map(lambda s: s[i // self.pieces], self.within)
            return self.piece(starts[i], t, x.reshape(-1, x.shape[-1])[i], state, dfx.SaveAt(t1=True))[0]

        return jax.vmap(one)(times)


def flows_of(
    system: System, arcs: Arcs, how: tuple[tuple[str, Any], ...]
) -> tuple[Flows, Float[Array, "arcs pieces n"]]:
    """The flows along the arcs of an orbit, and the states at the beginnings of their pieces."""
    y0, first = (jax.tree.map(lambda y, i=i: y[i], arcs.y) for i in ((0, 0), (slice(None), 0)))
    model = model_of(system, arcs.begin[0], y0)
    within = jax.vmap(lambda t, y, mode: states(model, t, y, tuple(mode)))(arcs.begin, first, arcs.mode)
    x = jax.vmap(jax.vmap(lambda y: jfu.ravel_pytree(y)[0]))(arcs.y)
    return Flows(system, within, arcs.begin[0], y0, x.shape[1], how), x


@eqx.filter_jit
def path_of(system: System, arcs: Arcs, samples: int, how: tuple[tuple[str, Any], ...]) -> Path:
    """States along the arcs."""
    flows, x = flows_of(system, arcs, how)
    ts, xs = flows.paths(arcs.begin, arcs.end, x, samples)
    return Path(ts, jax.vmap(jax.vmap(jfu.ravel_pytree(flows.y0)[1]))(xs), arcs.mode)
