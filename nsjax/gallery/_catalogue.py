"""The systems of the gallery by their names."""

import dataclasses
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from ..system._system import System
from ._applications import APPLICATIONS
from ._entry import Entry
from ._thesis import THESIS


SYSTEMS: Mapping[str, Entry] = MappingProxyType({**THESIS, **APPLICATIONS})
"""All of them: those of the thesis, and beyond it."""

_WORDS = {
    "": "",
    "example": "example",
    "ex": "example",
    "equation": "equation",
    "eq": "equation",
    "section": "section",
    "sec": "section",
    "§": "section",
    "table": "table",
    "figure": "figure",
    "fig": "figure",
}


def _parse(key: str) -> tuple[str, tuple[str, ...]] | None:
    """Kind and numbers of a key: "Eq. (2.3)" is ("equation", ("2", "3")). A bare "2.3" has the kind ""."""
    text = "".join(key.lower().split())
    match = re.fullmatch(r"([a-z§]*?)\.?(\(?(?:\d+|a)\.\d+\)?)(?:\.?\(?(\d)\)?)?", text)
    if match is None or match[1] not in _WORDS:
        return None
    kind = _WORDS[match[1]] or ("equation" if match[2].startswith("(") else "")
    numbers = re.findall(r"\d+|a", match[2])
    return kind, tuple(n.lstrip("0") for n in [*numbers, *([match[3]] if match[3] else [])])


def _kind(key: str) -> tuple[str, tuple[str, ...]]:
    parsed = _parse(key)
    assert parsed is not None
    kind, numbers = parsed
    return kind or ("table" if len(numbers) == 3 else "section"), numbers


def entry(key: str) -> Entry:
    """The entry of the gallery for `key`: start, end time and orbit guess next to the system.

    **Arguments:**

    - `key`: one of `THESIS`, or a sensible spelling of it: "Example 2.1", "eq 2.3", "section 6.6", "1.1.1". A bare
      number means a section before it means an equation, "5.7" not "(5.7)", and never an example or a figure.

    **Raises:** `ValueError`, naming the possible keys.
    """
    words = re.sub(r"[\s_-]+", " ", key.strip().lower())
    if words in APPLICATIONS:
        return APPLICATIONS[words]
    asked = _parse(key)
    fitting = {}
    for found in THESIS.values():
        for name in (found.key, *found.also):
            kind, numbers = _kind(name)
            bare = asked is not None and asked[0] == "" and kind not in ("example", "figure")
            if asked is not None and asked[1] == numbers and (asked[0] == kind or bare):
                fitting[kind] = found
    if not fitting:
        raise ValueError(f"Argument `key` must be one of {', '.join(map(repr, SYSTEMS))}, but got {key!r}.")
    return fitting.get("section") or next(iter(fitting.values()))


def thesis(key: str, *, coordinates: str | None = None, **parameters: Any) -> System:
    """A system of the thesis, with the values of its Appendix C where it has any.

    ```python
    system = nsjax.gallery.thesis("6.6", omega=1.3)
    ```

    **Arguments:**

    - `key`: number of the section, equation or example; see `THESIS`. `entry(key)` has more than the system.
    - `coordinates`: "cartesian" for the whirl of "A.7" and "A.9" as a scene in Cartesian coordinates, which are polar
        ones otherwise.
    - `parameters`: values that replace the defaults, under the names of the thesis's symbols.

    **Returns:** the `System`; its docstring states equations, sources and which values are not the thesis's.

    **Raises:** `ValueError` for an unknown key or parameter, or coordinates that the system is not given in.
    """
    found = entry(key)
    system = found.cartesian if coordinates == "cartesian" else found.system
    if system is None or coordinates not in (None, "cartesian", *(["polar"] if found.cartesian else [])):
        have = "'polar' or 'cartesian'" if found.cartesian else f"left out for {key!r}"
        raise ValueError(f"Argument `coordinates` must be {have}, but got {coordinates!r}.")
    known = [field.name for field in dataclasses.fields(system())]
    for name in parameters:
        if name not in known:
            raise ValueError(f"Argument `{name}` must be a parameter of {key!r} ({', '.join(known)}), but is not.")
    return system(**parameters)
