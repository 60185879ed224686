"""Steps by Taylor series: the solution's own coefficients, those of the multipliers, and those of every guard."""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._numerics._bernstein import binomials
from ..._numerics._linalg import row, WRITTEN_OUT
from ..._numerics._select import select
from ..._numerics._series import Coefficient, Series
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._sliding import linearised, multipliers
from ._stepper import jittered, Step, Stepper, unresolved, Watched, with_multipliers


class _Polynomial(dfx.AbstractLocalInterpolation):
    """The series of a step as dense output: y0 + Σ k_i u^i with u from 0 to 1."""

    t0: Scalar
    t1: Scalar
    y0: Y
    k: list[Y]

    def evaluate(self, t0: Scalar, t1: Scalar | None = None, left: bool = True) -> Y:
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        u = (t0 - self.t0) / select(self.t1 == self.t0, 1, self.t1 - self.t0)
        return _sum(self.y0, [jax.tree.map(lambda x, i=i: x * u ** (i + 1), k) for i, k in enumerate(self.k)])


class Taylor(dfx.AbstractAdaptiveSolver):
    """A diffrax solver by the Taylor series of the solution, whose coefficients come from the vector field's program.

    With many terms the steps are long, of the order of the solution's own time scale. Made for smooth fields and for
    tolerances below 1e-6. In `nsjax.solve` events are the roots of the series of h, and the length of a step is known
    before it is made, from the last coefficients; of a `diffrax.PIDController` only tolerances and `dtmax` matter.

    **Arguments:**

    - `terms`: the number of terms after the first, at least 4. 12 to 20 suit double precision, 8 single precision.

    **Raises:** `TypeError` on use, naming the operation, if the field or a surface contains one whose series is not
    known (loops, `lax.cond`, linear solves with a matrix that depends on the state).
    """

    terms: int = eqx.field(static=True, default=16)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., dfx.AbstractLocalInterpolation]] = _Polynomial

    def __check_init__(self) -> None:
        if not isinstance(self.terms, int) or self.terms < 4:
            raise ValueError(f"Argument `terms` must be an integer, at least 4, but got {self.terms!r}.")

    def order(self, terms: Any) -> int:
        return self.terms

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        del solver_state, made_jump
        leaves, tree = jax.tree.flatten(y0)

        def field(t: Scalar, *leaves: Array) -> list[Array]:
            return jax.tree.leaves(terms.vf(t, jax.tree.unflatten(tree, leaves), args))

        series, _ = _expand(field, jnp.asarray(t0, jnp.result_type(*leaves)), leaves, [], lambda r: [], self.terms)
        ks = _increments(series, tree, _powers(jnp.asarray(t1 - t0), self.terms))
        y1 = _sum(y0, ks)
        error = _error(ks, terms.vf_prod(t1, y1, args, terms.contr(t0, t1)))
        return y1, error, dict(y0=y0, k=ks), None, dfx.RESULTS.successful


def _sum(y: Y, ks: list[Y]) -> Y:
    """y + Σ k, the smallest first."""
    return jax.tree.map(lambda x, *k: x + ft.reduce(lambda a, b: a + b, k[::-1]), y, *ks)


def _error(ks: list[Y], last: Y) -> Y:
    """The last term, and how far the polynomial is from solving the equation at its end.

    A series says nothing of a kink in the field that lies ahead; `last`, the field at the end times the length of the
    step, does. Its weight keeps the defect of a smooth solution below the last term.
    """

    def leaf(f: Array, *k: Array) -> Array:
        slope = ft.reduce(lambda a, b: a + b, [(i + 1) * x for i, x in enumerate(k)][::-1])
        return jnp.abs(k[-1]) + 0.1 * jnp.abs(f - slope)

    return jax.tree.map(leaf, last, *ks)


def _expand(
    fn: Callable[..., list[Array]],
    t: Scalar,
    leaves: list[Array],
    multipliers: list[Scalar],
    correct: Callable[[list[Coefficient]], list[Coefficient]],
    terms: int,
) -> tuple[list[list[Coefficient]], list[list[Coefficient]]]:
    """Coefficients of the state's leaves, up to number `terms`, and of the multipliers, one less.

    `fn(t, *leaves, *multipliers)` gives the field and the rates of what the multipliers hold. These are zero in every
    order: `correct` turns the coefficients that they have without the multiplier's own into that.
    """
    series = Series(fn, t, *leaves, *multipliers)
    ys: list[list[Coefficient]] = [[x] for x in leaves]
    sigma: list[list[Coefficient]] = [[s] for s in multipliers]
    for k in range(terms):
        time = _time(t, k)
        now = [y[k] for y in ys]
        if k and sigma:
            out = series.step(k, time, *now, *[None] * len(sigma))
            for s, c in zip(sigma, correct(out[len(ys) :]), strict=True):
                s.append(c)
        out = series.step(k, time, *now, *[s[k] for s in sigma])
        for y, f in zip(ys, out):
            y.append(None if f is None else f / (k + 1.0))
    return ys, sigma


def _time(t: Scalar, k: int) -> Coefficient:
    """The k-th Taylor coefficient of time itself."""
    return t if k == 0 else jnp.ones_like(t) if k == 1 else None


def _increments(ys: list[list[Coefficient]], tree: Any, powers: list[Scalar]) -> list[Y]:
    """The terms of the series at the time of which these are the powers, as states."""
    return [
        jax.tree.unflatten(tree, [jnp.zeros_like(y[0]) if (c := y[i]) is None else c * power for y in ys])
        for i, power in enumerate(powers)
        if i
    ]


def _powers(x: Scalar, n: int) -> list[Scalar]:
    out = [jnp.ones_like(x), x]
    for i in range(2, n + 1):
        out.append(out[i // 2] * out[i - i // 2])
    return out


@ft.lru_cache
def _from_powers(degree: int) -> np.ndarray:
    """Matrix from power coefficients on [0, 1] to Bernstein coefficients, exact apart from rounding."""
    return np.array([[math.comb(j, i) / math.comb(degree, i) for i in range(degree + 1)] for j in range(degree + 1)])


class TaylorStepper(Stepper):
    """Steps of `Taylor` in a mode, whose dense output is the solution itself."""

    solver: Taylor
    degree: int = eqx.field(static=True)
    group: ClassVar[int] = 64  # more, as of its long steps one in four ends in an event

    def __init__(self, solver: Taylor):
        self.solver = solver
        self.degree = solver.terms

    def __call__(
        self, model: SwitchedSystem, state: ModeState, t: Scalar, t_next: Scalar, y: Y, f0: Y, watch: Watched = None
    ) -> Step:
        leaves, tree = jax.tree.flatten(y)
        which = model.holdable
        s = model.values(t, y, state)
        inverse: Any = []
        blocks = model.coupling.block_of
        if which:
            held = row([model.held(k, state.mode[k]) for k in which])
            # In every order the unknown coefficient of λ is multiplied by the matrix at the start alone: one inverse
            # serves for all orders, where solving anew would take as many linear systems as there are terms. Of each
            # block the columns of its first member, of its second, and so on.
            slope, size = linearised(model, t, y, state, s).slope, max(map(len, blocks))
            units = np.array([[block[n : n + 1] == (i,) for i, block in enumerate(blocks)] for n in range(size)])
            solve = ft.partial(multipliers, model, slope)
            if size > WRITTEN_OUT:
                inverse = jax.vmap(solve, in_axes=(0, None))(jnp.asarray(units, t.dtype), held)
            else:
                inverse = [solve(row(list(jnp.asarray(unit, t.dtype))), held) for unit in units]

        def fn(t: Scalar, *args: Array) -> list[Array]:
            y, s = jax.tree.unflatten(tree, args[: len(leaves)]), self.values(model, state, t, args[len(leaves) :])
            rates = model.rates(which, t, y, state, s) if which else ()
            return [*jax.tree.leaves(model.field(t, y, s)), *rates]

        def correct(rates: list[Coefficient]) -> list[Coefficient]:
            rows = [
                [inverse[n][i] * r for n, j in enumerate(block) if (r := rates[j]) is not None]
                for i, block in enumerate(blocks)
            ]
            return [-ft.reduce(lambda a, b: a + b, row) if row else None for row in rows]

        ys, sigma = _expand(fn, t, leaves, [s[k] for k in which], correct, self.degree)
        columns = []
        if watch is not None:
            tolerance = _tolerance(watch.controller)
            if tolerance is not None:
                t_next = jnp.minimum(t_next, t + lax.stop_gradient(_reach(ys, *tolerance)))
            columns = self.guard_series(model, state, t, tree, ys, sigma) if model.slots else []
            curved = [c for row, affine in zip(columns, watch.affine) for c in row if not affine]
            if curved:
                # A step that is not shortened ends where it was to end, whatever its beginning depends on.
                share = lax.stop_gradient(_resolvable(curved, t_next - t))
                t_next = select(share < 1, t + lax.stop_gradient(share * (t_next - t)), t_next)
        powers = _powers(t_next - t, self.degree)
        ks = _increments(ys, tree, powers)
        y1 = _sum(y, ks)
        slope = model.flow(t_next, y1, state)
        guards = [[[c * power for c, power in zip(part, powers)] for part in row] for row in columns]
        near = jittered(model, state, t, y) if guards else []
        noise = [[jnp.abs(n - c[0]) for n, c in zip(*rows)] for rows in zip(near, guards)]
        resolved = jnp.ones((), bool)
        if watch is not None and not all(watch.affine):
            # A kink within the step is seen at its end.
            for parts, ends, affine in zip(guards, model.guards(t_next, y1, state), watch.affine):
                for c, end in zip(parts, () if affine else ends):
                    resolved = resolved & (jnp.abs(sum(c[::-1]) - end) <= unresolved(t.dtype) * _size(c))
        last = jax.tree.map(lambda f: (t_next - t) * f, slope)
        return Step(t_next, y1, _error(ks, last), ks, slope, guards, with_multipliers(model, noise), resolved)

    def guard_series(
        self, model: SwitchedSystem, state: ModeState, t: Scalar, tree: Any, ys: list[list[Any]], sigma: list[list[Any]]
    ) -> list[list[list[Scalar]]]:
        """Taylor coefficients `[slot][part][j]` of the guards."""

        def fn(t: Scalar, *args: Array) -> list[list[Scalar]]:
            y, s = jax.tree.unflatten(tree, args[: len(ys)]), self.values(model, state, t, args[len(ys) :])
            return model.guards(t, y, state, s=s)

        first = [c[0] for c in (*ys, *sigma)]
        series = Series(lambda *args: jax.tree.leaves(fn(*args)), t, *first)
        known = [*ys, *[[*c, None] for c in sigma]]
        terms = [series.step(k, _time(t, k), *[c[k] for c in known]) for k in range(self.degree + 1)]
        columns = iter(zip(*terms))
        return [
            [[jnp.zeros_like(t) if c is None else c for c in next(columns)] for _ in row]
            for row in jax.eval_shape(fn, t, *first)
        ]

    def values(self, model: SwitchedSystem, state: ModeState, t: Scalar, multipliers: Any) -> tuple[Any, ...]:
        """Switch values of a mode, where the multipliers are known."""
        s = list(model.signs(t, state))
        for k, multiplier in zip(model.holdable, multipliers, strict=True):
            s[k] = select(model.held(k, state.mode[k]), multiplier, s[k])
        return tuple(s)

    def pace(self, controller: Any, step: Step, t: Scalar, y: Y, length: Scalar) -> Any:
        tolerance = _tolerance(controller)
        if tolerance is None:
            return None
        rtol, atol = tolerance
        errors = jax.tree.map(lambda e, y: jnp.max(e / (atol + rtol * jnp.abs(y))), step.error, y)
        keep = ft.reduce(jnp.maximum, jax.tree.leaves(errors)) <= 1
        most = getattr(controller, "dtmax", None)
        return keep, select(keep, length if most is None else most, 0.5 * (step.t_next - t))

    def estimate(self, step: Step) -> Y:
        return step.ks[-1]  # not its error, of which the absolute value has no derivative where it is zero

    def least(self, c: list[Scalar], roots: Int[Array, ""]) -> Scalar:
        # Bernstein coefficients of the first terms; all that follow are at least minus their sum times u^n, which is
        # the last basis polynomial.
        n = min(6, len(c) - 1)
        low = [_dot(row, c[: n + 1]) for row in _from_powers(n)]
        low[-1] -= sum(map(jnp.abs, c[:n:-1]), jnp.zeros_like(low[-1]))
        return super().least(low, roots)

    def end(self, c: list[Scalar]) -> tuple[Scalar, Scalar]:
        return sum(c[-2::-1], c[-1]), sum((j * x for j, x in reversed([*enumerate(c)])), jnp.zeros_like(c[0]))

    def scaled(self, model: SwitchedSystem, guards: list[list[list[Scalar]]]) -> list[Float[Array, "slots parts"]]:
        powers = model.stacked([[jnp.stack(c) for c in row] for row in guards], -1.0)
        matrix = _from_powers(self.degree) * np.array(binomials(self.degree))[:, None]
        return list(jnp.tensordot(jnp.asarray(matrix, powers.dtype), powers, axes=(1, 2)))

    def points(self, y: Y, y1: Y, ks: list[Y]) -> list[Y]:
        matrix = _from_powers(self.degree)
        points = [_sum(y, [jax.tree.map(lambda x, w=w: w * x, k) for w, k in zip(r[1:], ks)]) for r in matrix[1:-1]]
        return [y, *points, y1]


def _dot(weights: Float[np.ndarray, " n"], c: list[Scalar]) -> Scalar:
    return ft.reduce(lambda a, b: a + b, [float(w) * x if w != 1 else x for w, x in zip(weights, c) if w][::-1])


def _tolerance(controller: Any) -> tuple[Any, Any] | None:
    """The relative and the absolute tolerance of a controller, if it has such."""
    pair = getattr(controller, "rtol", None), getattr(controller, "atol", None)
    return None if pair[0] is None or pair[1] is None else pair


def _reach(ys: list[list[Coefficient]], rtol: Any, atol: Any) -> Scalar:
    """How far the last two terms of the series stay below the tolerance."""
    leaves = [y[0] for y in ys if y[0] is not None]
    scales = [atol + rtol * jnp.abs(y) for y in leaves]
    log = jnp.full((), jnp.inf, jnp.result_type(*leaves))
    for i in (len(ys[0]) - 2, len(ys[0]) - 1):
        sizes = [jnp.max(jnp.abs(y[i]) / scale) for y, scale in zip(ys, scales) if y[i] is not None]
        if sizes:
            size = ft.reduce(jnp.maximum, sizes)
            log = jnp.minimum(log, select(size == 0, jnp.inf, -jnp.log(select(size == 0, 1, size)) / i))
    return 0.9 * jnp.exp(select(jnp.isnan(log), jnp.inf, log))  # a step to where the field is NaN is rejected later


def _size(c: list[Scalar]) -> Scalar:
    return ft.reduce(jnp.maximum, map(jnp.abs, c))


def _resolvable(columns: list[list[Scalar]], dt: Scalar) -> Scalar:
    """On which share of `dt` polynomials of this degree can stand for these functions."""
    n = len(columns[0]) - 1
    fit = jnp.ones_like(dt)
    for c in columns:
        c = [x * power for x, power in zip(c, _powers(dt, n))]
        ratio = 0.5 * unresolved(dt.dtype) * _size(c) / _size(c[-3:])
        fit = jnp.minimum(fit, select(ratio < 1, ratio, 1) ** (1 / n))
    return fit
