"""Kinks of a continuous vector field, found in its program and made switches.

|h| is h s with s = sgn(h), and so are maximum and minimum: the field's jaxpr is evaluated with switch values put in.
"""

import contextlib
import functools as ft
import itertools
from collections.abc import Callable, Generator
from typing import Any

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics._jaxpr import is_affine, is_constant
from .._numerics._series import _CALLS
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch, forwarded
from ..system._system import arrays_of, SwitchValues, System


_KINKS: dict[str, Callable[..., Any]] = {"abs": jnp.abs, "max": jnp.maximum, "min": jnp.minimum, "clamp": lax.clamp}
_IDLE = {"max": -np.inf, "min": np.inf}  # bounds that never act
_SMOOTH = ("hypot", "logaddexp", "logaddexp2")  # functions of JAX that are smooth, but written with kinks
_MOST = 4  # kinks in which the field is not affine: it is evaluated for each combination of their signs

# One evaluation serves to list kinks, to give the h of one of them (it goes no further), and to put switch values in.
# So it is a generator: it yields the kind and h of each kink, and is sent the value of its switch, or None to leave it.
_Walk = Generator[tuple[str, Array], Array | None, Any]


def _has_kink(e: Any) -> bool:
    if e.primitive.name in _KINKS:
        return jnp.issubdtype(e.outvars[0].aval.dtype, jnp.floating)
    inner = [jaxpr for jaxpr in jex.jaxprs_in_params(e.params) if jaxpr.debug_info.func_name not in _SMOOTH]
    return any(_has_kink(e) for jaxpr in inner for e in jaxpr.eqns)


def _is_known(x: Any) -> bool:
    """Whether it is a number written in the program: these are kept as NumPy arrays."""
    return isinstance(x, np.ndarray)


def _once(seen: dict[Any, Any], name: Any, fn: Callable[..., Any], *x: Any) -> Any:
    """`fn(*x)`, kept with x, so that equal values are one object: kinks on the same surface have one switch."""
    key = (name, *[(v.dtype.str, v.shape, v.tobytes()) if _is_known(v) else id(v) for v in x])
    if key not in seen:
        known = all(map(_is_known, x))
        with jax.ensure_compile_time_eval() if known else contextlib.nullcontext():
            out = fn(*x)
        number = isinstance(out, jax.Array) and jnp.issubdtype(out.dtype, jnp.number)
        seen[key] = np.asarray(out) if known and number else out, x
    return seen[key][0]


def _walk(jaxpr: Any, values: list[Any], seen: dict[Any, Any]) -> _Walk:
    """Evaluates a program."""
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], values))

    def read(v: Any) -> Any:
        return env[v] if isinstance(v, jex.Var) else np.asarray(v.val, v.aval.dtype)

    for e in jaxpr.eqns:
        x, name = [read(v) for v in e.invars], e.primitive.name
        if not _has_kink(e):
            bind = ft.partial(e.primitive.bind, **e.primitive.get_bind_params(e.params))
            out = bind(*x) if e.effects else _once(seen, (name, str(e.params)), bind, *x)
            out = out if e.primitive.multiple_results else [out]
        elif name in _CALLS:
            (inner,) = (p for p in e.params.values() if isinstance(p, jex.ClosedJaxpr))
            out = yield from _walk(inner.jaxpr, [*inner.consts, *x], seen)
        elif name == "clamp":
            raised = yield from _kink("max", [x[1], x[0]], seen)
            out = [(yield from _kink("min", [raised, x[2]], seen))]
        elif name in _KINKS:
            out = [(yield from _kink(name, x, seen))]
        else:
            raise ValueError(
                f"A kink (abs, maximum, minimum, clip) inside `{name}` cannot be marked, because it may be met any "
                "number of times. Write the vector field without the loop or branch, or declare the kink as a `sgn` "
                "switch."
            )
        env.update(zip(e.outvars, out))
    return [read(v) for v in jaxpr.outvars]


def _kink(kind: str, x: list[Any], seen: dict[Any, Any]) -> _Walk:
    """|h|, or the greater or smaller of two numbers whose difference is h."""
    x = sorted(x, key=_is_known)  # the surface 0 - x is that of x
    if _is_known(x[0]):
        return _once(seen, kind, _KINKS[kind], *x)
    bound = x[1] if len(x) > 1 and _is_known(x[1]) else None
    if bound is not None and np.all(bound == _IDLE[kind]):
        return _once(seen, "spread", lambda a, b: jnp.broadcast_to(a, jnp.broadcast_shapes(a.shape, b.shape)), *x)
    alone = len(x) == 1 or bound is not None and bound.ndim == 0 and bound == 0
    h = x[0] if alone else _once(seen, ("sub", "{}"), jnp.subtract, *x)  # as the program's own a - b is known
    if ("switch", id(h)) not in seen:
        seen["switch", id(h)] = (yield kind, h), h
    s, _ = seen["switch", id(h)]
    if s is None:
        return _once(seen, kind, _KINKS[kind], *x)
    size = _once(seen, "size", jnp.multiply, h, s)
    if len(x) == 1:
        return size
    return _once(seen, kind, lambda a, b, size: (a + b + (size if kind == "max" else -size)) / 2, *x, size)


def _program(system: System, t: Any, y: Y, s: Any) -> _Walk:
    """The vector field, for the values `s` of the system's own switches."""
    dtype = jnp.result_type(*jax.tree.leaves(y))
    system = arrays_of(system, dtype)
    args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (t, y, s))
    closed, f = jax.make_jaxpr(lambda t, y, s: system.vector_field(t, y, system.values(s)), return_shape=True)(*args)
    out = yield from _walk(closed.jaxpr, [*closed.consts, *jax.tree.leaves(args)], {})
    return jax.tree.unflatten(jax.tree.structure(f), [jnp.asarray(x) for x in out])


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
