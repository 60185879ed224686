"""The curve on which the equilibria of a system lie when a parameter varies."""

import functools as ft
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..._numerics._compile import interactive
from ..._numerics._lapack import eig, inv, solve
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...equilibria._equilibrium import (
    all_decay,
    balance,
    free_eigenvalues,
    linear_motion,
    stacked_values,
    switch_values,
)
from ...system._level_switch import LevelSwitch
from ...system._mode import ModeState, OFF
from ...system._model import SwitchedSystem
from ...system._parameter import put_parameter


KINK = 1e-7  # what a switch does at its surface, relative to what it does elsewhere, where the field is continuous
EITHER = 2  # of a guard that marks, whichever sign it has


class Record(NamedTuple):
    """What is kept of an equilibrium."""

    y: Y
    parameter: Scalar
    multipliers: Float[Array, " switches"]
    eigenvalues: Complex[Array, " n"]
    held: Int[Array, ""]
    stable: Bool[Array, ""]


class EquilibriumCurve(eqx.Module):
    """f(y, s) = 0 with the state, the values of the switches that can hold it, and the parameter as unknowns `u`, in
    units in which lengths along the curve are measured. The parameter is the last, from 0 at the lower end of its
    interval to 1 at the upper one; `mark` is what it is at the start.

    A mode has the modes of the switches in its first row, and in its second the component of h on which each is held.
    In each mode the equations are smooth.
    """

    model: SwitchedSystem
    path: tuple[str, ...] = eqx.field(static=True)
    t: Scalar
    like: Y
    low: Scalar
    mark: Scalar
    units: Float[Array, " n+1"]

    def parts(self, u: Array) -> tuple[Array, Array, Scalar]:
        """ModeState, values of the holdable switches, parameter."""
        z = u * self.units
        n = len(u) - 1 - len(self.model.holdable)
        return z[:n], z[n:-1], self.low + z[-1]

    def at(self, u: Array) -> tuple[SwitchedSystem, Y, Array]:
        x, sigma, value = self.parts(u)
        system = put_parameter(self.model.system, self.path, value)
        return self.model.with_system(system), jfu.ravel_pytree(self.like)[1](x), sigma

    def state(self, mode: Int[Array, "2 switches"]) -> ModeState:
        return ModeState.of(mode[0], [p if n > 1 else None for p, n in zip(mode[1], self.model.parts)])

    def residual(self, u: Array, mode: Array) -> Array:
        """What vanishes on the curve."""
        model, y, sigma = self.at(u)
        return balance(model, self.t, y, sigma, self.state(mode))

    def motion(self, u: Array, mode: Array) -> Array:
        """A matrix of whose eigenvalues two have the sum zero where a pair is on the imaginary axis."""
        model, y, sigma = self.at(u)
        state = self.state(mode)
        return linear_motion(model, self.t, y, state, switch_values(model, self.t, state, sigma))[1]

    def record(self, u: Array, mode: Array) -> Record:
        """What is kept of a point."""
        model, y, sigma = self.at(u)
        state = self.state(mode)
        values = switch_values(model, self.t, state, sigma)
        _, motion, held, attracts = linear_motion(model, self.t, y, state, values)
        x, _, value = self.parts(u)
        roots = free_eigenvalues(motion, held)
        return Record(y, value, stacked_values(values, x.dtype), roots, held, all_decay(roots, held) & attracts)

    # Guards, switch by switch: the components of h, and their minimum if there are several; of one that can hold what
    # is left to the bounds of its value, and to ±1 if it holds beyond. Of one with levels its margin in each mode.

    def guards(self, u: Array) -> Array:
        """Functions at whose zeros the mode may change."""
        model, y, sigma = self.at(u)
        rows: list[Any] = []
        for k, switch in enumerate(model.switches):
            if isinstance(switch, LevelSwitch):
                rows += [switch.margin(model.system, self.t, y, jnp.asarray(m, jnp.int32)) for m in switch.modes]
                continue
            h = model.h(k, self.t, y)
            rows += [*h, model.least(k, self.t, y)] if len(h) > 1 else h
            if k not in model.holdable:
                continue
            value = sigma[model.holdable.index(k)]
            if k in model.contacts:
                rows.append(value)
                continue
            rows += [model.bound(k) - value, model.bound(k) + value]
            rows += [1 - value, 1 + value] if model.static(k) else []
        return jnp.stack([jnp.asarray(row, u.dtype) for row in rows]) if rows else jnp.zeros(0, u.dtype)

    def slots(self) -> list[tuple[int, str, int]]:
        """Of each guard its switch, what it is ("h", "least", "value", "one", "level"), and which."""
        slots = []
        for k, switch in enumerate(self.model.switches):
            if switch.levels:
                slots += [(k, "level", m) for m in switch.modes]
                continue
            number = self.model.parts[k]
            slots += [(k, "h", i) for i in range(number)] + [(k, "least", 0)] * (number > 1)
            if k in self.model.contacts:
                slots.append((k, "value", 0))
            elif k in self.model.holdable:
                slots += [(k, "value", 0), (k, "value", 1)]
                slots += [(k, "one", 0), (k, "one", 1)] if self.model.static(k) else []
        return slots

    def armed(self, mode: np.ndarray) -> np.ndarray:
        """The sign that each guard has in this mode, 0 for those that do not matter."""
        signs = []
        for k, what, i in self.slots():
            m, part = mode[:, k]
            number = self.model.parts[k]
            held = k in self.model.holdable and self.model.held(k, m)
            if what == "level":
                signs.append(int(i == m))
            elif m == OFF and self.model.conditional(k):
                signs.append(0)
            elif what == "h" and held:
                signs.append(int(number > 1 and i != part))
            elif what == "h":
                signs.append(1 if m == 1 or k in self.model.contacts or number == 1 and m != -1 else -(number == 1))
            elif what == "least":
                signs.append(-int(m == -1))
            else:
                signs.append((1 if what == "value" else EITHER) * held)
        return np.array(signs, int)

    def modes_at(self, u: Array, mode: np.ndarray, active: np.ndarray) -> tuple[list[np.ndarray], list[str], bool]:
        """The modes that may meet where the guards `active` vanish; the switches these are of; and whether the field is
        continuous there. There are none where a level is passed."""
        touched = sorted({k for (k, _, _), on in zip(self.slots(), active) if on})
        smooth = np.asarray(kinks(self, u))
        options, continuous = [], True
        for k, switch in enumerate(self.model.switches):
            now = (int(mode[0, k]), int(mode[1, k]))
            if k not in touched:
                back = now[0] == OFF and self.model.conditional(k) and self.model.contact[k] in touched
                options.append([(int(_side(self, u, k)), now[1])] if back else [now])
                continue
            if switch.levels:
                return [], [switch.name], False
            parts = [i for (j, what, i), on in zip(self.slots(), active) if on and j == k and what == "h"]
            parts = parts if parts and self.model.parts[k] > 1 else [now[1]]
            if switch.signed:
                free = [(-1, now[1]), (1, now[1])]
                holds = k in self.model.holdable and not smooth[k]
                options.append(free + [(0, part) for part in parts] * holds)
                continuous &= bool(smooth[k])
            else:
                options.append([(0, now[1])] + [(1, part) for part in parts] * (k in self.model.contacts))
                continuous = False
        modes = [np.array(choice, np.int32).reshape(-1, 2).T for choice in itertools.product(*options)]
        modes = [np.array([self.model.present(tuple(mode[0])), mode[1]], np.int32) for mode in modes]
        return modes, [self.model.switches[k].name for k in touched], continuous

    def entered(self, u: np.ndarray, mode: np.ndarray) -> np.ndarray:
        """The same place, with the values which switches have in another mode."""
        n = len(u) - 1 - len(self.model.holdable)
        for i, k in enumerate(self.model.holdable):
            if not self.model.held(k, mode[0, k]):
                value = float(self.model.switches[k].value(mode[0, k], float))
                u = np.where(np.arange(len(u)) == n + i, value / self.units[n + i], u)
        return u

    def state_from(self, x: np.ndarray) -> Y:
        """The state with these numbers, in Python."""
        leaves, tree = jax.tree.flatten(self.like)
        parts = np.split(x, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
        return jax.tree.unflatten(tree, [part.reshape(np.shape(leaf)) for part, leaf in zip(parts, leaves)])


@ft.partial(interactive, host=True)
def _side(curve: EquilibriumCurve, u: Array, k: int) -> Array:
    """The sign of h of a switch."""
    model, y, _ = curve.at(u)
    return jnp.sign(model.least(k, curve.t, y))


@ft.partial(interactive, host=True)
def kinks(curve: EquilibriumCurve, u: Array) -> Bool[Array, " switches"]:
    """Which switches the field does not feel at this point, nor on account of an error of its place: where h vanishes
    it is continuous there, with a kink."""

    def felt(s: Array, u: Array) -> Array:
        model, y, _ = curve.at(u)
        return jfu.ravel_pytree(model.field(curve.t, y, tuple(s)))[0]

    none = jnp.zeros(len(curve.model.switches), u.dtype)
    jumps = jax.jacfwd(felt)(none, u)
    slopes = jnp.sum(jnp.abs(jax.jacfwd(jax.jacfwd(felt), 1)(none, u)), axis=-1)
    return jnp.all(jnp.abs(jumps) <= KINK * slopes, axis=0)


@ft.partial(interactive, host=True)
def first_lyapunov_coefficient(curve: EquilibriumCurve, u: Array, mode: Array) -> Float[Array, ""]:
    """Whether the periodic orbits at a Hopf point are stable (negative) in the plane of the pair, by derivatives up to
    the third of the field; Kuznetsov (2004), eq. (5.34)."""
    model, y, _ = curve.at(u)
    x, unravel = jfu.ravel_pytree(y)
    state = curve.state(mode)

    def field(x: Array) -> Array:
        return jfu.ravel_pytree(model.flow(curve.t, unravel(x), state))[0]

    a = jax.jacfwd(field)(x)
    b = jax.jacfwd(jax.jacfwd(field))(x).astype(complex)
    c = jax.jacfwd(jax.jacfwd(jax.jacfwd(field)))(x).astype(complex)
    roots, right = eig(a)
    pair = jnp.argmin(select(roots.imag > 0, jnp.abs(roots.real), jnp.inf))
    omega, q = roots[pair].imag, right[:, pair]
    p = inv(right)[pair]  # p q = 1, |q| = 1
    eye = jnp.eye(len(x), dtype=b.dtype)

    def quadratic(v: Array, w: Array) -> Array:
        return jnp.einsum("ijk,j,k", b, v, w)

    cubic = jnp.einsum("ijkl,j,k,l", c, q, q, jnp.conj(q))
    mean = solve(a.astype(b.dtype), quadratic(q, jnp.conj(q)))
    twice = 2 * jax.lax.complex(jnp.zeros_like(omega), omega)
    double = solve(twice * eye - a.astype(b.dtype), quadratic(q, q))
    terms = cubic - 2 * quadratic(q, mean) + quadratic(jnp.conj(q), double)
    return jnp.real(p @ terms) / (2 * omega)
