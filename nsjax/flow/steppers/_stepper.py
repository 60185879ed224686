"""One step of a diffrax solver in a fixed mode, and its dense output as Bernstein control points.

Explicit Runge-Kutta stages are taken from the solver's own tableau, in a loop or, in lanes, one by one (where a loop
takes several times as long); every other solver takes its own `step`.
"""

import abc
import functools as ft
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._barrier import once
from ..._numerics._bernstein import binomials, nodes, to_bernstein, to_chebyshev
from ..._numerics._lane_cond import compact_cond, GROUP
from ..._numerics._rolled import rolled
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem


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

    @jax.jit  # one small program, where each operation would be one of its own
    def evaluated(unit: Array, times: Array) -> Array:
        kwargs: dict[str, Any] = dict(t0=0.0, t1=1.0, y0=unit[0], y1=unit[1])
        if stages:
            kwargs["k"] = unit[2:]
        return jax.vmap(solver_type.interpolation_cls(**kwargs).evaluate)(times)

    with jax.ensure_compile_time_eval():
        values = np.asarray(evaluated(jnp.asarray(unit), jnp.asarray(nodes(many))), float)
    chebyshev = np.linalg.lstsq(np.polynomial.chebyshev.chebvander(2 * nodes(many) - 1, many), values, rcond=None)[0]
    size = np.abs(chebyshev).max(axis=1)
    noise = (1e-10 if x64 else 1e-4) * size.max()
    return values, int(np.flatnonzero(size > noise)[-1])


class Step(NamedTuple):
    """A step in a fixed mode."""

    t_next: Scalar
    y1: Y
    error: Y | None  # its estimate; None if the method has none
    ks: list[Y]  # increments, of which dense output is made
    slope: Y | None = None  # the field at its end, if it is known
    guards: list[list[list[Scalar]]] = []  # `[slot][part][j]`: coefficients of polynomials that stand for the guards
    noise: list[list[Scalar]] = []  # `[slot][part]`: what rounding of time and state makes of them
    resolved: Bool[Array, ""] | bool = True  # whether they do so well
    reach: Scalar | None = None  # up to which multiple of this length they would, if a method can tell
    fits: Bool[Array, ""] | bool = True  # whether the method is made for such a field


class Watch(NamedTuple):
    """What is wanted of a step that may be kept."""

    affine: tuple[bool, ...]  # of each guard whether it is affine in (t, y)
    controller: dfx.AbstractStepSizeController


Watched: TypeAlias = Watch | None


class Stepper(eqx.Module):
    """Takes steps with `solver`.

    `degree` is that of the dense output; `points(...)` gives its control points, `degree + 1` states whose Bernstein
    combination it is.
    """

    solver: eqx.AbstractVar[dfx.AbstractSolver]
    degree: eqx.AbstractVar[int]
    exact: ClassVar[bool] = False  # whether its error is that of rounding, whatever the tolerances
    group: ClassVar[int] = GROUP  # lanes whose events are worked on together, at least

    def made_for(self, model: SwitchedSystem, state: ModeState, t: Scalar, y: Y) -> "Stepper":
        """The same for this model, or an error if the method cannot be used for it."""
        return self

    @abc.abstractmethod
    def __call__(
        self, model: SwitchedSystem, state: ModeState, t: Scalar, t_next: Scalar, y: Y, f0: Y, watch: Watched = None
    ) -> Step:
        """A step from `t`, where the field is `f0`, to `t_next`.

        With `watch` also the polynomials of the guards; and a method that knows in advance how far it is accurate may
        go only so far towards `t_next`.
        """

    @abc.abstractmethod
    def points(self, y: Y, y1: Y, ks: list[Y]) -> list[Y]:
        """The `degree + 1` control points of the dense output."""

    def least(self, c: list[Scalar], roots: Int[Array, ""]) -> Scalar:
        """A lower bound, up to a positive factor, of such a polynomial once its known roots at the start are divided
        out: here the smallest of its Bernstein coefficients, of which the first vanish with these roots."""
        return ft.reduce(jnp.minimum, [select(j < roots, 1, x) if j < 3 else x for j, x in enumerate(c)])

    def end(self, c: list[Scalar]) -> tuple[Scalar, Scalar]:
        """Value and slope of such a polynomial at the end of the step."""
        return c[-1], (len(c) - 1) * (c[-1] - c[-2])

    def scaled(self, model: SwitchedSystem, guards: list[list[list[Scalar]]]) -> list[Float[Array, "slots parts"]]:
        """The polynomials of the guards as `_bernstein` wants them: coefficients in Σ a_j u^j (1 - u)^(n - j)."""
        n = max(len(c) for row in guards for c in row) - 1

        def raised(c: list[Scalar]) -> list[Scalar]:
            a = [w * x if w != 1 else x for w, x in zip(binomials(len(c) - 1), c)]
            for _ in range(n + 1 - len(c)):
                a = [a[0], *[x + y for x, y in zip(a, a[1:])], a[-1]]
            return a

        rows = [[raised(c) for c in row] for row in guards]
        return [model.stacked([[c[j] for c in row] for row in rows], -1.0) for j in range(n + 1)]

    def pace(self, controller: Any, step: Step, t: Scalar, y: Y, length: Scalar) -> Any:
        """Whether a step is accurate enough and how long the next may be, for a method that finds this out itself; the
        others leave it to the controller."""
        return None

    def estimate(self, step: Step) -> Y | None:
        """That of a step of which derivatives tell how far they are wrong; None for a method whose are exact."""
        return step.error


def _written_out(tableau: dfx.ButcherTableau, f: Field, span: tuple[Scalar, Scalar], y: Y, k: Y) -> tuple[list[Y], Y]:
    """The increments of all stages, of which `k` is the first, and the state of the last stage."""
    (t, t_next), ks, stage = span, [k], y
    for row, c in zip(tableau.a_lower, tableau.c):
        stage = _combine(y, list(zip(map(float, row), ks)))
        slope = f(t_next if c == 1 else t + float(c) * (t_next - t), stage)
        ks.append(jax.tree.map(lambda k: once((t_next - t) * k), slope))
    return ks, stage


def _looped(tableau: dfx.ButcherTableau, f: Field, span: tuple[Scalar, Scalar], y: Y, k: Y) -> tuple[list[Y], Y]:
    """The same with the field once in the program: half as much to compile."""
    (t, t_next), (x, unravel) = span, jfu.ravel_pytree(y)
    lower = np.zeros((tableau.num_stages, tableau.num_stages))
    for i, row in enumerate(tableau.a_lower):
        lower[i + 1, : i + 1] = row
    rows, shares = jnp.asarray(lower[1:], x.dtype), jnp.asarray(np.asarray(tableau.c), t.dtype)

    def stage(ks: Array, at: tuple[Array, Array, Scalar]) -> tuple[Array, Array]:
        i, row, c = at
        state = x + row @ ks
        slope = f(select(c == 1, t_next, t + c * (t_next - t)), unravel(state))
        k = (t_next - t).astype(x.dtype) * jfu.ravel_pytree(slope)[0]
        return lax.dynamic_update_index_in_dim(ks, k, i, 0), state

    first = jnp.zeros((tableau.num_stages, len(x)), x.dtype).at[0].set(jfu.ravel_pytree(k)[0])
    index = jnp.arange(1, tableau.num_stages)
    ks, states = lax.scan(stage, first, (index, rows, shares))
    return [unravel(k) for k in ks], unravel(states[-1])


class RungeKutta(Stepper):
    """Steps of a diffrax Runge-Kutta method.

    A guard affine in (t, y) has its values at the control points as Bernstein coefficients; any other is interpolated,
    and the size of its last Chebyshev coefficients tells whether a polynomial of that degree can stand for it.
    """

    solver: dfx.AbstractSolver
    degree: int = eqx.field(static=True)
    stages: int = eqx.field(static=True)
    reverse: bool = eqx.field(static=True)  # whether steps are differentiated backwards

    def __init__(self, solver: dfx.AbstractSolver, reverse: bool = False):
        if isinstance(solver, dfx.AbstractRungeKutta) and isinstance(solver.tableau, dfx.ButcherTableau):
            self.stages = solver.tableau.num_stages
        elif isinstance(solver, (dfx.Euler, dfx.ImplicitEuler)):
            self.stages = 0
        else:
            raise TypeError(
                "Argument `solver` must be a diffrax Runge-Kutta solver for ordinary differential equations (such as "
                f"Tsit5, Dopri5, Dopri8, Kvaerno5) or Euler, but got {solver!r}."
            )
        self.solver, self.reverse = solver, reverse
        self.degree = _dense_weights(type(solver), self.stages, _double())[1]

    def __call__(
        self, model: SwitchedSystem, state: ModeState, t: Scalar, t_next: Scalar, y: Y, f0: Y, watch: Watched = None
    ) -> Step:
        step = self.step(model, state, t, t_next, y, f0)
        if watch is None or not model.slots:
            return step
        return step._replace(**self.watched(model, state, watch.affine, t, y, step))

    def step(self, model: SwitchedSystem, state: ModeState, t: Scalar, t_next: Scalar, y: Y, f0: Y) -> Step:
        def f(t: Scalar, y: Y) -> Y:
            return model.flow(t, y, state)

        dt = t_next - t
        if isinstance(self.solver, dfx.AbstractERK):
            tableau = self.solver.tableau
            assert isinstance(tableau, dfx.ButcherTableau)
            first = jax.tree.map(lambda k: once(dt * k), f0)
            if self.reverse:  # `rolled` has no rule for transposition
                ks, stage = _written_out(tableau, f, (t, t_next), y, first)
            else:
                loop, written_out = ft.partial(_looped, tableau), ft.partial(_written_out, tableau)
                ks, stage = rolled(loop, written_out, f, (t, y), (t, t_next), y, first)
            y1 = stage if tableau.ssal else _combine(y, list(zip(map(float, tableau.b_sol), ks)))
            error = _combine(jax.tree.map(jnp.zeros_like, y), list(zip(map(float, tableau.b_error), ks)))
            # Free when the first stage of the next step is the last of this one.
            safe = select(dt == 0, 1, dt)
            slope = jax.tree.map(lambda k: k / safe, ks[-1]) if tableau.fsal else None
            return Step(t_next, y1, error, ks, slope)
        terms = dfx.ODETerm(lambda t, y, args: f(t, y))
        memory = self.solver.init(terms, t, t_next, y, None)
        y1, error, dense, *_ = self.solver.step(terms, t, t_next, y, None, memory, made_jump=True)
        ks = [jax.tree.map(lambda k, i=i: k[i], dense["k"]) for i in range(self.stages)]
        return Step(t_next, y1, error, ks)

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
        return self._weighted(to_bernstein(self.degree) @ self._values(nodes(self.degree)), y, y1, ks)

    def watched(
        self, model: SwitchedSystem, state: ModeState, affine: tuple[bool, ...], t: Scalar, y: Y, step: Step
    ) -> dict[str, Any]:
        """Bernstein coefficients `[slot][part][j]` of the guards along a step, and what belongs to them."""
        model, state, t, y, step = frozen((model, state, t, y, step))
        near = jittered(model, state, t, y)
        noise: list[list[Scalar]] = [[] for _ in affine]
        out: list[list[list[Scalar]]] = [[] for _ in affine]
        resolved, reach = jnp.ones((), bool), None
        if any(affine):
            n = self.degree
            points = self.points(y, step.y1, step.ks)
            for i, values in _sampled(model, state, t, step, [j / n for j in range(n + 1)], points, affine):
                noise[i].append(jnp.abs(near[i][len(out[i])] - values[0]))
                out[i].append(values)
        if not all(affine):
            n = max(8, self.degree + 3)
            others = tuple(not each for each in affine)

            def curved(model: SwitchedSystem, state: ModeState, t: Scalar, y: Y, step: Step) -> list[list[Scalar]]:
                points = self._weighted(self._values(nodes(n)), y, step.y1, step.ks)
                return [v for _, v in _sampled(model, state, t, step, [*map(float, nodes(n))], points, others)]

            which = [i for i, other in enumerate(others) if other for _ in near[i]]
            if all(model.slots[i].holding for i in which):
                # Multipliers are not asked for where nothing is held, as in free flight between impacts.
                held = [model.held(model.slots[i].switch, state.mode[model.slots[i].switch]) for i in which]
                dynamic, static = eqx.partition((model, state, t, y, step), eqx.is_array)
                free = [[jnp.ones_like(t)] * (n + 1)] * len(which)
                rows = compact_cond(
                    ft.reduce(jnp.logical_or, held), lambda d: curved(*eqx.combine(d, static)), (dynamic,), free
                )
            else:
                rows = once(curved(model, state, t, y, step))  # several kernels use them
            matrix = jnp.asarray(to_bernstein(n), t.dtype)
            coefficients = matrix @ jnp.stack([jnp.stack(values) for values in rows], axis=1)
            margin = jnp.full_like(t, AMPLE)
            for row, (i, values) in enumerate(zip(which, rows)):
                # (Not by `jnp.max` of an array: XLA's code for that takes as long as all stages of a step.)
                rows_of = to_chebyshev(n)[-3:]
                last = [jnp.abs(sum(float(w) * v for w, v in zip(weights, values))) for weights in rows_of]
                tail, size = jnp.maximum(*last[1:]), ft.reduce(jnp.maximum, map(jnp.abs, values))
                # Shortly after a double root or a lift-off all of it is rounding, which a shorter step would not mend.
                noise[i].append(jnp.abs(near[i][len(out[i])] - values[0]))
                enough = unresolved(t.dtype) * size + noise[i][-1]
                resolved = resolved & ~(once(tail - enough) > 0)
                # By symmetry every second coefficient may vanish, which it will not on the next step.
                tail = jnp.maximum(tail, jnp.sqrt(last[0] * last[2]))
                margin = once(jnp.minimum(margin, select(AMPLE * tail > enough, enough / tail, AMPLE)))
                out[i].append(list(coefficients[:, row]))
            reach = 0.9 * margin ** (1 / (n - 1))
        return dict(guards=out, noise=with_multipliers(model, noise), resolved=resolved, reach=reach)


def _sampled(
    model: SwitchedSystem,
    state: ModeState,
    t: Scalar,
    step: Step,
    at: list[float],
    points: list[Y],
    wanted: tuple[bool, ...],
) -> list[tuple[int, list[Scalar]]]:
    """(slot, values along the step) for every part of the guards that are wanted."""
    dt = step.t_next - t
    if len(model.holdable) > 1:  # the multipliers of all points by one call of the linear solver
        ts = t + dt * jnp.asarray(at, t.dtype)
        batch = jax.vmap(lambda t, y: model.guards(t, y, state, wanted))(ts, stack(points))
        rows = [jax.tree.map(lambda x, j=j: x[j], batch) for j in range(len(at))]
    else:
        rows = [model.guards(t + dt * u, y, state, wanted) for u, y in zip(at, points)]
    return [(i, list(part)) for i, _ in enumerate(wanted) for part in zip(*[row[i] for row in rows])]


AMPLE = 1e12  # where so many times less is missing than may be, nothing is said against a longer step


def unresolved(dtype: Any) -> float:
    """The part of a guard that may be missing from the polynomial which stands for it."""
    return max(1e-7, 64 * float(jnp.finfo(dtype).eps))


def jittered(model: SwitchedSystem, state: ModeState, t: Scalar, y: Y) -> list[list[Scalar]]:
    """The guards with the last digits of time and state changed, each up or down: what differs is rounding."""
    flat, unravel = jfu.ravel_pytree(frozen(y))
    size = 64 * float(jnp.finfo(t.dtype).eps)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], flat.shape)
    return model.guards(frozen(t) * (1 + size), unravel(flat * jnp.asarray(1 + size * signs, flat.dtype)), state)


def with_multipliers(model: SwitchedSystem, noise: list[list[Scalar]]) -> list[list[Scalar]]:
    """The rounding of the guards, with that of the digits λ itself is computed with."""
    own = [slot.holding and slot.switch not in model.contacts for slot in model.slots]
    return [[x + 64 * jnp.finfo(x.dtype).eps if o else x for x in row] for row, o in zip(noise, own)]


def stack(points: list[Y]) -> Y:
    """One state whose leaves have the points along a leading axis."""
    return jax.tree.map(lambda *xs: jnp.stack(xs), *points)


def bernstein(points: Y, u: Float[Array, ""]) -> Y:
    """The state at the fraction `u` of a step from its control points."""
    n = jax.tree.leaves(points)[0].shape[0] - 1
    basis = jnp.stack([math.comb(n, j) * u**j * (1 - u) ** (n - j) for j in range(n + 1)])
    return jax.tree.map(lambda p: jnp.tensordot(basis.astype(p.dtype), p, axes=1), points)
