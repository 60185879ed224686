"""Who computes which block of a sweep: a file that only one process can make, and that it touches while it lives.

A claim is a courtesy, not a lock: it keeps processes from doing the same work. Where it fails (a process that slept for
long, a file system that is late) two compute the same block, and write the same file.
"""

import contextlib
import functools as ft
import json
import os
import pathlib
import socket
import threading
import uuid
from typing import Any, NamedTuple, Self


class Owner(NamedTuple):
    """A process."""

    host: str  # a machine, since its last start, and the processes that see one another on it
    pid: int
    began: str  # when the process did: its number may be another's by now
    token: str  # a name for files, of this process only

    @property
    def dead(self) -> bool:
        """Whether it is known to be: on this machine, and no more there."""
        if self.host != _host():
            return False
        began = _began(self.pid)
        return began is None or began != self.began


@ft.cache
def _host() -> str:
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(pathlib.Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with contextlib.suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(parts)


def _began(pid: int) -> str | None:
    """None if there is no such process, "" where the system does not tell."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:  # another user's
        pass
    try:
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return None if fields[0] in "ZX" else fields[19]  # one that has ended, and waits for its parent to notice


def myself() -> Owner:
    pid = os.getpid()
    return Owner(_host(), pid, _began(pid) or "", uuid.uuid4().hex[:12])


class Claims:
    """The claims in a folder, and those that are this process's own, which a thread keeps fresh.

    **Arguments:**

    - `stale`: for how long a claim is respected after it was last touched [s].
    - `gone`: called with the token of a process whose claim was taken over.
    """

    def __init__(self, folder: pathlib.Path, owner: Owner, stale: float, gone: Any):
        self.folder, self.owner, self.stale, self._gone = folder, owner, stale, gone
        self._clock = folder / f"{owner.token}.{uuid.uuid4().hex[:12]}.clock"
        self._own: set[int] = set()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._keep_fresh, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *failure: Any) -> None:
        self._end.set()
        self._thread.join()
        for number in list(self._own):
            self.release(number)
        self._clock.unlink(missing_ok=True)

    def place(self, number: int) -> pathlib.Path:
        return self.folder / f"{number:08d}"

    def take(self, number: int) -> bool:
        """Whether the block is now this process's to compute."""
        if self._create(number):
            return True
        found = self._look(number)
        if found is None:  # released just now
            return self._create(number)
        return self._is_stale(*found) and self._remove(number, found[0]) and self._create(number)

    def _is_stale(self, owner: Owner | None, age: float) -> bool:
        return age > self.stale or (owner is not None and owner.dead)

    def _create(self, number: int) -> bool:
        try:
            handle = os.open(self.place(number), os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            return False
        with os.fdopen(handle, "wb") as file:
            file.write(json.dumps(self.owner).encode())
        self._own.add(number)
        return True

    def _look(self, number: int) -> tuple[Owner | None, float] | None:
        """Whose claim it is, if it says so, and how long ago it was touched by the clock of the file system, which
        machines have in common; None if there is none. (It is opened first: what a network's file system says of a file
        that is not may be a minute old.)"""
        try:
            with open(self.place(number), "rb") as file:
                text, touched = file.read(), os.fstat(file.fileno()).st_mtime
        except FileNotFoundError:
            return None
        self._clock.touch()
        age = self._clock.stat().st_mtime - touched
        try:
            return Owner(*json.loads(text)), age
        except (ValueError, TypeError):  # made this moment, or cut off
            return None, age

    def _remove(self, number: int, owner: Owner | None) -> bool:
        """Of several processes that find a claim stale one can rename it."""
        place, aside = self.place(number), self.folder / f"{number:08d}.{self.owner.token}.stale"
        try:
            os.rename(place, aside)
        except FileNotFoundError:
            return False
        taken = aside.read_bytes()
        if owner is not None and taken != json.dumps(owner).encode():
            # Another process was faster, and this was its fresh claim: it is given back.
            with contextlib.suppress(OSError):
                os.link(aside, place)
            aside.unlink(missing_ok=True)
            return False
        aside.unlink(missing_ok=True)
        if owner is not None:
            self._gone(owner.token)
        return True

    def release(self, number: int) -> None:
        """If it is this process's own."""
        if number not in self._own:
            return
        self._own.discard(number)
        found = self._look(number)
        if found is not None and found[0] == self.owner:
            self.place(number).unlink(missing_ok=True)

    def living(self) -> set[int]:
        """The blocks that some process is computing, this one too."""
        found = set()
        for entry in os.scandir(self.folder):
            if entry.name.isdigit() and len(entry.name) == 8:
                looked = self._look(int(entry.name))
                if looked is not None and not self._is_stale(*looked):
                    found.add(int(entry.name))
        self._clock.unlink(missing_ok=True)
        return found

    def _keep_fresh(self) -> None:
        while not self._end.wait(self.stale / 5):
            for number in list(self._own):
                with contextlib.suppress(OSError):  # taken over, as this process was asleep
                    os.utime(self.place(number))
