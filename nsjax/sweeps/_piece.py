"""A piece of a sweep: some chunks of lanes, by one program that is compiled once for each device."""

import collections
import contextlib
import functools as ft
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np

from .._numerics._compile import swept, without_collection
from .._numerics._first_pass import first_pass, told, UnreachableError, whole_pass
from .._numerics._settings import settings
from ._devices import Device
from ._lanes import Lanes


KEPT = 16  # programs
MOST = 16  # chunks: so many that handing a piece out costs little, so few that no device waits long for another


class Piece:
    """Up to `chunks` chunks of `chunk` lanes, as many as there are.

    The program does not know how many lanes there are in all, nor who computes the others. So a lane has the same bits
    whichever device, thread or process it falls to, and whatever was done before. What the `first` pass leaves over is
    computed `again`, by another program.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        lanes: Lanes,
        chunk: int,
        chunks: int,
        devices: Sequence[Device],
        *,
        first: bool = True,
    ):
        self.chunk, self.size, self.platform = chunk, chunk * chunks, devices[0].platform
        # What is the same for all pieces is brought to each device once.
        self._shared, static = eqx.partition((fn, lanes.rest), eqx.is_array)
        self._there: dict[Device, Any] = {}
        found = ft.partial(_program_for, static, self._shared, lanes.mapped, _How(chunk, chunks, tuple(devices)))
        self.program = found(first)
        self.again = found(False) if self.program.tells else None

    @property
    def programs(self) -> list["Program"]:
        return [self.program] if self.again is None else [self.program, self.again]

    def run(self, mapped: Any, device: Device) -> list[np.ndarray]:
        """The leaves of what `fn` returns, for up to `size` lanes. Each device has a thread that calls it."""
        if self.again is None:
            return self._run(self.program, mapped, device)
        try:
            *leaves, left = self._run(self.program, mapped, device)
        except RuntimeError:  # of a lane that is left over, perhaps: a check of the user's own
            return self._run(self.again, mapped, device)
        which = np.flatnonzero(left)
        if len(which):
            leaves = [leaf.copy() for leaf in leaves]
            more = self._run(self.again, jax.tree.map(lambda x: x[which], mapped), device)
            for leaf, part in zip(leaves, more, strict=True):
                leaf[which] = part
        return leaves

    def _run(self, program: "Program", mapped: Any, device: Device) -> list[np.ndarray]:
        number = len(jax.tree.leaves(mapped)[0])
        compiled = program.on(device)
        if device not in self._there:
            self._there[device] = jax.device_put(self._shared, device)
        full = jax.tree.map(lambda x: jax.device_put(_filled(x, self.size), device), mapped)
        count = jax.device_put(np.int32(-(-number // self.chunk)), device)
        return [np.asarray(x)[:number] for x in jax.tree.leaves(compiled(self._there[device], full, count))]


def _filled(x: Any, size: int) -> Any:
    """With its last row again and again: what is computed there is what was computed already."""
    short = size - len(x)
    if not short:
        return x
    join = jnp.concatenate if isinstance(x, jax.Array) else np.concatenate
    return join([x, *[x[-1:]] * short])


class Program:
    """What is compiled.

    **Attributes:**

    - `text`, `consts`: it, and the arrays that it holds.
    - `tree`, `forms`: the structure of what `fn` returns, and the shapes and dtypes of its leaves for one lane.
    - `tells`: whether it returns beside that which lanes it has left over.
    """

    def __init__(self, function: Callable[..., Any], forms: Any, devices: Sequence[Device]):
        def placed(device: Device) -> Any:
            place = jax.sharding.SingleDeviceSharding(device)
            kind = jax.ShapeDtypeStruct
            return jax.tree.map(lambda x: kind(x.shape, x.dtype, sharding=place, weak_type=x.weak_type), forms)

        jitted = jax.jit(function)
        with without_collection():
            # Lowered here and not in the threads, which do not see settings that are made by `with jax.enable_x64():`.
            traced = [jitted.trace(*placed(device)) for device in devices]
            lowered = [one.lower() for one in traced]
        self.consts, self._first = traced[0].jaxpr.consts, lowered[0]
        result, left = lowered[0].out_info
        self.tells = left is not None
        out, self.tree = jax.tree.flatten(result)
        self.forms = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in out]
        if any(jnp.issubdtype(form.dtype, jax.dtypes.extended) for form in self.forms):
            raise TypeError("What `fn` returns must be numbers: of a random key return `jax.random.key_data(key)`.")
        self._lowered = dict(zip(devices, lowered))
        self._compiled: dict[Device, Any] = {}
        self._locks = {device: threading.Lock() for device in devices}

    @property
    def text(self) -> str:
        return self._first.as_text()

    def on(self, device: Device) -> Any:
        """Compiled for a device, on the first call."""
        with self._locks[device]:
            if device not in self._compiled:
                self._compiled[device] = self._lowered.pop(device).compile(swept())
            return self._compiled[device]


class _How(NamedTuple):
    chunk: int
    chunks: int
    devices: tuple[Device, ...]


_kept: collections.OrderedDict[Any, Program] = collections.OrderedDict()


def _program_for(static: Any, shared: Any, mapped: Any, how: _How, first: bool) -> Program:
    """The one of an earlier call, where all is the same, as `jax.jit` would have it."""

    def form(x: Any) -> jax.ShapeDtypeStruct:
        aval = jax.typeof(x)
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)

    def rows(x: Any) -> jax.ShapeDtypeStruct:
        one = form(x[:0])
        return jax.ShapeDtypeStruct((how.chunk * how.chunks, *one.shape[1:]), one.dtype, weak_type=one.weak_type)

    def made() -> Program:
        if first:
            with contextlib.suppress(UnreachableError), first_pass():
                return Program(_function(static, how, told), forms, how.devices)
        with whole_pass():
            return Program(_function(static, how, lambda fn: lambda *args: (fn(*args), None)), forms, how.devices)

    forms = jax.tree.map(form, shared), jax.tree.map(rows, mapped), form(np.int32(0))
    (own, own_tree), (flat, tree) = jax.tree.flatten(static), jax.tree.flatten(forms)
    types = tuple((x.shape, x.dtype, x.weak_type) for x in flat)
    # (Of a number with its type: True is 1, and another program.)
    key = tuple((type(x), x) for x in own), own_tree, types, tree, how, first, settings()
    try:
        found = _kept.pop(key, None)
    except TypeError:  # the function holds what cannot be compared
        return made()
    program = found or made()
    _kept[key] = program
    while len(_kept) > KEPT:
        _kept.popitem(last=False)
    return program


def _function(static: Any, how: _How, wrap: Callable[..., Any]) -> Callable[..., Any]:
    chunk, chunks = how.chunk, how.chunks

    def piece(shared: Any, mapped: Any, count: Any) -> Any:
        fn, rest = eqx.combine(shared, static)
        # (As a program of its own it is traced once, though it is asked for its shapes first.)
        lanes = jax.jit(jax.vmap(lambda mapped: wrap(fn)(*eqx.combine(mapped, rest))))
        if chunks == 1:
            return lanes(mapped)

        def taken(i: Any) -> Any:
            return jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, i * chunk, chunk), mapped)

        def further(i: Any, out: Any) -> Any:
            return jax.tree.map(
                lambda all, some: lax.dynamic_update_slice_in_dim(all, some, i * chunk, 0), out, lanes(taken(i))
            )

        form = jax.eval_shape(lambda: lanes(taken(0)))
        out = jax.tree.map(lambda x: jnp.zeros((chunk * chunks, *x.shape[1:]), x.dtype), form)
        return lax.fori_loop(0, count, further, out)

    return piece
