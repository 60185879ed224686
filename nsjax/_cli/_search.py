"""The search for periodic orbits from the words of the command line."""

import argparse
from typing import Any, NamedTuple

import diffrax as dfx

from .. import gallery
from .._numerics._progress import ProgressMeter
from .._numerics._stages import STAGES
from ..flow._results import RESULTS
from ..orbits._find_orbit import find_orbit
from ..orbits._orbit import Orbit
from ._job import Job, model_file, options, unknown, UsageError
from ._mistakes import advice, first_line, mistake


DEFAULT_TOL = 1e-12
BOUNDS = dict(max_steps=20_000, max_events=1024)
Start = tuple[Any, dict[str, int] | None]  # a state, and the modes that were given for it


def note(text: str, compiles: bool = False) -> None:
    """What is under way, for whoever waits.

    **Arguments:**

    - `text`: the stage.
    - `compiles`: whether it takes several times as long where its programs are not in the cache yet. How long that is
        depends on the machine and the model, and is not foretold.
    """
    STAGES.stage(f"{text} (compiles the first time)" if compiles else text)


def meter() -> ProgressMeter:
    """Of a stage that tells how far it is."""
    return STAGES.progress if STAGES.on else dfx.TextProgressMeter()


def tolerances(args: argparse.Namespace) -> dict[str, float]:
    """Of the integration, and of Newton's method in the search for an orbit."""
    tol = DEFAULT_TOL if args.tol is None else args.tol
    if not 0 < tol < 1:
        raise UsageError(f"--tol must lie between 0 and 1, but got {tol:g}.")
    return {"rtol": tol, "atol": tol, "newton": 100 * tol}


def controller(args: argparse.Namespace) -> dict[str, Any]:
    tols = tolerances(args)
    controller = dfx.PIDController(rtol=tols["rtol"], atol=tols["atol"])
    return dict(solver=dfx.Dopri8(), stepsize_controller=controller)


def given_mode(args: argparse.Namespace, job: Job) -> dict[str, int] | None:
    known = [switch.name for switch in job.system.switches]
    modes = {}
    for name, text in options(args.mode, "--mode").items():
        if name not in known:
            raise unknown("switch", name, known)
        if text not in ("-1", "0", "1", "+1"):
            raise UsageError(f"The mode of {name} must be -1, 0 or 1, but got {text!r}.")
        modes[name] = int(text)
    return modes or None


def start_of(job: Job) -> Any:
    if job.y0 is None:
        raise UsageError(
            f"There is no default state; give one: --y0 {','.join(f'{name}=..' for name in job.state) or '..,..'}"
        )
    return job.y0


class Guess(NamedTuple):
    """A guess of an orbit."""

    y0: Any
    mode: dict[str, int] | None
    period: float | None = None  # of an autonomous system; None: that of the solution where it settles
    order: int | None = None  # of a forced one; None: likewise
    words: str = ""  # the period or order in words


def _first_guess(args: argparse.Namespace, job: Job, y0: Any, mode: dict[str, int] | None) -> Guess:
    """What was given, and the rest from the gallery."""
    known = job.guess or gallery.OrbitGuess(y0)
    period = known.period if args.period is None else args.period
    order = known.order if args.order is None else args.order
    if job.system.period is None:
        words = "" if period is None else f"period {period:g}{'' if args.period else ' of the gallery'}"
    else:
        words = f"order {order}{' of the gallery' if args.order is None and job.guess else ''}"
    return Guess(y0, mode, period, order, words)


def find(
    args: argparse.Namespace, job: Job, t0: float, first: Start, settling: Start | None = None
) -> tuple[Orbit | None, str | None]:
    """An orbit, or why there is none.

    A guess of the gallery is for the gallery's parameters. If it fails where others, or another start, were given, the
    orbit is searched for where the solution settles; so it is if a period that was given fails. An order that was asked
    for is kept.

    **Arguments:**

    - `first`: a guess of a state on the orbit, and of its mode.
    - `settling`: from where the solution is followed to where it settles; by default from the same.
    """
    guess = _first_guess(args, job, *first)
    note(f"looking for a periodic orbit of {guess.words or 'unknown period'}")
    orbit, trouble = try_guess(args, job, t0, guess)
    departs = not job.from_gallery or any((args.set, args.y0, args.period, args.mode, args.t0))
    if trouble is None or not departs or not guess.words or args.order is not None:
        return orbit, trouble
    note("looking for it where the solution settles")
    order = 1 if job.system.period is None else None
    orbit, later = try_guess(args, job, t0, Guess(*(settling or first), order=order))
    if orbit is None:
        return None, f"neither with {guess.words} nor where the solution settles: {later}"
    why = trouble.partition(". ")[0].rstrip(".")
    found = f"an orbit of period {float(orbit.period):.10g}"
    STAGES.say(f"nsjax: with {guess.words}: {why}; found where the solution settles: {found}.")
    return orbit, None


def try_guess(args: argparse.Namespace, job: Job, t0: float, guess: Guess) -> tuple[Orbit | None, str | None]:
    try:
        orbit = find_orbit(
            job.system, guess.y0, period=guess.period, t0=t0, order=guess.order, mode=guess.mode, throw=False,
            tol=tolerances(args)["newton"], **controller(args), **BOUNDS,
        )  # fmt: skip
    except RuntimeError as error:
        if mistake(error, model_file(args.system)) is not None:
            raise
        return None, first_line(error)
    return (orbit, None) if orbit.result == RESULTS.successful else (None, advice(orbit.result))


def guess_of(args: argparse.Namespace, job: Job) -> Any:
    return job.guess.y0 if job.guess is not None and args.y0 is None else start_of(job)
