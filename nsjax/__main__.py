"""The command line: `python -m nsjax list`, `run 3.4`, `orbit model.py:Oscillator`, `continue 6.6`."""

import argparse
import atexit
import json
import os
import pathlib
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import diffrax as dfx
import jax
import jax.numpy as jnp

from . import gallery
from ._cli import (
    BOUNDS,
    branch_record,
    collect_rarely,
    compile_loops_whole,
    controller,
    Diagram,
    diagram_for,
    DIAGRAMS,
    draw,
    draw_branches,
    find,
    first_line,
    follow,
    Followed,
    given_mode,
    guess_of,
    is_off,
    is_ours,
    Job,
    keep_compiled,
    load,
    mistake,
    model_file,
    note,
    numbers,
    options,
    orbit_record,
    parse,
    raised_inside,
    record,
    report,
    row_text,
    scorecard,
    simulation_record,
    start_of,
    tolerances,
    USAGE,
    UsageError,
    value_of,
)
from ._numerics._stages import is_quiet, STAGES
from .derivatives._flow_map import solution, with_room
from .flow._arguments import check_span, checked_start, checked_time
from .flow._diagnosis import explain
from .flow._integrator import Integrator
from .flow._results import is_okay, RESULTS, SolveError
from .flow._solution import Solution
from .flow._solve import solve
from .orbits._guess import of_relays
from .system._system import arrays_of


FAILURE = 1  # exit status of a numerical failure; `USAGE` is that of a mistake
DENSE = dfx.SaveAt(dense=True)


def _simulate(args: argparse.Namespace, job: Job, t0: float, search: bool) -> Solution:
    """The solution from the start, with dense output. Where a `search` for an orbit follows, it is that of the search's
    own program, as every program takes seconds to trace and compile."""
    t1 = job.t1 if args.t1 is None else args.t1
    if t1 is None:
        t1 = t0 + (100.0 if job.system.period is None else 20 * float(job.system.period))
    note(f"following the solution to t = {t1:g}", compiles=True)
    how, mode = controller(args) | BOUNDS, given_mode(args, job)
    if search:
        start, y0, given = checked_start(job.system, t0, start_of(job), mode)
        stop = checked_time("t1", t1, start.dtype)
        check_span(job.system, start, stop, DENSE)
        integrator = with_room(Integrator(**how).checked(start.dtype), start.dtype)
        relays = of_relays(job.system, [jnp.zeros((), jnp.int32)] * len(job.system.switches)) or {}
        sol = solution(arrays_of(job.system, start.dtype), start, stop, y0, relays | given or None, integrator)
    else:
        sol = solve(job.system, t0, t1, start_of(job), mode=mode, saveat=DENSE, throw=False, **how)
    if sol.result == RESULTS.wrong_contact or sol.result == RESULTS.wrong_parameter:  # a mistake in the model
        raise SolveError(explain(job.system, sol, t1))
    return sol


def _write_json(args: argparse.Namespace, job: Job, numbers: Callable[[], dict[str, Any]]) -> None:
    """What was computed, if that is asked for."""
    if args.json is None:
        return
    text = json.dumps(record(job, tolerances(args), **numbers()), indent=1, allow_nan=False) + "\n"
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


def _diagram(job: Job, parameter: str | None, interval: str | None, equilibria: bool = False) -> Diagram:
    """What is to be continued; it is sought only if it makes sense."""
    ends = None if interval is None else numbers(interval, "An end of --range")
    if ends is not None and (len(ends) != 2 or not ends[0] < ends[1]):
        raise UsageError(f"--range must be two numbers, the lower one first, but got {interval!r}.")
    diagram = diagram_for(job, parameter, None if ends is None else (ends[0], ends[1]), equilibria)
    value, what = value_of(job.system, diagram), "equilibrium" if diagram.families[0].equilibria else "orbit"
    low, high = diagram.interval_of(diagram.families[0])
    if diagram.families[0].start is None and not low <= value <= high:
        raise UsageError(
            f"{diagram.parameter} = {value:g} lies outside [{low:g}, {high:g}]; give another --range, or a value where "
            f"there is an {what}: --set {diagram.parameter}=.."
        )
    return diagram


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
        orbit, trouble = find(args, job, t0, (job.guess.y0, None), (job.y0, given_mode(args, job)))
    elif search and is_okay(sol.result):
        orbit, trouble = find(args, job, t0, (job.y0, given_mode(args, job)))
    note("drawing", compiles=True)
    files = draw(job, sol, orbit, args.out)
    words = [report(job, sol, orbit, trouble)]
    found = [] if diagram is None else follow(args, job, diagram, orbit)
    if diagram is not None and found:
        note("drawing the branches")
        files += draw_branches(job, found, diagram, args.out)
        words += ["", *_told(found)]
    out = sys.stderr if args.json == "-" else sys.stdout
    STAGES.stop()
    print(*words, "", *files, sep="\n", file=out)

    def computed() -> dict[str, Any]:
        numbers = {"simulation": simulation_record(sol), "orbit": None if orbit is None else orbit_record(orbit)}
        return numbers | {"continuation": branch_record(found)} if found else numbers

    _write_json(args, job, computed)
    return 0 if is_okay(sol.result) or sol.result == RESULTS.accumulation_reached else FAILURE


def _orbit(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    t0 = job.t0 if args.t0 is None else args.t0
    orbit, trouble = find(args, job, t0, (guess_of(args, job), given_mode(args, job)))
    if orbit is None:
        STAGES.say(f"nsjax: no periodic orbit: {trouble}")
        return FAILURE
    STAGES.stop()
    if args.json != "-":
        print(report(job, None, orbit, None))
    _write_json(args, job, lambda: {"orbit": orbit_record(orbit)})
    return 0


def _told(found: list[Followed]) -> list[str]:
    """Branches as text, with their names."""
    return [f"{one.family.name}: {one.branch}" if one.family.name else str(one.branch) for one in found]


def _continue(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    diagram = _diagram(job, args.param, args.range, args.equilibria)
    found = follow(args, job, diagram)
    if not found:
        return FAILURE
    note("drawing the branches")
    files = draw_branches(job, found, diagram, args.out)
    out = sys.stderr if args.json == "-" else sys.stdout
    STAGES.stop()
    print(report(job, None, None, None), "", *_told(found), "", *files, sep="\n", file=out)
    _write_json(args, job, lambda: branch_record(found))
    return 0


def _scorecard(args: argparse.Namespace) -> int:
    off = False
    for row in scorecard(tuple(args.sections)):
        off |= is_off(row)
        STAGES.answer(row_text(row))
    return FAILURE if off else 0


def _complaint(error: BaseException, args: argparse.Namespace) -> str | None:
    """What is said of an error, instead of a page; `None` of one that this package is to blame for."""
    report = mistake(error, model_file(args.system) if hasattr(args, "system") else None)
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
    words = sys.argv[1:] if argv is None else argv
    try:
        if (argv is None or sys.stderr.isatty()) and not is_quiet(words):
            STAGES.start("starting")
        args = parse(words)
        if argv is None:  # the process is ours
            compile_loops_whole()
            keep_compiled(not getattr(args, "no_cache", False))
            collect_rarely()
        return _run_command(args)
    except UsageError as error:
        STAGES.say(f"nsjax: error: {error}")
        return USAGE
    finally:
        STAGES.stop()


def _run_command(args: argparse.Namespace) -> int:
    commands = {"list": lambda _: _list(), "run": _run, "orbit": _orbit, "continue": _continue, "scorecard": _scorecard}
    try:
        return commands[args.command](args)
    except (Exception, SystemExit) as error:  # a model may end the program that imports it
        complaint = _complaint(error, args)
        if complaint is None or (getattr(args, "traceback", False) and not isinstance(error, UsageError)):
            raise
        STAGES.say(complaint)
        return USAGE


def command() -> NoReturn:
    """The whole of a process. It ends at once: to take JAX apart takes a second, in which nothing is told."""
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    atexit._run_exitfuncs()
    os._exit(status)


if __name__ == "__main__":
    command()
