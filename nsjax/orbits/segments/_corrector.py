"""The corrector: Newton's method on the equations of all segments, and the derivatives of what it finds."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._lapack import solve
from ..._numerics._root import Newton
from ..._numerics._select import select
from ..._types import Scalar
from ._equations import OrbitCurve
from ._itinerary import OrbitItinerary


class Plane(NamedTuple):
    """Where a point of a curve is looked for: at a `distance` from `origin` along `normal`. (Of a surface, at several
    distances along as many directions.)"""

    origin: Any
    normal: Any
    distance: Any = 0.0

    def filled(self) -> "Plane":
        """The same with one distance for each direction."""
        shape = np.shape(self.normal)[:-1]
        return self._replace(distance=np.broadcast_to(np.asarray(self.distance, float), shape))


class Linear(NamedTuple):
    """The equations and the states at the ends of the segments; the derivatives of the equations, and of the time at
    which the last segment ends."""

    f: Array
    last: Array
    df: Array
    closing: Array


class Turn(NamedTuple):
    """Of Newton's method: where it is, and where it goes next."""

    u: Array
    next: Array
    linear: Linear  # at u
    ended: Bool[Array, ""]  # whether `next` is where it ends
    good: Bool[Array, ""]
    over: Bool[Array, ""]  # whether u is
    spoilt: Bool[Array, ""]  # whether derivatives were none on the way
    count: Array


def newton_turns(
    curve: OrbitCurve,
    itinerary: OrbitItinerary,
    plane: Plane,
    guess: Array,
    method: Newton,
    newton: Array | bool = True,
) -> Turn:
    """The turns of Newton's method up to a point of the curve on a plane; without `newton` one, at the guess."""
    origin, border, distance = plane
    m = curve.dimension

    def turn(c: Turn) -> Turn:
        u, linear = c.next, linear_at(curve, itinerary, c.next, origin)
        off = jnp.append(linear.f, border @ (u - origin) - distance)
        step = method.step(u, off, jnp.concatenate([linear.df, jnp.atleast_2d(border)]))
        new, ended, good = (select(c.ended, old, now) for old, now in zip((u, True, c.good), step))
        spoilt = c.spoilt | curve.spoilt(linear.f, linear.df)
        return Turn(u, new, linear, ended, good, over=c.ended, spoilt=spoilt, count=c.count + 1)

    # The last turn has the derivatives at the root, which all that is seen of it begins with: so the equations stand
    # in the program once.
    size, rows, n = len(guess), len(itinerary.slot), len(curve.sizes)
    blank = Linear(*(jnp.zeros(shape, guess.dtype) for shape in ((size - m,), (rows, n), (size - m, size), (size,))))
    ended, no, none = ~jnp.asarray(newton), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    first = Turn(guess, guess, blank, ended, good=no, over=no, spoilt=no, count=none)
    return lax.while_loop(lambda c: ~c.over & (c.count <= method.max_steps), turn, first)


def linear_at(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, origin: Array) -> Linear:
    def equations(u: Array) -> tuple[tuple[Array, Scalar], tuple[Array, Array]]:
        f, arrival, last = curve.residual(u, itinerary, origin)
        return (f, arrival), (f, last)

    (df, closing), (f, last) = jax.jacfwd(equations, has_aux=True)(u)
    return Linear(f, last, df, closing)


def isolated_orbit(
    curve: OrbitCurve, itinerary: OrbitItinerary, origin: Array, guess: Array, method: Newton
) -> tuple[Array, Linear, Bool[Array, ""]]:
    """The orbit where no parameter varies and the curve is a point: the unknowns, the equations there, and whether
    Newton's method has converged.

    Derivatives by the model and by the time at which the orbit begins, of every order, are those of the implicit
    function; they are NaN where there is no orbit, or where it is not regular.
    """
    still, at = frozen((curve, origin))
    plane = Plane(at, jnp.zeros((0, len(guess)), guess.dtype), jnp.zeros(0, guess.dtype))
    found = newton_turns(still, itinerary, plane, frozen(guess), method)
    u, linear = _at_root(frozen((found.u, found.linear)), curve, itinerary, origin, found.good)
    return u, linear, found.good


@eqx.filter_custom_jvp
def _at_root(root: Any, curve: Any, itinerary: Any, origin: Any, regular: Any) -> tuple[Array, Linear]:
    return root


@_at_root.def_jvp
def _at_root_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    root, curve, itinerary, origin, regular = primals
    _, dcurve, _, dorigin, _ = tangents
    u, linear = _at_root(root, curve, itinerary, origin, regular)

    def equations(curve: OrbitCurve, origin: Array) -> Array:
        return curve.residual(u, itinerary, origin)[0]

    def linearised(u: Array, curve: OrbitCurve, origin: Array) -> Linear:
        return linear_at(curve, itinerary, u, origin)

    df = eqx.filter_jvp(equations, (curve, origin), (dcurve, dorigin))[1]
    df = jnp.zeros_like(u) if df is None else df
    move = solve(linear.df, -df)
    move = select(regular, move, jnp.nan)
    return (u, linear), (move, eqx.filter_jvp(linearised, (u, curve, origin), (move, dcurve, dorigin))[1])
