"""The folder in which a long sweep keeps what it has done: a file for each block, written whole or not at all.

    sweep.json          what the sweep is: whoever computes another one is refused
    blocks/00000017.npz the leaves of what the function returned, for the lanes of a block
    claims/00000017     who is computing a block
    result/3.npy        one leaf of all lanes, put together when it is asked for

Nothing in it is ever changed: a file is written under another name, and renamed when it is complete. So whatever is
there under its name is right, whenever a process was killed, and two processes that write the same file do no harm.
"""

import contextlib
import json
import os
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np


class Folder:
    def __init__(self, path: Any, token: str):
        self.path, self._token = pathlib.Path(path), token
        self.blocks, self.claims = self.path / "blocks", self.path / "claims"

    def open(self, header: dict[str, Any]) -> dict[str, Any]:
        """What the folder says of its sweep, which is `header` if it says nothing yet."""
        for folder in (self.blocks, self.claims):
            folder.mkdir(parents=True, exist_ok=True)
        place = self.path / "sweep.json"
        if not place.exists():
            # Several processes may come here at once, and the first one tells the others.
            with self._written(place, first=True) as file:
                file.write(json.dumps(header, indent=1).encode())
        try:
            found = json.loads(place.read_bytes())
            _ = [found[key] for key in header]
        except (ValueError, TypeError, LookupError) as error:
            raise ValueError(f"The file {place} is damaged, or nsjax did not write it.") from error
        return found

    @contextlib.contextmanager
    def _written(self, place: pathlib.Path, first: bool = False) -> Iterator[Any]:
        """A file that is there when it is complete; with `first` not in the place of one that is there already."""
        part = place.with_name(f"{place.name}.{self._token}.part")
        try:
            with open(part, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if first:
                _link(part, place)
            else:
                os.replace(part, place)
        finally:
            part.unlink(missing_ok=True)
        _sync(place.parent)

    def sweep_up(self, token: str) -> None:
        """Removes what a process that is no more left half done."""
        for pattern in (f"blocks/*.{token}.part", f"result/*.{token}.part", f"claims/{token}.*.clock"):
            for left in self.path.glob(pattern):
                left.unlink(missing_ok=True)

    def block(self, number: int) -> pathlib.Path:
        return self.blocks / f"{number:08d}.npz"

    def has(self, number: int) -> bool:
        return self.block(number).exists()

    def done(self) -> set[int]:
        """The blocks that are there."""
        names = (entry.name for entry in os.scandir(self.blocks))
        return {int(name[:8]) for name in names if len(name) == 12 and name.endswith(".npz")}

    def write(self, number: int, leaves: list[np.ndarray]) -> None:
        with self._written(self.block(number)) as file:
            np.savez(file, **{str(i): leaf for i, leaf in enumerate(leaves)})

    def read(self, number: int, leaf: int) -> np.ndarray:
        """One leaf of a block."""
        with np.load(self.block(number), allow_pickle=False) as file:
            return file[str(leaf)]

    def whole(self, leaf: int, shape: tuple[int, ...], dtype: Any, blocks: int) -> np.ndarray:
        """One leaf of all lanes, as an array on the disk."""
        place = self.path / "result" / f"{leaf}.npy"
        if not place.exists():
            place.parent.mkdir(exist_ok=True)
            # (Pages that are mapped for writing would count as memory of this process.)
            with self._written(place) as file:
                header = dict(descr=np.lib.format.dtype_to_descr(np.dtype(dtype)), fortran_order=False, shape=shape)
                np.lib.format.write_array_header_1_0(file, header)
                for number in range(blocks):
                    file.write(np.ascontiguousarray(self.read(number, leaf)).data)
        return np.load(place, mmap_mode="r" if np.prod(shape) else None, allow_pickle=False)


def _link(part: pathlib.Path, place: pathlib.Path) -> None:
    try:
        os.link(part, place)
    except FileExistsError:
        pass
    except OSError:  # a file system without links
        if not place.exists():
            os.replace(part, place)


def _sync(folder: pathlib.Path) -> None:
    """So that a name outlasts a power failure too, where a folder can be opened."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
