"""Right-hand sides without set-valued switches: the smoothing method (2.32) and the switch model (2.4), (3.35).

Both are rules for the values `s` of the `sgn` switches as functions of time and state, put into the same vector field.
"""

import abc
import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._jaxpr import is_constant
from .._numerics._select import select
from .._numerics._series import Series
from .._types import Scalar, Y
from ..system._checks import check_model, check_system
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._switch import AbstractSwitch, forwarded
from ..system._system import arrays_of, SwitchValues, System


_TERMS = 8  # of the series in `_quotient`

_CURVES: dict[str, Callable[[Scalar], Scalar]] = {
    "arctan": lambda x: 2 / jnp.pi * jnp.arctan(x),
    "tanh": jnp.tanh,
    "linear": lambda x: jnp.clip(x, -1, 1),
}

_Values = SwitchValues | Mapping[str, Any]


@ft.cache
def _pulled(switch: AbstractSwitch) -> AbstractSwitch:
    """The switch with the indicator function h exp(rate (t - now)). What keeps it constant makes dh/dt = -rate h."""

    def guard(self: "_Pulled", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        growth = jnp.exp(self.rate * (t - self.now))
        return tuple(h * growth for h in switch.components(self.system, t, y))

    return forwarded(switch)._with(guard=guard)


def _sliding(system: System) -> tuple[AbstractSwitch, ...]:
    """The switches on whose surfaces a solution may slide: signs, apart from those whose events reset the state."""
    return tuple(k for k in system.switches if k.signed and not k.jumps)


def _smooth(system: System) -> tuple[AbstractSwitch, ...]:
    """The switches that have a smooth function in their place, apart from those whose events reset the state."""
    return tuple(k for k in system.switches if k.smoothed_value is not None and not k.jumps)


def _field(system: System, t: Scalar, y: Y, replaced: Sequence[AbstractSwitch], values: _Values, others: _Values) -> Y:
    """The vector field of `system`, with `values` of the switches that are `replaced`, and those of the `others`."""
    both = [(values if k in replaced else others)[k.name] for k in system.switches]
    return system.vector_field(t, y, system.values(tuple(both)))


class _Regularised(System):
    """A system some of whose switches have values that are functions of time and state. The others remain."""

    system: eqx.AbstractVar[System]

    @property
    @abc.abstractmethod
    def replaced(self) -> tuple[AbstractSwitch, ...]:
        """The switches that have such values."""

    @abc.abstractmethod
    def put(self, t: Scalar, y: Y, s: SwitchValues) -> _Values:
        """The values of the switches that are replaced, for the values `s` of the others."""

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        return _field(self.system, t, y, self.replaced, self.put(t, y, s), s)

    @property
    def jumps_in_time(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.jumps_in_time

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return tuple(forwarded(k) for k in self.system.switches if k not in self.replaced)

    @property
    def period(self) -> Float[Array, ""] | float | None:
        return self.system.period


class Smoothed(_Regularised):
    """See `smoothed`."""

    system: System
    eps: Float[Array, ""] | float
    kind: str = eqx.field(static=True)
    offset: dict[str, Float[Array, ""] | float] = eqx.field(default_factory=dict)

    @property
    def replaced(self) -> tuple[AbstractSwitch, ...]:
        return _smooth(self.system)

    def put(self, t: Scalar, y: Y, s: SwitchValues) -> dict[str, Any]:
        def sign(h: Scalar) -> Scalar:
            return _CURVES[self.kind](self.eps * h)

        return {
            k.name: k.smoothed_value(self.system, t, y, sign) for k in self.replaced if k.smoothed_value is not None
        }

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        f = super().vector_field(t, y, s)
        if not self.offset:
            return f
        dtype = jnp.result_type(*jax.tree.leaves(y))
        t, y = jnp.asarray(t, dtype), jax.tree.map(lambda x: jnp.asarray(x, dtype), y)
        friction = self.put(t, y, s)
        parameters, rest = eqx.partition(arrays_of(self.system, dtype), eqx.is_inexact_array)
        x, tree = jax.tree.flatten((parameters, t, y))

        def place(*x: Array) -> tuple[System, Scalar, Y]:
            parameters, t, y = jax.tree.unflatten(tree, x)
            return eqx.combine(parameters, rest), t, y

        for k in self.system.switches:
            if k.name not in self.offset:
                continue

            def slope(*x: Array) -> list[Array]:
                """∂f/∂s, for the values of the other switches that are here."""

                def field(value: Scalar) -> Y:
                    return _field(*place(*x), self.replaced, friction | {k.name: value}, s)

                value = friction[k.name]
                return jax.tree.leaves(jax.jvp(field, (value,), (jnp.ones_like(value),))[1])

            g, jumps = _quotient(slope, lambda *x: k.least(*place(*x)), x, jax.tree.leaves(f), 1 / self.eps)
            text = (
                f"Argument `offset` must name switches on whose surface the field is continuous, as |h| is, but "
                f"`{type(self.system).__name__}.vector_field` jumps on that of `{k.name}` (or h has no gradient there)."
            )
            by = eqx.error_if(self.offset[k.name] / jnp.asarray(self.eps, dtype), jumps, text)
            f = jax.tree.unflatten(jax.tree.structure(f), [a + by * b for a, b in zip(jax.tree.leaves(f), g)])
        return f


def _quotient(
    top: Callable[..., list[Array]], h: Callable[..., Scalar], x: list[Array], sizes: list[Array], width: Any
) -> tuple[list[Array], Bool[Array, ""]]:
    """`top(*x) / h(*x)`, where `top` vanishes with h, and so that its derivatives are right there too.

    On a curve through x along which h grows at the rate one, `top` is zero at the distance -h. So is its Taylor series,
    top - h top' + h²/2 top'' - ... = 0, and the quotient is top' - h/2 top'' + ..., in which nothing cancels. That is
    taken where its last two terms are lost in rounding, which says what a small h is, and where the series does vanish.

    **Returns:** the quotient, and whether `top` is found not to vanish, for |h| up to `width`; judged by `sizes`, those
    of the terms whose difference it may be.
    """
    moving = [i for i, v in enumerate(x) if not is_constant(lambda v: h(*x[:i], v, *x[i + 1 :]), v)]

    def along(part: list[Array]) -> Scalar:
        whole = dict(zip(moving, part))
        return h(*[whole.get(i, v) for i, v in enumerate(x)])

    gradient = jax.jacfwd(along)([x[i] for i in moving]) if moving else []
    square = sum([jnp.sum(g**2) for g in gradient], jnp.zeros((), x[0].dtype))
    ahead = {i: g / select(square > 0, square, 1) for i, g in zip(moving, gradient)}

    def course(rate: Any) -> list[Any]:
        return [rate * ahead[i] if i in ahead else None for i in range(len(x))]

    series = Series(lambda *x: [h(*x), *top(*x)], *x)
    height, *tops = [jnp.asarray(v) for v in series.step(0, *x)]
    terms = [series.step(1, *course(1))[1:]]
    for k in range(2, _TERMS + 1):
        bend, *term = series.step(k, *[None] * len(x))
        if bend is not None:  # the curve bends back
            _, *term = series.step(k, *course(-bend))
        terms.append(term)

    def total(rates: list[Any], h: Array) -> Array:
        """The series, whose terms may be None for zero."""

        def onto(later: Any, rate: Any) -> Any:
            return rate if later is None else -h * later + (0 if rate is None else rate)

        out = ft.reduce(onto, reversed(rates), None)
        return jnp.zeros((), h.dtype) if out is None else out

    def check(value: Array, size: Array, rates: list[Any]) -> tuple[Array, Array]:
        near, last = total(rates, height), [None if r is None else jnp.abs(r) for r in rates[-2:]]
        lost, gap = total([None] * (_TERMS - 2) + last, -jnp.abs(height)), jnp.abs(value - height * near)
        eps = float(jnp.finfo(value.dtype).eps)
        rounding = eps**0.5 * jnp.abs(value) + 1e3 * eps * (1 + jnp.abs(size))
        known = (lost <= eps * jnp.abs(near)) & (gap <= rounding) & (square > 0)
        jump = (gap > rounding + 1e3 * lost * jnp.abs(height)) & (jnp.abs(height) <= width)
        jump |= (height == 0) & ~known
        off = value / select(known, 1, height)
        return select(known, total(rates, select(known, height, 0)), off), jnp.any(jump)

    out, jumps = zip(*[check(*entry) for entry in zip(tops, sizes, map(list, zip(*terms)))])
    return list(out), ft.reduce(jnp.logical_or, jumps)


class _Pulled(System):
    """The `sgn` switches of a system alone, the others having given values, with multipliers that make
    dh/dt = -rate h at the time `now`."""

    system: System
    others: SwitchValues
    rate: Float[Array, ""] | float
    now: Scalar

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        return _field(self.system, t, y, _sliding(self.system), s, self.others)

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return tuple(map(_pulled, _sliding(self.system)))


class Banded(_Regularised):
    """See `banded`."""

    system: System
    eta: Float[Array, ""] | float
    rate: Float[Array, ""] | float

    @property
    def replaced(self) -> tuple[AbstractSwitch, ...]:
        return _sliding(self.system)

    @property
    def jumps_in_time(self) -> str:  # multipliers are compared with their bounds
        return "missed"

    def put(self, t: Scalar, y: Y, s: SwitchValues) -> _Values:
        t, y = jnp.asarray(t), jax.tree.map(jnp.asarray, y)
        one = jnp.ones_like(t)
        check_model(self.system, t, y, one)
        pulled = _Pulled(self.system, s, self.rate, t)
        model = SwitchedSystem(pulled, one, t, y)
        return pulled.values(model.values(t, y, _banded_mode(model, self.eta, t, y)))


def _banded_mode(model: SwitchedSystem, eta: Any, t: Scalar, y: Y) -> ModeState:
    """A mode from the state alone: held are the surfaces in whose band it is, if they attract and |λ| <= b."""
    model, eta, t, y = frozen((model, eta, t, y))  # modes have no derivative
    heights = [jnp.stack(model.h(k, t, y)) for k in range(len(model.switches))]
    part = tuple(jnp.argmin(h).astype(jnp.int32) if h.size > 1 else None for h in heights)
    side = jnp.stack([select(jnp.min(h) >= 0, 1, -1) for h in heights]).astype(jnp.int32)
    which = model.holdable

    def state(mode: Int[Array, " switches"]) -> ModeState:
        return ModeState(tuple(mode), part, tuple(jnp.zeros_like(m) for m in mode))

    if not which:
        return state(side)
    inside = jnp.stack([jnp.abs(jnp.min(heights[k])) <= eta for k in which])
    at = jnp.asarray(which)
    mode = side.at[at].set(select(inside, 0, side[at]))
    # A surface that repels is crossed.
    _, slope = model.linear(t, y, state(mode), tuple(mode.astype(t.dtype)))
    mode = side.at[at].set(select(inside & (jnp.diag(slope) < 0), 0, side[at]))

    def release(carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Bool[Array, ""]]:
        """Lets go the one that violates its bound most, to the side to which dh/dt = slope (s - λ) then points."""
        count, mode, _ = carry
        lam = jnp.stack([model.values(t, y, state(mode))[k] for k in which])
        bound = jnp.stack([jnp.asarray(model.bound(k), t.dtype) for k in which])
        excess = select(mode[at] == 0, jnp.abs(lam) / bound - 1, -1)
        excess = select(jnp.isnan(excess), jnp.inf, excess)
        worst = jnp.argmax(excess)
        over = excess[worst] > 0
        free = select(over, select(lam[worst] >= 0, 1, -1), mode[at[worst]])
        return count + 1, mode.at[at[worst]].set(free.astype(jnp.int32)), over

    carry = (jnp.zeros((), jnp.int32), mode, jnp.ones((), bool))
    if len(which) == 1:
        return state(release(carry)[1])
    return state(lax.while_loop(lambda c: c[2] & (c[0] < len(which)), release, carry)[1])


def _number(name: str, value: Any, kind: str = "number") -> Any:
    if not eqx.is_array_like(value) or isinstance(value, bool):
        raise TypeError(f"Argument `{name}` must be a {kind}, but got {value!r}.")
    if jnp.shape(value) != ():
        raise ValueError(f"Argument `{name}` must be a scalar, but has shape {jnp.shape(value)}; use `jax.vmap`.")
    return value if isinstance(value, jax.Array) else float(value)


def _positive(name: str, value: Any) -> Any:
    value = _number(name, value, "positive number")
    if isinstance(value, Tracer):
        return eqx.error_if(value, ~(value > 0), f"Argument `{name}` must be positive, but is not.")
    if not value > 0:
        raise ValueError(f"Argument `{name}` must be positive, but got {value}.")
    return value


def _check_replaced(system: System, replaced: Sequence[AbstractSwitch]) -> None:
    """Raises if there is no switch to be replaced."""
    if not replaced:
        others = ", ".join(f"`{k.name}`" for k in system.switches)
        raise ValueError(
            f"Argument `system` must have a `sgn` switch to be regularised, but `{type(system).__name__}` has "
            f"{f'only {others}' if others else 'no switch'}. Pass it to `solve` as it is."
        )


def smoothed(
    system: System,
    eps: Any,
    kind: Literal["arctan", "tanh", "linear"] = "arctan",
    offset: Mapping[str, Any] | None = None,
) -> System:
    """The smoothing method, Leine (2000), section 2.4: the value of every `sgn` switch is a steep function of its h.
    (So is that of a `LevelSwitch` which has a `smoothed_value`.)

        "arctan"    s = (2/π) arctan(ε h)       eq. (2.32)
        "tanh"      s = tanh(ε h)
        "linear"    s = min(max(ε h, -1), 1)    the linear approximation (4.3), symmetric, of the band |h| <= 1/ε

    The solution differs from that of `system` by an error that no tolerance removes: of order 1/ε for "linear", ln(ε)/ε
    for "tanh", and for "arctan", whose tails 1/(ε h) end a stick too early, ε^(-2/3). Derivatives converge too. Where
    the solution slides the field is stiff, with a rate proportional to ε: use an implicit solver.

    ```python
    sol = nsjax.solve(nsjax.smoothed(system, 1e4), 0.0, 40.0, y0, solver=diffrax.Kvaerno5())
    ```

    Where a continuous field has kinks, |h| = h s, there are smoothings that are not symmetric, and may lose a
    bifurcation, (5.15) and (5.23): `offset` raises |h| everywhere by c/ε. As ∂f/∂s = h g, that adds (c/ε) g to the
    field. (Several add up; where absolute values are multiplied, the product of their offsets is left out.) g is found
    from f and h, on the surface too, by a Taylor series over state, time and parameters.

    ```python
    nsjax.smoothed(nsjax.gallery.DiscontinuousTranscritical(mu), 10.0, offset={"parameter": 1.0})  # (5.15)
    ```

    **Arguments:**

    - `system`: the model. Its `relay` and `impact` switches remain, and are solved event by event.
    - `eps`: steepness ε > 0 [1 / unit of h], one for all switches. Where h is a tuple it is that of their minimum.
    - `kind`: the function.
    - `offset`: the numbers c (dimensionless) of the switches whose |h| is raised, by their names. They must be kinks:
        where the field jumps (friction) there is no g.

    **Returns:** a `System` whose fields are `system`, `eps`, `kind` and `offset`.

    **Raises:** `ValueError` for an `eps` that is not positive, an unknown kind or name, a system without a `sgn`
    switch, and one with a static friction point (`breakaway` > 1), which no function of h can have: see `banded`. A
    runtime error if that shows only when numbers are there; or if the field is found to jump on a surface with an
    offset, where it is evaluated within |h| <= 1/ε. `TypeError`, there, for an operation without a Taylor series.
    """
    check_system(system)
    frictions = _sliding(system)
    _check_replaced(system, _smooth(system))
    if kind not in _CURVES:
        known = ", ".join(map(repr, _CURVES))
        raise ValueError(f"Argument `kind` must be one of {known}, but got {kind!r}.")
    eps = _positive("eps", eps)
    for name in offset or ():
        if name not in [k.name for k in frictions]:
            known = ", ".join(f"`{k.name}`" for k in frictions)
            raise ValueError(f"Argument `offset` must name `sgn` switches of the system, {known}, but got `{name}`.")
    raised = {name: _number(f"offset[{name!r}]", c) for name, c in (offset or {}).items()}
    for k in frictions:
        bound = k.bound(system)
        name = f"{type(system).__name__}.{k.name}"
        text = (
            f"Argument `system` must have no static friction point, but `{name}.breakaway` is greater than 1: a smooth "
            "function of h has one value where stick and slip differ. Use `nsjax.banded`, or parameters for which the "
            "bound is 1."
        )
        if isinstance(bound, Tracer):
            eps = eqx.error_if(jnp.asarray(eps), bound > 1, text)
        elif bound > 1:
            raise ValueError(text)
    return Smoothed(system, eps, kind, raised)


def banded(system: System, eta: Any, rate: Any = 1.0) -> System:
    """The switch model: a surface that attracts is replaced by a band |h| <= η. Leine (2000), (2.31), (3.35).

        slip          s = sgn(h)                               outside the band
        stick         s = λ, so that dh/dt = -rate h           inside it, while |λ| <= b
        transition    s = sgn(λ)                               inside it, else

    Here b is the breakaway bound, and λ what (2.20) gives plus the pull to the middle of the band. In the transition
    the slip force acts in the direction of the force that broke the stick. Section 2.4 pushes with b sgn(λ): the same
    for b = 1, but for b > 1 that sets out with dh/dt = 0 and leaves the band in a time of order √η, not η. (3.35) takes
    sgn(h), which says nothing in the middle of a band: for b = 1 the field would jump where a stick ends.

    The field is not stiff, but jumps at the edges of the bands, and nothing locates them. The adaptive step size copes
    if its tolerance is well below η; else steps leap over the bands for ever. The solution differs
    from that of `system` by an error of order η, whatever the tolerance. Its derivatives do not converge, as automatic
    differentiation sees nothing of a jump whose instant varies: take them of `system` itself, or `smoothed`. Time must
    run forward.

    A surface that repels, or on which the switch value does not act, has no band: s = sgn(h), and it is crossed. Where
    the solution is in several bands and not all can hold it, the one that violates its bound most is released, and the
    others' multipliers are found anew.

    ```python
    controller = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    sol = nsjax.solve(nsjax.banded(system, 1e-6), 0.0, 40.0, y0, stepsize_controller=controller)
    ```

    **Arguments:**

    - `system`: the model. Its `relay` and `impact` switches remain, and are solved event by event.
    - `eta`: half width η > 0 of the bands [unit of h], one for all switches.
    - `rate`: of the pull to the middle of the band [1 / unit of time]; the thesis takes √(k/m). The error is about
        η / rate; what is faster than the motion itself costs steps. It should exceed the rate at which damping slows a
        motion off the surface (c/m), else leaving the band takes many steps.

    **Returns:** a `System` whose fields are `system`, `eta` and `rate`.

    **Raises:** `ValueError` for an `eta` or `rate` that is not positive, and for a system without a `sgn` switch. A
    runtime error if that shows only when numbers are there.
    """
    check_system(system)
    _check_replaced(system, _sliding(system))
    return Banded(system, _positive("eta", eta), _positive("rate", rate))
