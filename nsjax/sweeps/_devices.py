"""The devices of a sweep: which they are, and a queue that keeps each of them busy."""

import contextlib
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Self, TypeAlias

import jax
import jax.numpy as jnp
from jax.sharding import Mesh


Device: TypeAlias = Any  # a `jax.Device`, which is a variable to type checkers
Devices: TypeAlias = int | Sequence[Device] | Mesh


def devices_of(devices: Devices | None) -> list[Device]:
    """Those of this process; None is the default one."""
    local = jax.local_devices()
    if devices is None:
        return list(jnp.zeros(()).devices())
    if isinstance(devices, Mesh):
        found = list(devices.devices.flat)
    elif isinstance(devices, bool) or not isinstance(devices, int | list | tuple):
        raise TypeError(
            "Argument `devices` must be a number, a list of devices or a `jax.sharding.Mesh`, but is "
            f"{type(devices).__name__}: {devices!r}."
        )
    elif isinstance(devices, int):
        if not 1 <= devices <= len(local):
            raise ValueError(
                f"Argument `devices` must be a number from 1 to {len(local)}, but is {devices}. To use the cores of a "
                'processor as devices, write `jax.config.update("jax_num_cpu_devices", n)` before anything is computed.'
            )
        found = local[:devices]
    else:
        found = list(devices)
    if not found or not all(isinstance(d, jax.Device) for d in found):
        raise TypeError(f"Argument `devices` must hold devices, such as those of `jax.devices()`, but is {devices!r}.")
    if len(set(found)) < len(found) or len({d.platform for d in found}) > 1:
        raise ValueError(f"Argument `devices` must hold different devices of one platform, but holds {found}.")
    if any(d.process_index != jax.process_index() for d in found):
        raise ValueError(
            "Argument `devices` holds devices of other processes, which this one cannot hand pieces to. Let each "
            "process have a `nsjax.Sweep` with the same folder, or call `nsjax.sweep` with the mesh in all of them."
        )
    return found


class DeviceQueue:
    """A thread for each device, which takes one piece of work after the other. (While it computes, XLA lets go of
    Python's lock.)

    ```python
    with DeviceQueue(devices) as each:
        futures = [each.submit(lambda device: ...) for ...]
        for future in futures:
            future.result()
    ```

    Where the `with` block is left, what was not begun is not done any more.
    """

    def __init__(self, devices: Sequence[Device]):
        self._todo: queue.SimpleQueue[tuple[Future, Callable[[Device], Any]] | None] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=self._work, args=(device,), daemon=True) for device in devices]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __len__(self) -> int:
        """The number of devices."""
        return len(self._threads)

    def submit(self, work: Callable[[Device], Any]) -> Future:
        future: Future = Future()
        self._todo.put((future, work))
        return future

    def _work(self, device: Device) -> None:
        while (item := self._todo.get()) is not None:
            future, work = item
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(work(device))
            except BaseException as error:  # handed to whoever waits for it
                future.set_exception(error)
            del item, future, work  # which may hold much, while the next one is waited for

    def __exit__(self, *failure: Any) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                item = self._todo.get_nowait()
                if item is not None:
                    item[0].cancel()
        for _ in self._threads:
            self._todo.put(None)
        for thread in self._threads:
            thread.join()
