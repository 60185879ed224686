"""One step of a diffrax solver in a fixed mode, and its dense output as Bernstein control points.

Explicit Runge-Kutta stages are unrolled from the solver's own tableau (diffrax loops over them, which costs several
times as much for small systems and under `jacfwd`); every other solver takes its own `step`.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._crossing import nodes, to_bernstein
from ._once import once
from ._types import Scalar, Y


Field = Callable[[Scalar, Y], Y]


def _combine(base: Any, terms: list[tuple[float, Any]]) -> Any:
    """base + Σ weight * tree, leaf by leaf, leaving out what is zero."""
    terms = [(w, k) for w, k in terms if w != 0]

    def leaf(x: Array, *ks: Array) -> Array:
        total = sum(w * k for (w, _), k in zip(terms, ks))
        return x + total

    return jax.tree.map(leaf, base, *[k for _, k in terms]) if terms else base


def _double() -> bool:
    return jnp.result_type(float) == jnp.float64


@ft.lru_cache
def _dense_weights(solver_type: type, stages: int, x64: bool) -> tuple[np.ndarray, int]:
    """Dense output at many nodes as weights on (y0, y1, k_1, ..., k_s), and its degree as a polynomial.

    Every Runge-Kutta dense output is linear in these, so that unit vectors put into the solver's interpolation give
    the weights.
    """
    many = 16
    unit = np.eye(2 + stages)
    with jax.ensure_compile_time_eval():
        kwargs = dict(t0=0.0, t1=1.0, y0=jnp.asarray(unit[0]), y1=jnp.asarray(unit[1]))
        if stages:
            kwargs["k"] = jnp.asarray(unit[2:])
        path = solver_type.interpolation_cls(**kwargs)
        values = np.stack([np.asarray(path.evaluate(jnp.asarray(u)), float) for u in nodes(many)])
    chebyshev = np.linalg.lstsq(np.polynomial.chebyshev.chebvander(2 * nodes(many) - 1, many), values, rcond=None)[0]
    size = np.abs(chebyshev).max(axis=1)
    noise = (1e-10 if x64 else 1e-4) * size.max()
    return values, int(np.flatnonzero(size > noise)[-1])


class Stepper(eqx.Module):
    """Takes steps with `solver`.

    `degree` is that of the dense output; `points(...)` gives its control points, `degree + 1` states whose Bernstein
    combination it is. For an affine h the Bernstein coefficients of h along the step are h at the control points.
    """

    solver: dfx.AbstractSolver
    degree: int = eqx.field(static=True)
    stages: int = eqx.field(static=True)

    def __init__(self, solver: dfx.AbstractSolver):
        if isinstance(solver, dfx.AbstractRungeKutta) and isinstance(solver.tableau, dfx.ButcherTableau):
            self.stages = solver.tableau.num_stages
        elif isinstance(solver, (dfx.Euler, dfx.ImplicitEuler)):
            self.stages = 0
        else:
            raise TypeError(
                "Argument `solver` must be a diffrax Runge-Kutta solver for ordinary differential equations (such as "
                f"Tsit5, Dopri5, Dopri8, Kvaerno5) or Euler, but got {solver!r}."
            )
        self.solver = solver
        self.degree = _dense_weights(type(solver), self.stages, _double())[1]

    def __call__(self, f: Field, t: Scalar, t_next: Scalar, y: Y, f0: Y) -> tuple[Y, Y | None, list[Y], Any]:
        """**Returns:** y at `t_next`, the error estimate (None if the method has none), the increments k, and
        diffrax's result (None when the step cannot fail)."""
        dt = t_next - t
        if isinstance(self.solver, dfx.AbstractERK):
            tableau = self.solver.tableau
            assert isinstance(tableau, dfx.ButcherTableau)
            scale = ft.partial(jax.tree.map, lambda k: once(dt * k))
            ks, stage = [scale(f0)], y
            for row, c in zip(tableau.a_lower, tableau.c):
                stage = _combine(y, list(zip(map(float, row), ks)))
                ks.append(scale(f(t_next if c == 1 else t + float(c) * dt, stage)))
            y1 = stage if tableau.ssal else _combine(y, list(zip(map(float, tableau.b_sol), ks)))
            error = _combine(jax.tree.map(jnp.zeros_like, y), list(zip(map(float, tableau.b_error), ks)))
            return y1, error, ks, None
        terms = dfx.ODETerm(lambda t, y, args: f(t, y))
        state = self.solver.init(terms, t, t_next, y, None)
        y1, error, dense, _, result = self.solver.step(terms, t, t_next, y, None, state, made_jump=True)
        ks = [jax.tree.map(lambda k, i=i: k[i], dense["k"]) for i in range(self.stages)]
        return y1, error, ks, result

    def last_slope(self, ks: list[Y], dt: Scalar, f: Field, t: Scalar, y: Y) -> Y:
        """f at the end of the step; free when the first stage of the next step is the last of this one."""
        if isinstance(self.solver, dfx.AbstractERK) and self.solver.tableau.fsal:  # pyright: ignore
            safe = jnp.where(dt == 0, 1, dt)
            return jax.tree.map(lambda k: k / safe, ks[-1])
        return f(t, y)

    def _weighted(self, matrix: np.ndarray, y: Y, y1: Y, ks: list[Y]) -> list[Y]:
        rows = []
        for row in matrix:
            row = np.where(np.abs(row) < 1e-14, 0.0, row)
            if row[1] == 1 and not row[2:].any():
                rows.append(y1)
                continue
            rise = jax.tree.map(lambda a, b: b - a, y, y1)
            rows.append(once(_combine(y, [(float(row[1]), rise)] + [(float(w), k) for w, k in zip(row[2:], ks)])))
        return rows

    def _values(self, at: np.ndarray) -> np.ndarray:
        weights, _ = _dense_weights(type(self.solver), self.stages, _double())
        many = len(weights) - 1
        # Interpolation from many nodes to the few asked for, exact for polynomials.
        vander = ft.partial(np.polynomial.chebyshev.chebvander, deg=self.degree)
        few = vander(2 * at - 1) @ np.linalg.lstsq(vander(2 * nodes(many) - 1), weights, rcond=None)[0]
        ends = np.eye(few.shape[1])[:2]
        few[at == 0], few[at == 1] = ends[0], ends[1]
        return few

    def points(self, y: Y, y1: Y, ks: list[Y]) -> list[Y]:
        """The `degree + 1` control points of the dense output."""
        return self._weighted(to_bernstein(self.degree) @ self._values(nodes(self.degree)), y, y1, ks)

    def samples(self, y: Y, y1: Y, ks: list[Y], degree: int) -> list[Y]:
        """The dense output at `nodes(degree)`."""
        return self._weighted(self._values(nodes(degree)), y, y1, ks)


def stack(points: list[Y]) -> Y:
    """One state whose leaves have the points along a leading axis."""
    return jax.tree.map(lambda *xs: jnp.stack(xs), *points)


def bernstein(points: Y, u: Float[Array, ""]) -> Y:
    """The state at the fraction `u` of a step from its control points."""
    n = jax.tree.leaves(points)[0].shape[0] - 1
    basis = jnp.stack([math.comb(n, j) * u**j * (1 - u) ** (n - j) for j in range(n + 1)])
    return jax.tree.map(lambda p: jnp.tensordot(basis.astype(p.dtype), p, axes=1), points)
