"""A piece of a sweep: some chunks of lanes, by one program that is compiled once for each device."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np

from .._numerics._compile import without_collection
from ._devices import Device
from ._lanes import Lanes


class Piece:
    """The program of a piece: up to `chunks` chunks of `chunk` lanes, as many as there are.

    The program does not know how many lanes there are in all, nor who computes the others. So a lane has the same bits
    whichever device, thread or process it falls to, and whatever was done before.
    """

    def __init__(self, fn: Callable[..., Any], lanes: Lanes, chunk: int, chunks: int, devices: Sequence[Device]):
        self.chunk, self.size = chunk, chunk * chunks
        # What is traced is the same for all pieces; it is brought to each device once.
        self.shared, static = eqx.partition((fn, lanes.rest), eqx.is_array)
        program = jax.jit(_program(static, chunk, chunks))
        with without_collection():
            # Lowered here and not in the threads, which do not see settings that are made by `with jax.enable_x64():`.
            traced = [program.trace(*self._forms(lanes.mapped, device)) for device in devices]
            lowered = [one.lower() for one in traced]
        self.consts, self.lowered = traced[0].jaxpr.consts, lowered[0]
        out, self.tree = jax.tree.flatten(lowered[0].out_info)
        self.forms = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in out]
        if any(jnp.issubdtype(form.dtype, jax.dtypes.extended) for form in self.forms):
            raise TypeError("What `fn` returns must be numbers: of a random key return `jax.random.key_data(key)`.")
        self.platform = devices[0].platform
        self._lowered = dict(zip(devices, lowered))
        self._compiled: dict[Device, tuple[Any, Any]] = {}
        self._locks = {device: threading.Lock() for device in devices}

    def _forms(self, mapped: Any, device: Device) -> tuple[Any, Any, Any]:
        place = jax.sharding.SingleDeviceSharding(device)

        def form(x: Any, rows: int | None = None) -> jax.ShapeDtypeStruct:
            aval = jax.typeof(x if rows is None else x[:0])
            shape = aval.shape if rows is None else (rows, *aval.shape[1:])
            return jax.ShapeDtypeStruct(shape, aval.dtype, sharding=place, weak_type=aval.weak_type)

        pieces = jax.tree.map(lambda x: form(x, self.size), mapped)
        return jax.tree.map(form, self.shared), pieces, form(jnp.zeros((), jnp.int32))

    def _on(self, device: Device) -> tuple[Any, Any]:
        """The compiled program, and what it shares with all pieces."""
        with self._locks[device]:
            if device not in self._compiled:
                compiled = self._lowered.pop(device).compile()
                self._compiled[device] = compiled, jax.device_put(self.shared, device)
            return self._compiled[device]

    def run(self, mapped: Any, device: Device) -> list[np.ndarray]:
        """The leaves of what `fn` returns, for up to `size` lanes."""
        number = len(jax.tree.leaves(mapped)[0])
        compiled, shared = self._on(device)
        full = jax.tree.map(lambda x: jax.device_put(_filled(x, self.size), device), mapped)
        count = jax.device_put(np.int32(-(-number // self.chunk)), device)
        return [np.asarray(x)[:number] for x in jax.tree.leaves(compiled(shared, full, count))]


def _filled(x: Any, size: int) -> Any:
    """With its last row again and again: what is computed there is what was computed already."""
    short = size - len(x)
    if not short:
        return x
    join = jnp.concatenate if isinstance(x, jax.Array) else np.concatenate
    return join([x, *[x[-1:]] * short])


def _program(static: Any, chunk: int, chunks: int) -> Callable[..., Any]:
    def program(shared: Any, mapped: Any, count: Any) -> Any:
        fn, rest = eqx.combine(shared, static)
        # (As a program of its own it is traced once, though it is asked for its shapes first.)
        lanes = jax.jit(jax.vmap(lambda mapped: fn(*eqx.combine(mapped, rest))))
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

    return program
