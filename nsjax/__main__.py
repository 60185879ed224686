"""The command line: `python -m nsjax list`, `run 3.4`, `orbit model.py:Oscillator`, `continue 6.6`."""

import argparse
import json
import pathlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp

from . import gallery
from ._cli import (
    advice,
    branch_record,
    Diagram,
    diagram_for,
    DIAGRAMS,
    draw,
    draw_branches,
    first_line,
    is_ours,
    Job,
    keep_programs,
    load,
    mistake,
    model_file,
    numbers,
    options,
    orbit_record,
    parse,
    raised_inside,
    record,
    report,
    simulation_record,
    unknown,
    USAGE,
    UsageError,
)
from .continuation.orbits._branch import OrbitBranch
from .continuation.orbits._continue_orbit import continue_orbit
from .derivatives._flow_map import solution, with_room
from .flow._arguments import check_span, checked_start, checked_time
from .flow._diagnosis import explain
from .flow._integrator import Integrator
from .flow._results import is_okay, RESULTS, SolveError
from .flow._solution import Solution
from .flow._solve import solve
from .orbits._find_orbit import find_orbit
from .orbits._guess import of_relays
from .orbits._orbit import Orbit
from .system._parameter import get_parameter, parameter_path
from .system._system import arrays_of


FAILURE = 1  # exit status of a numerical failure; `USAGE` is that of a mistake
DEFAULT_TOL = 1e-12
BOUNDS = dict(max_steps=20_000, max_events=1024)
DENSE = dfx.SaveAt(dense=True)
Start = tuple[Any, dict[str, int] | None]  # a state, and the modes that were given for it


def _note(text: str) -> None:
    """What is under way, for whoever waits: a stream that is no terminal is left to results and errors."""
    if sys.stderr.isatty():
        print(f"nsjax: {text} ...", file=sys.stderr)


def _tolerances(args: argparse.Namespace) -> dict[str, float]:
    """Of the integration, and of Newton's method in the search for an orbit."""
    tol = DEFAULT_TOL if args.tol is None else args.tol
    if not 0 < tol < 1:
        raise UsageError(f"--tol must lie between 0 and 1, but got {tol:g}.")
    return {"rtol": tol, "atol": tol, "newton": 100 * tol}


def _controller(args: argparse.Namespace) -> dict[str, Any]:
    tols = _tolerances(args)
    controller = dfx.PIDController(rtol=tols["rtol"], atol=tols["atol"])
    return dict(solver=dfx.Dopri8(), stepsize_controller=controller)


def _mode(args: argparse.Namespace, job: Job) -> dict[str, int] | None:
    known = [switch.name for switch in job.system.switches]
    modes = {}
    for name, text in options(args.mode, "--mode").items():
        if name not in known:
            raise unknown("switch", name, known)
        if text not in ("-1", "0", "1", "+1"):
            raise UsageError(f"The mode of {name} must be -1, 0 or 1, but got {text!r}.")
        modes[name] = int(text)
    return modes or None


def _start(job: Job) -> Any:
    if job.y0 is None:
        raise UsageError(
            f"There is no default state; give one: --y0 {','.join(f'{name}=..' for name in job.state) or '..,..'}"
        )
    return job.y0


def _simulate(args: argparse.Namespace, job: Job, t0: float, search: bool) -> Solution:
    """The solution from the start, with dense output. Where a `search` for an orbit follows, it is that of the search's
    own program, as every program takes seconds to trace and compile."""
    t1 = job.t1 if args.t1 is None else args.t1
    if t1 is None:
        t1 = t0 + (100.0 if job.system.period is None else 20 * float(job.system.period))
    _note(f"following the solution to t = {t1:g}")
    how, mode = _controller(args) | BOUNDS, _mode(args, job)
    if search:
        start, y0, given = checked_start(job.system, t0, _start(job), mode)
        stop = checked_time("t1", t1, start.dtype)
        check_span(job.system, start, stop, DENSE)
        integrator = with_room(Integrator(**how).checked(start.dtype), start.dtype)
        relays = of_relays(job.system, [jnp.zeros((), jnp.int32)] * len(job.system.switches)) or {}
        sol = solution(arrays_of(job.system, start.dtype), start, stop, y0, relays | given or None, integrator)
    else:
        sol = solve(job.system, t0, t1, _start(job), mode=mode, saveat=DENSE, throw=False, **how)
    if sol.result == RESULTS.wrong_contact or sol.result == RESULTS.wrong_parameter:  # a mistake in the model
        raise SolveError(explain(job.system, sol))
    return sol


class _Guess(NamedTuple):
    """A guess of an orbit."""

    y0: Any
    mode: dict[str, int] | None
    period: float | None = None  # of an autonomous system; None: that of the solution where it settles
    order: int | None = None  # of a forced one; None: likewise
    words: str = ""  # the period or order in words


def _first_guess(args: argparse.Namespace, job: Job, y0: Any, mode: dict[str, int] | None) -> _Guess:
    """What was given, and the rest from the gallery."""
    known = job.guess or gallery.OrbitGuess(y0)
    period = known.period if args.period is None else args.period
    order = known.order if args.order is None else args.order
    if job.system.period is None:
        words = "" if period is None else f"period {period:g}{'' if args.period else ' of the gallery'}"
    else:
        words = f"order {order}{' of the gallery' if args.order is None and job.guess else ''}"
    return _Guess(y0, mode, period, order, words)


def _find(
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
    _note(f"looking for a periodic orbit of {guess.words or 'unknown period'}")
    orbit, trouble = _try(args, job, t0, guess)
    departs = not job.from_gallery or any((args.set, args.y0, args.period, args.mode, args.t0))
    if trouble is None or not departs or not guess.words or args.order is not None:
        return orbit, trouble
    _note("looking for it where the solution settles")
    order = 1 if job.system.period is None else None
    orbit, later = _try(args, job, t0, _Guess(*(settling or first), order=order))
    if orbit is None:
        return None, f"neither with {guess.words} nor where the solution settles: {later}"
    why = trouble.partition(". ")[0].rstrip(".")
    found = f"an orbit of period {float(orbit.period):.10g}"
    print(f"nsjax: with {guess.words}: {why}; found where the solution settles: {found}.", file=sys.stderr)
    return orbit, None


def _try(args: argparse.Namespace, job: Job, t0: float, guess: _Guess) -> tuple[Orbit | None, str | None]:
    try:
        orbit = find_orbit(
            job.system, guess.y0, period=guess.period, t0=t0, order=guess.order, mode=guess.mode, throw=False,
            tol=_tolerances(args)["newton"], **_controller(args), **BOUNDS,
        )  # fmt: skip
    except RuntimeError as error:
        if mistake(error, model_file(args.system)) is not None:
            raise
        return None, first_line(error)
    return (orbit, None) if orbit.result == RESULTS.successful else (None, advice(orbit.result))


def _write_json(args: argparse.Namespace, job: Job, numbers: Callable[[], dict[str, Any]]) -> None:
    """What was computed, if that is asked for."""
    if args.json is None:
        return
    text = json.dumps(record(job, _tolerances(args), **numbers()), indent=1, allow_nan=False) + "\n"
    if args.json == "-":
        sys.stdout.write(text)
    else:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def _list() -> int:
    width = max(map(len, gallery.SYSTEMS))
    for key, entry in gallery.SYSTEMS.items():
        print(f"{key:{width}}  {entry.title}{'' if entry.orbit is None else ' (with a periodic orbit)'}")
    return 0


def _diagram(job: Job, parameter: str | None, interval: str | None) -> Diagram:
    """What is to be continued; an orbit is sought only if it makes sense."""
    ends = None if interval is None else numbers(interval, "An end of --range")
    if ends is not None and (len(ends) != 2 or not ends[0] < ends[1]):
        raise UsageError(f"--range must be two numbers, the lower one first, but got {interval!r}.")
    diagram = diagram_for(job, parameter, None if ends is None else (ends[0], ends[1]))
    value = float(get_parameter(job.system, parameter_path(job.system, diagram.parameter)))
    low, high = diagram.interval
    if not low <= value <= high:
        raise UsageError(
            f"{diagram.parameter} = {value:g} lies outside [{low:g}, {high:g}]; give another --range, or a value where "
            f"there is an orbit: --set {diagram.parameter}=.."
        )
    return diagram


def _branches(args: argparse.Namespace, job: Job, orbit: Orbit, diagram: Diagram) -> OrbitBranch:
    laps = getattr(args, "max_laps", None) or diagram.laps
    return continue_orbit(
        job.system, orbit, diagram.parameter, diagram.interval, max_laps=laps, progress=True, **_controller(args)
    )


def _run(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    if args.branches and job.name not in DIAGRAMS:
        raise UsageError(f"--branches is for {', '.join(DIAGRAMS)}; for others there is `nsjax continue`.")
    diagram = _diagram(job, None, None) if args.branches else None
    t0 = job.t0 if args.t0 is None else args.t0
    search = job.guess is not None or args.period is not None or not job.from_gallery
    sol = _simulate(args, job, t0, search)
    orbit, trouble = None, None
    if job.guess is not None:
        orbit, trouble = _find(args, job, t0, (job.guess.y0, None), (job.y0, _mode(args, job)))
    elif search and is_okay(sol.result):
        orbit, trouble = _find(args, job, t0, (job.y0, _mode(args, job)))
    files = draw(job, sol, orbit, args.out)
    words = [report(job, sol, orbit, trouble)]
    branch = None
    if diagram is not None and orbit is not None:
        branch = _branches(args, job, orbit, diagram)
        files += draw_branches(job, branch, diagram, args.out)
        words += ["", str(branch)]
    out = sys.stderr if args.json == "-" else sys.stdout
    print(*words, "", *files, sep="\n", file=out)

    def computed() -> dict[str, Any]:
        found = {"simulation": simulation_record(sol), "orbit": None if orbit is None else orbit_record(orbit)}
        return found if branch is None else found | {"continuation": branch_record(branch)}

    _write_json(args, job, computed)
    return 0 if is_okay(sol.result) or sol.result == RESULTS.accumulation_reached else FAILURE


def _guess(args: argparse.Namespace, job: Job) -> Any:
    return job.guess.y0 if job.guess is not None and args.y0 is None else _start(job)


def _orbit(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    t0 = job.t0 if args.t0 is None else args.t0
    orbit, trouble = _find(args, job, t0, (_guess(args, job), _mode(args, job)))
    if orbit is None:
        print(f"nsjax: no periodic orbit: {trouble}", file=sys.stderr)
        return FAILURE
    if args.json != "-":
        print(report(job, None, orbit, None))
    _write_json(args, job, lambda: {"orbit": orbit_record(orbit)})
    return 0


def _continue(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    diagram = _diagram(job, args.param, args.range)
    t0 = job.t0 if args.t0 is None else args.t0
    orbit, trouble = _find(args, job, t0, (_guess(args, job), _mode(args, job)))
    if orbit is None:
        print(f"nsjax: no periodic orbit: {trouble}", file=sys.stderr)
        return FAILURE
    branch = _branches(args, job, orbit, diagram)
    files = draw_branches(job, branch, diagram, args.out)
    out = sys.stderr if args.json == "-" else sys.stdout
    print(report(job, None, None, None), "", branch, "", *files, sep="\n", file=out)
    _write_json(args, job, lambda: branch_record(branch))
    return 0


def _complaint(error: BaseException, args: argparse.Namespace) -> str | None:
    """What is said of an error, instead of a page; `None` of one that this package is to blame for."""
    report = mistake(error, None if args.command == "list" else model_file(args.system))
    if report is not None:
        return f"nsjax: error in {report}\n(--traceback shows all of it)"
    if isinstance(error, UsageError | OSError):
        return f"nsjax: error: {error}"
    inside = raised_inside(error)
    if inside is None and isinstance(error, TypeError | ValueError | SolveError) and is_ours(error):
        inside = first_line(error)
    return None if inside is None else f"nsjax: error: {inside}"


def main(argv: list[str] | None = None) -> int:
    """Runs the command line.

    **Returns:** the exit status: 0, 1 for a numerical failure, 2 for a word that means nothing or a mistake in a model.
    """
    jax.config.update("jax_enable_x64", True)
    if argv is None:
        keep_programs()
    try:
        args = parse(sys.argv[1:] if argv is None else argv)
    except UsageError as error:
        print(f"nsjax: error: {error}", file=sys.stderr)
        return USAGE
    commands = {"list": lambda _: _list(), "run": _run, "orbit": _orbit, "continue": _continue}
    try:
        return commands[args.command](args)
    except (Exception, SystemExit) as error:  # a model may end the program that imports it
        complaint = _complaint(error, args)
        if complaint is None or (getattr(args, "traceback", False) and not isinstance(error, UsageError)):
            raise
        print(complaint, file=sys.stderr)
        return USAGE


if __name__ == "__main__":
    sys.exit(main())
