"""Units of parameters and state components: the metadata of a field, or the comment beside it,
`x: Array  # displacement [m]`."""

import dataclasses
import functools as ft
import inspect
import re
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple


_FIELD = re.compile(r"^\s+(\w+)\s*:[^#\n]*#\s*([^\[\n]*?)\s*(?:\[([^\]\n]*)\])?\s*$", re.MULTILINE)
_POWERS = str.maketrans("⁻¹²³⁴", "-1234")


class Note(NamedTuple):
    meaning: str = ""
    unit: str = ""


@ft.lru_cache
def notes(cls: type) -> dict[str, Note]:
    """What is said of the fields of a class: by the metadata `unit` and `meaning` of a field, or by the comments of the
    class and its bases, which are not there where there is no source."""
    found = {}
    for base in reversed(cls.__mro__):
        try:
            source = inspect.getsource(base)
        except (OSError, TypeError):  # built in, or typed at a prompt
            continue
        found |= {name: Note(meaning, unit or "") for name, meaning, unit in _FIELD.findall(source)}
    for field in dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ():
        told = {key: str(field.metadata[key]) for key in Note._fields if key in field.metadata}
        if told:
            found[field.name] = found.get(field.name, Note())._replace(**told)
    return found


def time_unit(units: Iterable[str]) -> str:
    """Seconds if any of them has these; else nothing is known of it."""
    return "s" if any("s" in unit.replace("/", " ").split() for unit in units) else ""


def ratio(unit: str, other: str) -> str:
    """One unit over another: `ratio("m", "m/s")` is "s". Empty where one of them is not known."""
    if not unit or not other:
        return ""
    powers = _powers(unit)
    powers.subtract(_powers(other))
    above = [_power(name, p) for name, p in powers.items() if p > 0]
    below = [_power(name, -p) for name, p in powers.items() if p < 0]
    if not below:
        return " ".join(above) or "-"
    return f"{' '.join(above) or '1'}/{below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def _powers(unit: str) -> Counter:
    powers, sign = Counter(), 1
    for name, power, slash in re.findall(r"([^\W\d]+)\^?(-?\d+)?|(/)", unit.translate(_POWERS)):
        if slash:
            sign = -1
        else:
            powers[name] += sign * int(power or 1)
    return powers


def _power(name: str, power: int) -> str:
    return name if power == 1 else f"{name}^{power}"
