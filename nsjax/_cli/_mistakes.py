"""Failures in the words of the command line: results and errors name its options, and the lines of a user's model."""

import pathlib
import re
import traceback
from typing import Any

import jax

from ..flow._results import RESULTS


PACKAGE = pathlib.Path(__file__).resolve().parents[1]
FLAGS = {name: f"--{name}" for name in ("y0", "t0", "t1", "period", "order", "mode")}
FLAGS |= {"parameter": "--param", "interval": "--range", "max_laps": "--max-laps"}  # arguments, and their options

# Results whose own words advise what the command line has no option for, or another one.
_ADVICE = {
    "orbit_not_found": "Newton's method did not converge. Start nearer to an orbit (--y0, and --period if it is "
    "autonomous), change parameters (--set), or see by `nsjax run` what the solution does.",
    "orbit_is_equilibrium": "the solution ends in an equilibrium. Start farther away from it (--y0), or change "
    "parameters (--set).",
    "max_steps_reached": "the solution takes too many steps. Loosen --tol, change --y0 or --set, or for `run` shorten "
    "--t1.",
    "max_events_reached": "the solution has too many events. Change --y0 or --set, or for `run` shorten --t1 and see "
    "whether they crowd together.",
}


def advice(result: RESULTS) -> str:
    """What a result says, on one line, and which option may help."""
    text = str(RESULTS[result])
    own = {str(RESULTS[getattr(RESULTS, name)]): words for name, words in _ADVICE.items()}
    return own.get(text) or in_options(text)


def in_options(text: str) -> str:
    """A message of the library on one line, its arguments as options of the command line."""
    text = re.sub(r"`mode=\{'(\w+)': (-?\d)\}`", r"--mode \1=\2", text)

    def flag(match: re.Match[str]) -> str:
        return FLAGS.get(match[1], match[0])

    return " ".join(re.sub(r"(?:\b[Aa]rguments? )?`(\w+)`", flag, text).split())


def raised_inside(error: BaseException) -> str | None:
    """What an error raised within a compiled program says, without the stack that equinox puts around it."""
    found = re.search(r"EquinoxRuntimeError: (.*?)\n\n", str(error), re.DOTALL)
    return None if found is None else in_options(found[1])


def is_ours(error: BaseException) -> bool:
    """Whether a `raise` of this package made it, and neither the user's model nor a bug."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return PACKAGE in pathlib.Path(last.filename).parents and (last.line or "").startswith("raise ")


def mistake(error: BaseException, file: pathlib.Path | None) -> str | None:
    """An error that comes out of the user's model, in three lines: where, the user's own line, what; `None` where the
    model has no part in it.

    **Arguments:**

    - `error`: what was raised.
    - `file`: that of the model.
    """
    if file is None:
        return None
    if isinstance(error, SyntaxError) and error.filename and _own(error.filename, file):
        return _lines(error.filename, error.lineno, "", error.text, f"{type(error).__name__}: {error.msg}")
    frames = [f for f in traceback.extract_tb(error.__traceback__) if _own(f.filename, file)]
    if not frames:
        return None
    last = frames[-1]  # that of the function of the user's which failed, whatever it called
    where = f", in {last.name}" if last.name.isidentifier() else ""
    return _lines(last.filename, last.lineno, where, last.line, _words(error))


def _own(name: str, file: pathlib.Path) -> bool:
    """Whether a line of the model, or of a module that lies beside or below it."""
    path = pathlib.Path(name).resolve()
    installed = PACKAGE in path.parents or {"site-packages", "dist-packages"} & set(path.parts)
    return file.parent.resolve() in path.parents and not installed


def _lines(name: str, number: int | None, where: str, line: str | None, what: str) -> str:
    return f"{pathlib.Path(name).name}, line {number}{where}:\n    {(line or '').strip()}\n{what}"


def _words(error: BaseException) -> str:
    """Type and first line: JAX tells the rest of a story on many."""
    text = raised_inside(error) or next(iter(str(error).strip().splitlines()), "")
    hint = ""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        hint = " (for `if`, `and` and `or` on the state, the time or a parameter write jnp.where)"
    elif isinstance(error, jax.errors.ConcretizationTypeError | jax.errors.TracerArrayConversionError):
        hint = " (write jax.numpy for numpy and math)"
    return f"{type(error).__name__}: {text}".removesuffix(": ") + hint


def first_line(error: Any) -> str:
    """Of an error that happened within the library, on one line."""
    return raised_inside(error) or in_options(str(error))
