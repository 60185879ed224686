"""Units of parameters and state components: the metadata of a field, or the comment beside it,
`x: Array  # displacement [m]`."""

import ast
import dataclasses
import functools as ft
import inspect
import linecache
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
        except (OSError, TypeError):  # built in, or typed into a notebook
            source = ""
        # (From Python 3.13 on it may be the lines with the same numbers of what was started, whatever they are.)
        if base.__module__ == "__main__" and not re.search(rf"^\s*class {base.__name__}\b", source, re.MULTILINE):
            source = _typed(base)
        found |= {name: Note(meaning, unit or "") for name, meaning, unit in _FIELD.findall(source)}
    for field in dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ():
        told = {key: str(field.metadata[key]) for key in Note._fields if key in field.metadata}
        if told:
            found[field.name] = found.get(field.name, Note())._replace(**told)
    return found


def _typed(cls: type) -> str:
    """The source of a class that is in no file. IPython keeps the text of cells in `linecache`, and the functions of a
    class name the cell that they come from. A class without functions (a `NamedTuple`) does not: for it, the newest
    text that defines a class with this name and these fields."""
    places = [(f.__code__.co_filename, f.__code__.co_firstlineno) for f in vars(cls).values() if inspect.isfunction(f)]
    fields, best, source = list(inspect.get_annotations(cls)), False, ""
    for file, entry in list(linecache.cache.items()):
        if len(entry) == 1 or entry[1] is not None:  # of a file: only these have a time
            continue
        try:
            nodes = ast.walk(ast.parse("".join(entry[2])))
        except (SyntaxError, ValueError):
            continue
        for node in nodes:
            if not isinstance(node, ast.ClassDef) or node.name != cls.__name__:
                continue
            if [ast.unparse(line.target) for line in node.body if isinstance(line, ast.AnnAssign)] != fields:
                continue
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            here = any(name == file and line in lines for name, line in places)
            if here >= best:
                # Whole lines: a node ends before the comment that stands behind it.
                best, source = here, "".join(entry[2][lines.start - 1 : lines.stop - 1])
    return source


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
