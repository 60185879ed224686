"""Equilibria: in a region, on surfaces that hold them, and virtual ones."""

from typing import Any, Generic

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._lapack import inv, svd
from .._numerics._root import find_root, Newton
from .._numerics._scaling import equilibrated, sizes_near
from .._numerics._select import select
from .._numerics._text import listed, shown
from .._types import Scalar, StateT, Y
from ..derivatives._floquet import eigenvalues
from ..flow._results import outcomes, RESULTS
from ..orbits._orbit import ravel
from ..system._level_switch import LevelSwitch
from ..system._mode import mode_words, ModeState, OFF
from ..system._model import SwitchedSystem
from ..system._system import System


@shown
class Equilibrium(eqx.Module, Generic[StateT]):
    """A state that does not change.

    **Attributes:**

    - `y`, `mode`: the state, and the mode in which it is one: where this holds it on a surface, a pseudo-equilibrium.
    - `multipliers`: the values of the switches there: ±1, of a relay 0 or 1, λ of a surface that holds it, the force
        of a contact.
    - `jacobian`: ∂f/∂y in this mode, of the field (2.19) on surfaces that hold it; shape `(n, n)`, for the state
        flattened by `ravel_pytree`.
    - `eigenvalues`: of what can move, largest real part first: in `n` minus `held` directions; the others are NaN.
    - `held`: how many directions the surfaces take: one each, a contact two.
    - `stable`: whether all eigenvalues have negative real parts, and the surfaces attract.
    - `admissible`: whether it lies where its mode does: on its sides of the surfaces, with |λ| within its bound, a
        contact force that pushes. If not it is virtual.
    - `boundary`: whether it lies on a surface that does not hold it: there a neighbouring region has it too, and the
        Jacobian is one-sided.
    - `isolated`: whether there is no other one nearby. (Sticking friction alone holds in many places.)
    - `residual`: the largest component of the field.
    - `result`: `RESULTS`.
    """

    system: System
    y: StateT
    mode: Int[Array, " switches"]
    multipliers: Float[Array, " switches"]
    jacobian: Float[Array, "n n"]
    eigenvalues: Complex[Array, " n"]
    held: Int[Array, ""]
    stable: Bool[Array, ""]
    admissible: Bool[Array, ""]
    boundary: Bool[Array, ""]
    isolated: Bool[Array, ""]
    residual: Scalar
    result: RESULTS

    def __str__(self) -> str:
        if jnp.ndim(self.result._value):
            found = np.asarray(self.result == RESULTS.successful)
            stable = np.asarray(self.stable)[found]
            return (
                f"{found.size} searches for equilibria of {type(self.system).__name__}: {found.sum()} found, "
                f"{stable.sum()} stable, {(~stable).sum()} unstable"
            )
        names = [k.name for k in self.system.switches]
        where = mode_words(names, self.mode) or "no switches"
        values = ", ".join(f"{n} {float(v):.6g}" for n, v in zip(names, self.multipliers)) or "none"
        free = len(self.eigenvalues) - int(self.held)
        words = ["stable" if self.stable else "unstable"] + ["virtual"] * (not self.admissible)
        kind = ", ".join(words + ["not isolated"] * (not self.isolated)) + " equilibrium"
        if self.result != RESULTS.successful:
            kind = f"failed search ({outcomes(self.result)}) for an equilibrium"
        return (
            f"{kind} of {type(self.system).__name__}\n"
            f"  state        y = ({listed(jfu.ravel_pytree(self.y)[0], 12)})\n"
            f"  mode         {where}{' (on a surface)' if self.boundary else ''}\n"
            f"  switches     {values}\n"
            f"  eigenvalues  {listed(self.eigenvalues[:free])}\n"
            f"  residual     {float(self.residual):.1e}"
        )


def switch_values(model: SwitchedSystem, t: Scalar, state: ModeState, sigma: Array) -> tuple[Any, ...]:
    """The value of every switch, for those of the holdable ones."""
    s = list(model.signs(t, state))
    for i, k in enumerate(model.holdable):
        s[k] = sigma[i]
    return tuple(s)


def stacked_values(s: tuple[Any, ...], dtype: Any) -> Float[Array, " switches"]:
    return jnp.stack([jnp.asarray(v, dtype) for v in s]) if s else jnp.zeros(0, dtype)


def balance(model: SwitchedSystem, t: Scalar, y: Y, sigma: Array, state: ModeState) -> Float[Array, " equations"]:
    """What vanishes at an equilibrium: the field; h on the surfaces that hold it, whose values are unknowns beside the
    state, (2.19)-(2.20); and by how much the values of the others differ from their signs."""
    rest = model.signs(t, state)
    rows = [
        select(model.held(k, state.mode[k]), _surface(model, k, t, y, state), sigma[i] - rest[k])
        for i, k in enumerate(model.holdable)
    ]
    field = ravel(model.field(t, y, switch_values(model, t, state, sigma)))
    return jnp.concatenate([field, jnp.stack(rows)]) if rows else field


@interactive
def equilibrium_in(system: System, t: Scalar, y0: Y, mode: tuple, newton: Newton) -> Equilibrium:
    """Newton's method on f(y, s) = 0 in a given mode, with the values of the surfaces that hold the state as unknowns
    beside it, and h = 0 there as their equations."""
    x0, unravel = jfu.ravel_pytree(lax.stop_gradient(y0))
    model = SwitchedSystem(frozen(system), jnp.ones_like(t), t, y0)
    holdable = model.holdable
    state = model.state_at(t, y0, mode)

    def residual(z: tuple, system: System) -> Array:
        return balance(model.with_system(system), t, unravel(z[0]), z[1], state)

    # Where a surface holds all along it, the values that keep it there are those of the nearest place.
    begin, signs = model.values(t, y0, state), model.signs(t, state)
    sigma = [select(jnp.isfinite(begin[k]), begin[k], signs[k]) for k in holdable]
    sigma = jnp.stack(sigma) if sigma else jnp.zeros(0, t.dtype)
    start, unflatten = jfu.ravel_pytree(frozen((x0, sigma)))

    def flat(z: Array) -> Array:
        return residual(unflatten(z), frozen(system))

    sizes = sizes_near(jax.jacfwd(flat)(start), start)
    sizes = sizes._replace(equations=select(sizes.equations > 0, sizes.equations, 1))
    z, converged = find_root(residual, (x0, sigma), system, newton, sizes=sizes, isolated=False)
    end = jfu.ravel_pytree(frozen(z))[0]
    error, matrix = frozen((flat(end), jax.jacfwd(flat)(end)))
    rows, columns = equilibrated(matrix)
    # Each of Newton's steps leaves its rounding in all unknowns. An unknown that is no larger has no size of its own.
    rounding = 10 * jnp.finfo(t.dtype).eps * columns * jnp.max(jnp.abs(end - start) / columns)
    sizes = sizes_near(matrix, jnp.maximum(jnp.abs(start), select(jnp.abs(end) > rounding, jnp.abs(end), 0)))
    left, singular, right = svd(rows[:, None] * matrix * columns)
    isolated = singular[-1] > 1e-10 * singular[0]
    # Among large numbers rounding keeps Newton's method from ending. (The steps are the shortest ones here, too.)
    inverse = select(singular > 1e-10 * singular[0], 1 / singular, 0)
    step = columns * (right.T @ (inverse * (left.T @ (rows * error))))
    small = 1e3 * newton.tol
    ended = converged | jnp.all(jnp.abs(step) <= small * sizes.unknowns)
    good = ended & jnp.all(jnp.abs(error) <= small * sizes.equations)

    live = model.with_system(system)
    y, s = unravel(z[0]), switch_values(live, t, state, z[1])
    jacobian, motion, held, attracts = linear_motion(live, t, y, state, s)
    roots = free_eigenvalues(motion, held)
    admissible, boundary = _place(model, t, frozen(y), state, frozen(s), sizes.unknowns)
    return Equilibrium(
        system=system,
        y=y,
        mode=jnp.stack(state.mode) if state.mode else jnp.zeros(0, jnp.int32),
        multipliers=stacked_values(s, t.dtype),
        jacobian=jacobian,
        eigenvalues=roots,
        held=held,
        stable=all_decay(roots, held) & attracts,
        admissible=admissible,
        boundary=boundary,
        isolated=isolated,
        residual=jnp.max(jnp.abs(error)),
        result=RESULTS.where(good, RESULTS.successful, RESULTS.equilibrium_not_found),
    )


def _surface(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
    h = jnp.stack(model.h(k, t, y))
    return h[0 if state.part[k] is None else state.part[k]]


def linear_motion(
    model: SwitchedSystem, t: Scalar, y: Y, state: ModeState, s: tuple
) -> tuple[Float[Array, "n n"], Float[Array, "n n"], Int[Array, ""], Bool[Array, ""]]:
    """The Jacobian; the same with rates for the directions off the surfaces that hold the state which are far left of
    all others; how many these are; and whether the surfaces attract (2.24)."""
    x, unravel = jfu.ravel_pytree(y)
    jacobian = jax.jacfwd(lambda x: ravel(model.flow(t, unravel(x), state)))(x)
    held, attracts = jnp.zeros((), jnp.int32), jnp.ones((), bool)
    normals, taken = [], []
    for k in model.holdable:
        on = model.held(k, state.mode[k])
        contact = k in model.contacts
        held = held + select(on, 2 if contact else 1, 0)
        gradients = [jax.grad(lambda x, k=k: model.level(k, t, unravel(x), state))(x)]
        if contact:
            gradients.append(jax.grad(lambda x, k=k: _surface(model, k, t, unravel(x), state))(x))
        else:
            slope = jax.jacfwd(lambda v, k=k: model.rates((k,), t, y, state, s[:k] + (v,) + s[k + 1 :])[0])(s[k])
            attracts = attracts & select(on, slope < 0, True)
        normals += [select(on, g / jnp.linalg.norm(g), 0) for g in gradients]
        taken += [on] * len(gradients)
    if not normals:
        return jacobian, jacobian, held, attracts
    # The normals N span a left invariant subspace, N J = T N: that is what being held means. So J - N⁺ (T + D) N has
    # -D for T, and the other eigenvalues of J.
    normal, on = jnp.stack(normals), jnp.stack(taken)
    inverse = normal.T @ inv(normal @ normal.T + jnp.diag(select(on, 0, 1).astype(x.dtype)))
    far = 10 * (1 + jnp.max(jnp.abs(lax.stop_gradient(jacobian)))) * len(x)
    rates = jnp.diag(far * (1 + jnp.arange(len(normals), dtype=x.dtype)))
    return jacobian, jacobian - inverse @ (normal @ jacobian @ inverse + rates) @ normal, held, attracts


def free_eigenvalues(motion: Float[Array, "n n"], held: Int[Array, ""]) -> Complex[Array, " n"]:
    """Largest real part first; those off the surfaces come last, and are NaN."""
    roots = eigenvalues(motion)
    order = jnp.argsort(-lax.stop_gradient(roots).real)
    return select(_free(len(roots), held), roots[order], jnp.nan)


def all_decay(roots: Complex[Array, " n"], held: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether the eigenvalues of what can move have negative real parts."""
    return jnp.all(select(_free(len(roots), held), roots.real < 0, True))


def _free(n: int, held: Int[Array, ""]) -> Bool[Array, " n"]:
    return jnp.arange(n, dtype=held.dtype) < n - held


def _place(
    model: SwitchedSystem, t: Scalar, y: Y, state: ModeState, s: tuple, sizes: Array
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the state lies where its mode does, and whether on a surface that does not hold it. `sizes` are those of
    the state and of the values of the surfaces."""
    admissible, boundary = jnp.ones((), bool), jnp.zeros((), bool)
    x, unravel = jfu.ravel_pytree(y)
    size, forces = unravel(sizes[: len(x)]), dict(zip(model.holdable, sizes[len(x) :]))
    for k, switch in enumerate(model.switches):
        mode = state.mode[k]
        if isinstance(switch, LevelSwitch):
            admissible = admissible & (switch.margin(model.system, t, y, mode) >= 0)
            continue

        def surface(t: Scalar, y: Y, k: int = k) -> tuple[Scalar, ...]:
            return model.h(k, t, y)

        h, slack = jnp.min(jnp.stack(surface(t, y))), jnp.max(model.sizes(surface, t, y, jnp.zeros_like(t), size))
        slack = 1e-9 * slack + 1e3 * jnp.max(model.rounding(surface, t, y))
        on = jnp.abs(h) <= slack
        if model.conditional(k):
            absent, off = model.absent(k, state.mode), mode == OFF
            h, on = select(off, select(absent, 1, -1), select(absent, -1, h)), on & ~off
        side = (h >= -slack) if switch.unilateral else (mode.astype(h.dtype) * h >= -slack)
        if k not in model.holdable:
            admissible, boundary = admissible & side, boundary | on
            continue
        held = model.held(k, mode)
        within = s[k] >= -1e-9 * forces[k] if k in model.contacts else jnp.abs(s[k]) <= model.bound(k) * (1 + 1e-9)
        admissible = admissible & select(held, within & (h >= -slack), side)
        boundary = boundary | (on & ~held)
    return admissible, boundary
