"""Kinks of a continuous vector field, made switches: |h| is h s with s = sgn(h), and so are maximum and minimum."""

import functools as ft
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics._jaxpr import is_affine, is_constant
from .._numerics._kinks import evaluate, Walk
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch, forwarded
from ..system._system import arrays_of, SwitchValues, System


_MOST = 4  # kinks in which the field is not affine: it is evaluated for each combination of their signs


def _program(system: System, t: Any, y: Y, s: Any) -> Walk:
    """The vector field, for the values `s` of the system's own switches."""
    dtype = jnp.result_type(*jax.tree.leaves(y))
    system = arrays_of(system, dtype)
    args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (t, y, s))
    return evaluate(lambda t, y, s: system.vector_field(t, y, system.values(s)), *args)


@ft.cache  # switches are told apart by identity
def _switch(kink: int, entry: int, name: str) -> sgn:
    def guard(self: "Marked", t: Scalar, y: Y) -> Scalar:
        walk = _program(self.system, t, y, (0.0,) * len(self.system.switches))
        _, h = next(itertools.islice(walk, kink, None))  # no further than that
        return lax.index_in_dim(h.reshape(-1), entry, keepdims=False) if h.ndim else h

    return sgn(guard, name=name)


class Marked(System):
    """See `mark_kinks`."""

    system: System
    kinks: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...] = eqx.field(static=True)  # shapes, names of the entries
    bent: tuple[str, ...] = eqx.field(static=True)  # of those in which the field is not affine

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        def field(bent: tuple[str, ...], values: dict[str, Any]) -> Y:
            if not bent:
                return self._field(t, y, values)
            below, above = (field(bent[1:], values | {bent[0]: side}) for side in (-1.0, 1.0))
            q = (1 + values[bent[0]]) / 2
            return jax.tree.map(lambda a, b: (1 - q) * a + q * b, below, above)

        return field(self.bent, {k.name: s[k.name] for k in self.switches})

    @property
    def jumps_in_time(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.jumps_in_time

    def _field(self, t: Scalar, y: Y, values: dict[str, Any]) -> Y:
        walk, sent = _program(self.system, t, y, tuple(values[k.name] for k in self.system.switches)), None
        for shape, names in (*self.kinks, (None, ())):
            try:
                _, h = walk.send(sent)
            except StopIteration as end:
                if shape is None:
                    return end.value
                break
            if h.shape != shape:
                break
            sent = jnp.stack([jnp.asarray(values[n], h.dtype) for n in names]).reshape(shape)
        raise ValueError(
            f"`{type(self.system).__name__}.vector_field` has other kinks here than where `mark_kinks` found them: "
            "`y0` must be of the structure and shapes of the state."
        )

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        own = [forwarded(k) for k in self.system.switches]
        return (*own, *[_switch(i, j, name) for i, (_, names) in enumerate(self.kinks) for j, name in enumerate(names)])

    @property
    def period(self) -> Float[Array, ""] | float | None:
        return self.system.period


def mark_kinks(system: System, y0: Y) -> System:
    """The same system with a `sgn` switch for each kink of its vector field, which is written with `jnp.abs`,
    `jnp.maximum`, `jnp.minimum`, `jnp.clip` or `jax.nn.relu`.

    So it is solved event by event, can be `smoothed`, and has a `generalized_jacobian` for `eigenvalue_crossings`:

        |h| = h s        max(a, b) = (a + b + h s)/2        min(a, b) = (a + b - h s)/2,    h = a - b

    with s = sgn(h). A clip has two, kinks at the same h share one. Where the field is not affine in s, as max(0, x)² or
    exp(-|x|), it is put linearly between what it is for s = -1 and s = 1 (that must be finite: not √|x|).

    ```python
    class Support(nsjax.System):
        def vector_field(self, t, y, s):
            return State(y.v, -y.x - 3.0 * jnp.maximum(y.x - 1.0, 0.0))


    system = nsjax.mark_kinks(Support(), State(0.5, 0.0))  # its switch is max_1, with h = x - 1
    ```

    `jnp.sign` is a jump, not a kink: it stays as it is, unseen by `solve`, and so do `jnp.where`, `jnp.floor` and the
    largest entry of an array. Declare `sgn` switches for them. `jnp.hypot` and `jax.nn.softplus`, which JAX writes with
    kinks but are smooth, are left alone; others that are so have events for nothing.

    **Arguments:**

    - `system`: the model.
    - `y0`: a state, for its structure and shapes.

    **Returns:** a `System` whose parameters are those of its field `system`, and whose switches are the own ones, then
    the new: `abs_1`, `max_2`, numbered in the order of the program, and `abs_1_0`, `abs_1_1`, for entries of an array.

    **Raises:** `ValueError` where there is no kink; for one inside a loop or branch (`lax.scan`, `lax.cond`), or whose
    h depends on the value of a switch; and where the field is not affine in more than four of them.
    """
    t, y, _ = checked_start(system, 0.0, y0, None)
    field, own, zero = f"`{type(system).__name__}.vector_field`", [k.name for k in system.switches], jnp.zeros_like(t)
    kinks: list[tuple[tuple[int, ...], tuple[str, ...]]] = []
    for kind, h in _program(system, t, y, (zero,) * len(own)):
        name, entries = f"{kind}_{len(kinks) + 1}", [f"_{j}" for j in range(h.size)] if h.ndim else [""]
        while any(name + entry in own for entry in entries):
            name += "_"
        kinks.append((h.shape, tuple(name + entry for entry in entries)))
    if not kinks:
        raise ValueError(
            f"Argument `system` must have a kink to be marked, but {field} has no abs, maximum, minimum or clip. Use "
            "it as it is."
        )
    for k, name in enumerate(own):

        def surfaces(s: Scalar) -> list[Array]:
            return [h for _, h in _program(system, t, y, (*[zero] * k, s, *[zero] * (len(own) - k - 1)))]

        if not is_constant(surfaces, zero):
            raise ValueError(
                f"{field} has a kink that depends on `s.{name}`, but a surface is a function of time and state. "
                "Write what is inside abs, maximum, minimum and clip without it."
            )
    marked = Marked(system, tuple(kinks), ())
    zeros = {k.name: zero for k in marked.switches}
    new = [name for _, names in kinks for name in names]
    bent = tuple(n for n in new if not is_affine(lambda s: marked._field(t, y, zeros | {n: s}), zero))
    if len(bent) > _MOST:
        raise ValueError(
            f"{field} must be affine in all but {_MOST} of its kinks, and is not in {', '.join(bent)}. Use them as "
            "terms or factors: not inside a function, in a power, or in a denominator."
        )
    return Marked(system, marked.kinks, bent)
