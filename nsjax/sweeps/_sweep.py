"""`sweep`: a function of one lane applied to many, in chunks of a size at which a processor is fastest."""

import contextlib
import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from .._numerics._compile import eager, interactive, long_running, MANY
from .._numerics._first_pass import first_pass, told, UnreachableError, whole_pass
from .._numerics._progress import Counting, ProgressMeter, QUIET, Told
from .._numerics._text import known, positive
from ._chunks import in_chunks
from ._devices import Device, DeviceQueue, Devices, devices_of
from ._lanes import default_chunk, even_chunks, Lanes, lanes_of
from ._piece import MOST, Piece
from ._sharded import sharded, spread_over


PIECES = 64  # of a sweep, from which on a piece is of several chunks: each costs a tenth of a millisecond of Python

Tell = Callable[[int], Any]


@long_running
def _run(fn: Callable[..., Any], mapped: Any, rest: Any, chunk: int) -> Any:
    with whole_pass():
        return in_chunks(fn, mapped, rest, chunk)


@ft.partial(interactive, host=True)
def _few(fn: Callable[..., Any], mapped: Any, rest: Any, chunk: int) -> Any:
    with whole_pass():
        return in_chunks(fn, mapped, rest, chunk)


@long_running
def _first(fn: Callable[..., Any], mapped: Any, rest: Any, chunk: int) -> tuple[Any, Any]:
    """What a small program makes of it, and which lanes it leaves over; None if there can be none."""
    with first_pass():
        return in_chunks(told(fn), mapped, rest, chunk)


def sweep(
    fn: Callable[..., Any],
    *args: Any,
    chunk: int | None = None,
    devices: Devices | None = None,
    progress_meter: ProgressMeter = QUIET,
) -> Any:
    """Applies `fn` to every lane: `jax.vmap(fn)(*args)`, but compiled, and in chunks, which on a CPU is faster for
    thousands of lanes, and works in the memory of one chunk; and on several devices, if there are.

    ```python
    def final(v_dr):
        return nsjax.solve(StickSlip(v_dr=v_dr), 0.0, 100.0, State(2.5, 0.0), throw=False).y1

    y1 = nsjax.sweep(final, jnp.linspace(0.1, 1.0, 4096))  # y1.x has shape (4096,)
    ```

    If `fn` names no solver, models are solved by that of `nsjax.method_for`: `nsjax.Affine` where the model is affine
    between events. Called directly, a sweep does so by a small program first; `fn` is traced a second time for lanes in
    which something is not plain.

    Derivatives go through it (`jax.jacfwd`, and `jax.grad` if `fn` allows it), and it may stand within `jax.jit`.
    For sweeps that take hours there is `Sweep`, which keeps what it has done.

    **Arguments:**

    - `fn`: a function of one lane, returning any pytree of arrays and numbers.
    - `args`: its arguments, any pytrees, such as a state or a `System`. Arrays of shape `(lanes, ...)` are mapped over
        their first axis; numbers and arrays of shape `()` are the same in every lane, and so is everything else.
        A parameter that is itself an array, the same in every lane, belongs into `fn`.
    - `chunk`: how many lanes go together; by default 256 on a CPU, and on other devices all that a device has.
    - `devices`: on which devices. By default on that on which JAX computes; and if the lanes of an argument are spread
        over several devices (a `NamedSharding` along its first axis), on these, where each keeps its share.
        A number of devices, or a list of them: pieces of the sweep are handed out to whichever is free, and the result
        is where it would be without, bit for bit the same for any number of devices. (The cores of a CPU are devices
        after `jax.config.update("jax_num_cpu_devices", n)`.) Derivatives are then to be taken within `fn`.
        A `jax.sharding.Mesh`: the lanes are spread along all its axes, and so is the result if their number can be
        divided evenly; within `jax.jit` and derivatives too, and over the processes of `jax.distributed`.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many lanes are done, how
        many in a second, and how long the others will take; `diffrax.TqdmProgressMeter()` draws a bar; a function is
        called with that after each piece. Pieces are then handed out as with `devices`, to one if none are given.

    **Returns:** what `fn` returned, with a first axis of length `lanes`.

    **Raises:** `ValueError` if the arrays are of different lengths along their first axes, or if there are none; for
    `devices` that there are not, and for a number or a list of devices within `jax.jit`, `jax.vmap` and derivatives.
    """
    if chunk is not None:
        positive("chunk", chunk)
    lanes = lanes_of(args)
    if Told(progress_meter):
        return _counted(fn, lanes, chunk, devices, progress_meter)
    if isinstance(devices, Mesh):
        return sharded(fn, lanes, chunk, devices, devices.axis_names)
    if devices is not None:
        return _handed_out(fn, lanes, chunk, devices)
    spread = spread_over(lanes.mapped)
    if spread is not None:
        return sharded(fn, lanes, chunk, *spread)
    if chunk is None:
        chunk = default_chunk(lanes.number, jax.default_backend())
    if lanes.number and eager() and known((fn, lanes)):
        with contextlib.suppress(UnreachableError):
            return _in_passes(fn, lanes, chunk)
    return _run(fn, jax.tree.map(jnp.asarray, lanes.mapped), lanes.rest, chunk)


def _in_passes(fn: Callable[..., Any], lanes: Lanes, chunk: int) -> Any:
    """By a small program, if there is one for what `fn` does, and by the whole one those lanes that it leaves over."""
    mapped = jax.tree.map(jnp.asarray, lanes.mapped)
    try:
        out, left = _first(fn, mapped, lanes.rest, chunk)
        which = [] if left is None else np.flatnonzero(left)
    except RuntimeError:  # of a lane that is left over, perhaps: a check of the user's own
        _, left = jax.eval_shape(lambda mapped: _first(fn, mapped, lanes.rest, chunk), mapped)
        if left is None:
            raise
        return _run(fn, mapped, lanes.rest, chunk)
    if not len(which):
        return out
    if any(jnp.issubdtype(x.dtype, jax.dtypes.extended) for x in jax.tree.leaves(out)):  # random keys
        return _run(fn, mapped, lanes.rest, chunk)
    found = _again(fn, Lanes(lanes.on_host().rows(which), lanes.rest, len(which)), even_chunks(lanes.number, chunk)[1])

    def completed(all: Any, some: Any) -> Any:
        whole = np.array(all)
        whole[which] = some
        return jnp.asarray(whole)

    return jax.tree.map(completed, out, found)


def _again(fn: Callable[..., Any], lanes: Lanes, chunk: int) -> Any:
    """By the whole program, whatever their number: compiled quickly, if they are few."""
    if lanes.number > MANY:
        return in_pieces(fn, lanes, chunk, 1, devices_of(None), first=False)
    filled = lanes.rows(np.minimum(np.arange(MANY), lanes.number - 1))
    return jax.tree.map(lambda x: x[: lanes.number], _few(fn, jax.tree.map(jnp.asarray, filled), lanes.rest, MANY))


def _counted(fn: Callable[..., Any], lanes: Lanes, chunk: int | None, devices: Any, meter: ProgressMeter) -> Any:
    if isinstance(devices, Mesh) or not (eager() and known((fn, lanes))):
        raise ValueError(
            "Argument `progress_meter` of `nsjax.sweep` is for sweeps in pieces: not within `jax.jit`, `jax.vmap` and "
            "derivatives, and not over a `jax.sharding.Mesh`. Leave it out there."
        )
    with Counting(meter, lanes.number, "lanes") as counting:
        own = devices_of(None) if devices is None else devices
        return _handed_out(fn, lanes, chunk, own, counting.at)


def _handed_out(fn: Callable[..., Any], lanes: Lanes, chunk: int | None, devices: Any, tell: Tell | None = None) -> Any:
    if not (eager() and known((fn, lanes))):
        raise ValueError(
            "Argument `devices` of `nsjax.sweep` must be a `jax.sharding.Mesh` within `jax.jit`, `jax.vmap` and "
            f'derivatives, but is {devices!r}. Write `devices=jax.make_mesh((n,), ("lanes",))`, or let what is swept '
            "return the derivative: `nsjax.sweep(jax.jacfwd(fn), x, devices=n)`."
        )
    found = devices_of(devices)
    if chunk is None:
        chunk = default_chunk(-(-lanes.number // len(found)), found[0].platform)
    chunks, chunk = even_chunks(lanes.number, chunk)
    if not lanes.number:
        return _run(fn, jax.tree.map(jnp.asarray, lanes.mapped), lanes.rest, 1)
    return in_pieces(fn, lanes, chunk, min(MOST, -(-chunks // PIECES)), found, tell)


def in_pieces(
    fn: Callable[..., Any],
    lanes: Lanes,
    chunk: int,
    together: int,
    found: list[Device],
    tell: Tell | None = None,
    *,
    first: bool = True,
) -> Any:
    """Pieces of so many chunks `together`, each on the device that is free first. `tell` is called with the number of
    lanes that are done. A `first` pass may do with a smaller program."""
    found = found[: -(-lanes.number // (chunk * together))]  # a device without a piece needs no program
    piece, lanes = Piece(fn, lanes, chunk, together, found, first=first), lanes.on_host()
    out = [np.empty((lanes.number, *form.shape), form.dtype) for form in piece.program.forms]
    starts = range(0, lanes.number, piece.size)
    with DeviceQueue(found) as each:
        futures = [
            each.submit(lambda device, i=i: piece.run(lanes.rows(slice(i, i + piece.size)), device)) for i in starts
        ]
        for start, future in zip(starts, futures):
            for whole, part in zip(out, future.result()):
                whole[start : start + len(part)] = part
            if tell is not None:
                tell(min(start + piece.size, lanes.number))
    return jax.tree.unflatten(piece.program.tree, [jnp.asarray(x) for x in out])
