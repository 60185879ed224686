"""Steps by the matrix exponential: the exact flow of fields that are affine in the state."""

import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._numerics._barrier import once
from ..._numerics._bernstein import nodes, to_bernstein, to_chebyshev
from ..._numerics._jaxpr import is_affine, is_constant
from ..._numerics._linalg import product
from ..._numerics._select import select
from ..._numerics._time_dependence import Forcing, forcing, time_dependence
from ..._types import Scalar, Y
from ...system._mode import ModeState, put
from ...system._model import SwitchedSystem
from ._stepper import bernstein, jittered, stack, Step, Stepper, unresolved, Watched, with_multipliers


_N = 10  # number of equal parts at which a step is sampled; the polynomial through them is its dense output
_TERMS = 16  # of the series of the exponential, for arguments up to `_NEAR`
_NEAR = 0.75

Flat = Float[Array, " d"]
Square = Float[Array, "m m"]


class _Samples(dfx.AbstractLocalInterpolation):
    """The polynomial through states at equal distances."""

    t0: Scalar
    t1: Scalar
    y0: Y
    points: Y  # its control points

    def evaluate(self, t0: Scalar, t1: Scalar | None = None, left: bool = True) -> Y:
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        return bernstein(self.points, (t0 - self.t0) / select(self.t1 == self.t0, 1, self.t1 - self.t0))


class AbstractExponential(dfx.AbstractAdaptiveSolver):
    """What the solvers by the matrix exponential have in common: one step in one mode."""

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., dfx.AbstractLocalInterpolation]] = _Samples

    def order(self, terms: Any) -> int:
        return _N

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        del solver_state, made_jump

        def field(t: Scalar, y: Y) -> Y:
            return terms.vf(t, y, args)

        t0 = jnp.asarray(t0, jnp.result_type(*jax.tree.leaves(y0)))
        _check_affine(field, t0, y0, "the vector field")
        timed = _known(forcing(time_dependence(lambda t: field(t, y0), t0).results), "the vector field")
        ys, error, _ = _sampled(field, t0, jnp.asarray(t1 - t0, t0.dtype), y0, field(t0, y0), timed)
        y1 = ys[-1]
        return y1, error, dict(y0=y0, points=stack(_control_points(ys))), None, dfx.RESULTS.successful


class Exponential(AbstractExponential):
    """A diffrax solver by the matrix exponential, for fields affine in the state, with forcing that is constant,
    linear or quadratic in time, harmonic (of one frequency) or exponential.

    A step is exact apart from rounding, whatever its length: also for defective and singular matrices, in resonance,
    for sliding modes, and for stiff modes once they have decayed. Its length is only what a polynomial of degree 10 can
    stand for, which is where events are looked for and what dense output is made of, to about 1e-11 of the state's
    size along the step (1e-5 in single precision). In `nsjax.solve` tolerances play no role; of a
    `diffrax.PIDController` only `dtmax` matters.

    **Raises:** `ValueError` on use if the field is not affine in the state, or its matrix depends on time.
    `nsjax.solve` ends with `RESULTS.mode_not_affine` where it meets forcing of another kind (two frequencies), or
    begins to slide, stick or rest where the field that does so is not affine (curved surfaces, friction by a contact
    force).
    """


class Affine(AbstractExponential):
    """`Exponential`, and for models with `sgn` switches, impacts and relays the flow from event to event in one step.

    The guards on an arc are polynomials, made once for each mode that a lane comes to, which only find the event; its
    time and the state are those of the exact flow. Events at which there is nothing to choose are worked out for all
    lanes of a batch at once. Whatever is not plainly so (events at one instant, accumulating impacts, contacts that
    lift off, tangencies, ends on a surface) is left to the general loop. So are models with clocks or resets of their
    own, or in which one switch that can hold the solution acts on the surface of another one (friction and a wall on
    one body), for which this is `Exponential`. Stops and springs, of any number of components, are taken for switches
    that are only crossed: where one holds after all, the general loop has it. Tolerances play no role.

    It is the default of `nsjax.sweep` for such models, see `nsjax.method_for`. A sweep that is called directly compiles
    a small program of the plain events first, and one that holds the general loop as well only if some lanes need it.
    Everywhere else there is only the second program, which takes longer to compile than that of any other solver.
    Sweeps of small systems take a tenth to a twenty-fifth of the time of `Exponential`.
    """


def affine_parts(field: Callable[[Scalar, Y], Y], t: Scalar, y: Y) -> tuple[bool, bool]:
    """Whether a field is affine in the state, and whether its matrix is constant in time."""
    dy = jax.tree.map(jnp.ones_like, y)
    return is_affine(lambda y: field(t, y), y), is_constant(lambda t: jax.jvp(lambda y: field(t, y), (y,), (dy,))[1], t)


def _check_affine(field: Callable[[Scalar, Y], Y], t: Scalar, y: Y, name: str) -> None:
    affine, constant = affine_parts(field, t, y)
    if not affine:
        raise ValueError(
            f"`Exponential` needs a field that is affine in the state, but {name} is not. Take `nsjax.Taylor()` or a "
            "Runge-Kutta solver."
        )
    if not constant:
        raise ValueError(
            f"`Exponential` needs a field whose matrix ∂f/∂y is constant, but that of {name} depends on time "
            "(parametric excitation). Take `nsjax.Taylor()` or a Runge-Kutta solver."
        )


def forcing_of(model: SwitchedSystem, t: Scalar, y: Y) -> Forcing | None:
    """What depends on time in field and surfaces between the times at which they jump; None if that is nothing which
    the exponential stands for."""
    system, dtype = model.system, t.dtype
    zeros, ones = (tuple(f((), dtype) for _ in model.switches) for f in (jnp.zeros, jnp.ones))
    units = [put(zeros, (k,), (ones[k],)) for k in range(len(zeros))]

    def program(t: Scalar) -> Any:  # in the time of the user, which is not kept between ticks
        fields = [system.vector_field(t, y, system.values(s)) for s in (zeros, *units, ones)]
        return fields, [switch.surfaces(system, t, y) for switch in model.switches]

    return forcing(time_dependence(program, t).results)


def _known(timed: Forcing | None, name: str) -> Forcing:
    if timed is None:
        raise ValueError(
            "`Exponential` needs forcing that is constant, linear or quadratic in time, exponential, or harmonic of "
            f"one frequency (which is one number in the program), but that of {name} is not. Take `nsjax.Taylor()` or "
            "a Runge-Kutta solver."
        )
    return timed


def generator(
    field: Callable[[Scalar, Flat], Flat], t: Scalar, x: Flat, f: Flat, dt: Scalar, timed: Forcing
) -> tuple[Square, Scalar]:
    """The matrix M of a linear system z' = M z with time in units of `dt`, whose first components times the second
    result are x(t + τ) - x(t), from z = (0, 1) or (0, 1, 0, 0). `timed`: what depends on time.

    With b the forcing, b''' = -ω² b' for all of the kinds that are allowed, so that
    b(t + τ) - b(t) = b' S(τ) + b'' C(τ), where S' = 1 - ω² C, C' = S: sin(ωτ)/ω and (1 - cos ωτ)/ω².
    """
    matrix = dt * jax.jacfwd(field, argnums=1)(t, x)
    columns = [dt * f]
    clock = jnp.zeros((1, 1), t.dtype)
    if not timed.constant:
        one, zero = jnp.ones_like(t), jnp.zeros_like(t)

        def rate(t: Scalar) -> Flat:
            return jax.jvp(lambda t: field(t, x), (t,), (one,))[1]

        b1, b2 = jax.jvp(rate, (t,), (one,))
        columns += [dt**2 * b1, dt**3 * b2]
        clock = [[zero] * 3, [one, zero, -timed.squared * dt**2], [zero, one, zero]]
        clock = jnp.stack([jnp.stack(row) for row in clock])
    right = jnp.stack(columns, axis=1)
    scale = lax.stop_gradient(_largest([_largest(column) for column in columns]))
    scale = select(scale > 0, scale, 1)
    below = jnp.zeros((len(columns), len(x)), t.dtype)
    return jnp.block([[matrix, right / scale], [below, clock]]), scale


def _largest(rows: Any) -> Any:
    """The largest absolute value among the rows. (XLA's code for the maximum along an axis takes as long as a step.)"""
    return ft.reduce(jnp.maximum, [jnp.abs(row) for row in rows])


def expm(m: Square) -> Square:
    """The matrix exponential by its series, scaled and squared.

    How often is decided by the norms of powers, which for matrices far from normal (a stiff spring: entries 1 and k,
    eigenvalues √k) are much less than powers of the norm. (`jax.scipy.linalg.expm` gives NaN for norms above 4e5, and
    under `vmap` computes all of its five approximants.)
    """
    dtype = m.dtype
    m2 = product(m, m)
    m3, m4 = product(m2, m), product(m2, m2)

    def norm(p: Square) -> Scalar:
        return _largest([sum(jnp.abs(x) for x in column) for column in lax.stop_gradient(p).T])

    size = jnp.maximum(norm(m2) ** (1 / 2), norm(m3) ** (1 / 3)) / _NEAR
    halvings = jnp.ceil(jnp.log2(select((size > 1) & jnp.isfinite(size), size, 1)))
    shrink = jnp.exp2(-halvings)
    powers = [jnp.eye(len(m), dtype=dtype), m * shrink, m2 * shrink**2, m3 * shrink**3]
    m4 = m4 * shrink**4
    weights = np.cumprod([1.0, *(1.0 / np.arange(1, _TERMS + 1))])
    total = float(weights[_TERMS]) * m4
    for k in range(_TERMS - 4, -1, -4):
        block = sum((float(w) * p for w, p in zip(weights[k : k + 4], powers)), jnp.zeros_like(m))
        total = block + total if k == _TERMS - 4 else block + product(m4, total)
    count = halvings.astype(jnp.int32)
    start = (jnp.zeros_like(count), total)
    return lax.while_loop(lambda c: c[0] < count, lambda c: (c[0] + 1, product(c[1], c[1])), start)[1]


def _sampled(
    field: Callable[[Scalar, Y], Y], t: Scalar, dt: Scalar, y: Y, f: Y, timed: Forcing
) -> tuple[list[Y], Y, Scalar]:
    """The states at equal parts of a step, both ends included; what a polynomial through them misses, and how many
    times what may be missed that is. `timed`: see `generator`."""
    x, unravel = jfu.ravel_pytree(y)

    def flat(t: Scalar, x: Flat) -> Flat:
        return jfu.ravel_pytree(field(t, unravel(x)))[0]

    m, scale = generator(flat, t, x, jfu.ravel_pytree(f)[0], dt, timed)
    half = expm(m / (2 * _N))
    whole = half @ half
    z = [jnp.zeros(len(m), x.dtype).at[len(x)].set(1)]
    for _ in range(_N):
        z.append(whole @ z[-1])
    moves = scale * jnp.stack(z)[:, : len(x)]
    between = scale * (half @ z[_N // 2])[: len(x)]
    # What the polynomial misses is judged by its last coefficients, and by a point between the samples, where a fast
    # oscillation may hide from them. Rounding is left out.
    frozen, eps = lax.stop_gradient(moves), float(jnp.finfo(x.dtype).eps)
    chebyshev = to_chebyshev(_N, even=True)
    halfway = np.polynomial.chebyshev.chebvander([1 / _N], _N)[0] @ chebyshev
    tail = _largest(jnp.asarray(chebyshev[-2:], x.dtype) @ frozen)
    missed = jnp.abs(jnp.asarray(halfway, x.dtype) @ frozen - lax.stop_gradient(between))
    size = _largest(lax.stop_gradient(x) + frozen)
    terms = lax.stop_gradient(jnp.abs(whole) @ _largest(z))[: len(x)] * jnp.abs(scale)
    allowed = max(1e-9, 1e4 * eps) * size + 64 * _N * eps * (terms + size)
    error = jnp.maximum(tail, 100 * missed)
    excess = once(_largest(error / select(allowed > 0, allowed, 1)))
    return [unravel(x + move) for move in moves], unravel(error), excess


def _control_points(ys: list[Y]) -> list[Y]:
    matrix = to_bernstein(_N, even=True)

    def combined(row: np.ndarray) -> Y:
        def leaf(*xs: Array) -> Array:
            return xs[0] + sum(float(w) * (x - xs[0]) for w, x in zip(row[1:], xs[1:]))

        return jax.tree.map(leaf, *ys)

    return [ys[0], *[once(combined(row)) for row in matrix[1:-1]], ys[-1]]


class ExponentialStepper(Stepper):
    """Steps of `Exponential` in a mode."""

    exact: ClassVar[bool] = True
    solver: Exponential
    timed: Forcing | None = None  # what depends on time, once it is made for a model
    slides: bool = eqx.field(static=True, default=True)  # whether the modes that hold are affine too
    degree: int = eqx.field(static=True, default=_N)

    def made_for(self, model: SwitchedSystem, state: ModeState, t: Scalar, y: Y) -> "ExponentialStepper":
        s, owner = model.signs(t, state), f"`{type(model.system.owner).__name__}`"
        _check_affine(lambda t, y: model.field(t, y, s), t, y, owner)
        slides = all(affine_parts(lambda t, y: model.flow(t, y, state), t, y))
        return ExponentialStepper(self.solver, _known(forcing_of(model, t, y), owner), slides)

    def __call__(
        self, model: SwitchedSystem, state: ModeState, t: Scalar, t_next: Scalar, y: Y, f0: Y, watch: Watched = None
    ) -> Step:
        ys, _, excess = _sampled(lambda t, y: model.flow(t, y, state), t, t_next - t, y, f0, _known(self.timed, ""))
        fits: Bool[Array, ""] | bool = True
        if not self.slides:
            fits = ~ft.reduce(jnp.logical_or, [model.held(k, state.mode[k]) for k in model.holdable])
        step = Step(t_next, ys[-1], excess, ys, fits=fits)
        if watch is None or not model.slots:
            return step
        ts = t + (t_next - t) * jnp.asarray(nodes(_N, even=True), t.dtype)
        batch = jax.vmap(lambda t, y: model.guards(t, y, state))(ts, stack(ys))
        near = jittered(model, state, t, y)
        matrix = to_bernstein(_N, even=True)
        blur = float(np.abs(matrix).sum(axis=1).max()) * float(jnp.finfo(t.dtype).eps)
        finer = jnp.asarray(np.polynomial.chebyshev.chebvander(nodes(2 * _N, even=True) * 2 - 1, _N), t.dtype)
        finer = finer @ jnp.asarray(to_chebyshev(_N, even=True), t.dtype)
        last = jnp.asarray(to_chebyshev(_N, even=True)[-2:], t.dtype)
        guards: list[list[list[Scalar]]] = []
        noise: list[list[Scalar]] = []
        resolved = jnp.ones((), bool)
        for slot, row, others, known, affine in zip(model.slots, batch, near, model.known_roots(state), watch.affine):
            guards.append([list(jnp.asarray(matrix, t.dtype) @ values) for values in row])
            noise.append([jnp.abs(other - values[0]) for other, values in zip(others, row)])
            for values, slack, roots in zip(row, noise[-1], known):
                size, tail = _largest(values), _largest(last @ values)
                if not affine:
                    resolved = resolved & ~(tail > unresolved(t.dtype) * size + slack)
                # The error of the coefficients hides a near miss, and two roots close to each other, until the step is
                # so short that the guard is small all along.
                error, dense = once(blur * size + tail), list(finer @ values)
                sag = [jnp.abs(a - 2 * b + c) / 8 for a, b, c in zip(dense, dense[1:], dense[2:])]  # between points
                dips = [b - s for b, s in zip(dense, [sag[0], *sag, sag[-1]])]
                touches = (ft.reduce(jnp.minimum, dips) <= error) & (ft.reduce(jnp.minimum, dense) > -error)
                if slot.switch not in model.clocks:  # which have no near misses
                    resolved = resolved & ~(touches & (roots == 0) & (size > slack))
        resolved = once(select(resolved, 1.0, 0.0)) > 0
        return step._replace(guards=guards, noise=lax.stop_gradient(with_multipliers(model, noise)), resolved=resolved)

    def points(self, y: Y, y1: Y, ks: list[Y]) -> list[Y]:
        return _control_points(ks)

    def estimate(self, step: Step) -> None:
        return None

    def pace(self, controller: Any, step: Step, t: Scalar, y: Y, length: Scalar) -> Any:
        excess: Any = step.error
        keep = excess <= 1
        # What a polynomial misses grows with the power `_N` of the step.
        factor = 0.8 * select(excess > 0, excess, 1e-30) ** (-1 / _N)
        dt = (step.t_next - t) * jnp.clip(select(jnp.isnan(factor), 0.1, factor), 0.05, 10)
        most = getattr(controller, "dtmax", None)
        return keep, jnp.minimum(dt, length if most is None else most)
