"""The command line: `python -m nsjax list`, `run 3.4`, `orbit model.py:Oscillator`, `continue 6.6`."""

import argparse
import json
import pathlib
import sys
import traceback
from typing import Any, NoReturn

import diffrax as dfx
import jax

from . import gallery
from ._cli import (
    branch_record,
    Diagram,
    diagram_for,
    DIAGRAMS,
    draw,
    draw_branches,
    Job,
    load,
    numbers,
    options,
    orbit_record,
    record,
    report,
    simulation_record,
    UsageError,
)
from ._continue_orbit import continue_orbit
from ._find_orbit import find_orbit
from ._orbit import Orbit
from ._orbit_branch import OrbitBranch
from ._parameter import get_parameter, parameter_path
from ._solution import is_okay, RESULTS, Solution
from ._solve import solve


USAGE, FAILURE = 2, 1  # exit status


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, without the usage."""
        self.exit(USAGE, f"{self.prog}: error: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="nsjax", description="Piecewise-smooth dynamics: the systems of Leine (2000), and your own.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="{list,run,orbit,continue}")
    commands.add_parser("list", help="list the systems of the gallery")
    run = commands.add_parser("run", help="simulate a system, find its periodic orbit, write tables and pictures")
    orbit = commands.add_parser("orbit", help="find a periodic orbit")
    follow = commands.add_parser("continue", help="follow a periodic orbit while a parameter varies, with pictures")
    for command in (run, orbit, follow):
        add = command.add_argument
        add("system", metavar="S", help="a key of `list`, such as 3.4, or a class of yours: path/model.py:ClassName")
        add("--set", action="append", default=[], metavar="name=value", help="parameters, with commas or repeated")
        add("--period", type=float, help="guess of the period of an orbit of an autonomous system")
        add("--order", type=int, default=None, help="subharmonic order of an orbit of a forced system")
        add("--mode", action="append", default=[], metavar="name=value", help="mode of a switch at the start: -1, 0, 1")
        add("--tol", type=float, help="relative and absolute tolerance of the integration (default: 1e-12)")
        add("--t0", type=float, help="start time")
        add(
            "--json",
            metavar="FILE",
            help="write the numbers as JSON; - is standard output, and nothing else goes there",
        )
    run.add_argument("--y0", metavar="x=..,v=..", help="where the simulation starts; names of the state, or numbers")
    run.add_argument("--t1", type=float, help="end time (default: that of the gallery, 20 periods, or 100)")
    run.add_argument(
        "--branches",
        action="store_true",
        help=f"draw the diagrams of the thesis too, of {', '.join(DIAGRAMS)}: minutes",
    )
    for command in (orbit, follow):
        command.add_argument(
            "--y0", metavar="x=..,v=..", help="guess of a state on the orbit; names of the state, or numbers"
        )
    follow.add_argument("--param", metavar="NAME", help="the parameter that varies")
    follow.add_argument("--range", metavar="LO,HI", help="of the parameter; the orbit is sought at its value in --set")
    for command in (run, follow):
        command.add_argument(
            "--out", type=pathlib.Path, default=pathlib.Path("out"), help="folder for pictures (default: out)"
        )
    return parser


def _joined(argv: list[str]) -> list[str]:
    """`--y0 -1,0` as `--y0=-1,0`, which argparse would take for an option."""
    found: list[str] = []
    for word in argv:
        if found and found[-1] in ("--y0", "--t0", "--t1", "--range") and word.startswith("-"):
            found[-1] += f"={word}"
        else:
            found.append(word)
    return found


def _controller(tol: float | None) -> dict[str, Any]:
    tol = 1e-12 if tol is None else tol
    if not 0 < tol < 1:
        raise UsageError(f"--tol must lie between 0 and 1, but got {tol:g}.")
    return dict(solver=dfx.Dopri8(), stepsize_controller=dfx.PIDController(rtol=tol, atol=tol))


def _mode(args: argparse.Namespace, job: Job) -> dict[str, int] | None:
    known = [switch.name for switch in job.system.switches]
    modes = {}
    for name, text in options(args.mode, "--mode").items():
        if name not in known:
            raise UsageError(f"There is no switch {name!r}; possible: {', '.join(known) or 'none'}.")
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


def _simulate(args: argparse.Namespace, job: Job, t0: float) -> Solution:
    t1 = job.t1 if args.t1 is None else args.t1
    if t1 is None:
        t1 = t0 + (100.0 if job.system.period is None else 20 * float(job.system.period))
    return solve(
        job.system, t0, t1, _start(job), mode=_mode(args, job), saveat=dfx.SaveAt(dense=True, t1=True),
        max_steps=20_000, max_events=1024, throw=False, **_controller(args.tol),
    )  # fmt: skip


def _find(
    args: argparse.Namespace, job: Job, y0: Any, t0: float, mode: dict[str, int] | None
) -> tuple[Orbit | None, str | None]:
    """An orbit, or why there is none."""
    period, order = args.period, args.order
    if job.guess is not None:
        period = job.guess.period if period is None else period
        order = job.guess.order if order is None else order
    tol = {} if args.tol is None else {"tol": 100 * args.tol}
    try:
        orbit = find_orbit(
            job.system, y0, period=period, t0=t0, order=1 if order is None else order, mode=mode, throw=False,
            **_controller(args.tol), **tol,
        )  # fmt: skip
    except RuntimeError as error:
        return None, " ".join(str(error).split())
    if orbit.result == RESULTS.successful:
        return orbit, None
    return None, " ".join(str(RESULTS[orbit.result]).split())


def _write_json(file: str | None, numbers: dict[str, Any]) -> None:
    if file is None:
        return
    text = json.dumps(numbers, indent=1, allow_nan=False) + "\n"
    if file == "-":
        sys.stdout.write(text)
    else:
        pathlib.Path(file).write_text(text)


def _list() -> int:
    width = max(map(len, gallery.THESIS))
    for key, entry in gallery.THESIS.items():
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
    return continue_orbit(job.system, orbit, diagram.parameter, diagram.interval, **_controller(args.tol))


def _run(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    if args.branches and job.name not in DIAGRAMS:
        raise UsageError(f"--branches is for {', '.join(DIAGRAMS)}; for others there is `nsjax continue`.")
    diagram = _diagram(job, None, None) if args.branches else None
    t0 = job.t0 if args.t0 is None else args.t0
    sol = _simulate(args, job, t0)
    orbit, trouble = None, None
    if job.guess is not None:
        orbit, trouble = _find(args, job, job.guess.y0, t0, None)
    elif is_okay(sol.result) and (args.period is not None or not job.from_gallery):
        orbit, trouble = _find(args, job, job.y0, t0, _mode(args, job))
    files = draw(job, sol, orbit, args.out)
    words = [report(job, sol, orbit, trouble)]
    found = {"simulation": simulation_record(sol), "orbit": None if orbit is None else orbit_record(orbit)}
    if diagram is not None and orbit is not None:
        branch = _branches(args, job, orbit, diagram)
        files += draw_branches(job, branch, diagram, args.out)
        words += ["", str(branch)]
        found["continuation"] = branch_record(branch)
    out = sys.stderr if args.json == "-" else sys.stdout
    print(*words, "", *files, sep="\n", file=out)
    _write_json(args.json, record(job, **found))
    return 0 if is_okay(sol.result) or sol.result == RESULTS.accumulation_reached else FAILURE


def _guess(args: argparse.Namespace, job: Job) -> Any:
    return job.guess.y0 if job.guess is not None and args.y0 is None else _start(job)


def _orbit(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    t0 = job.t0 if args.t0 is None else args.t0
    orbit, trouble = _find(args, job, _guess(args, job), t0, _mode(args, job))
    if orbit is None:
        print(f"nsjax: no periodic orbit: {trouble}", file=sys.stderr)
        return FAILURE
    if args.json != "-":
        print(report(job, None, orbit, None))
    _write_json(args.json, record(job, orbit=orbit_record(orbit)))
    return 0


def _continue(args: argparse.Namespace) -> int:
    job = load(args.system, options(args.set, "--set"), args.y0)
    diagram = _diagram(job, args.param, args.range)
    t0 = job.t0 if args.t0 is None else args.t0
    orbit, trouble = _find(args, job, _guess(args, job), t0, _mode(args, job))
    if orbit is None:
        print(f"nsjax: no periodic orbit: {trouble}", file=sys.stderr)
        return FAILURE
    branch = _branches(args, job, orbit, diagram)
    files = draw_branches(job, branch, diagram, args.out)
    out = sys.stderr if args.json == "-" else sys.stdout
    print(report(job, None, None, None), "", branch, "", *files, sep="\n", file=out)
    _write_json(args.json, record(job, **branch_record(branch)))
    return 0


def _is_ours(error: BaseException) -> bool:
    """Whether a `raise` of this package made it, and not the user's model or a bug."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    package = str(pathlib.Path(__file__).parent)
    return last.filename.startswith(package) and (last.line or "").startswith("raise ")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line.

    **Returns:** the exit status: 0, 1 for a numerical failure, 2 for a word that means nothing.
    """
    jax.config.update("jax_enable_x64", True)
    args = _parser().parse_args(_joined(sys.argv[1:] if argv is None else argv))
    try:
        commands = {"list": lambda _: _list(), "run": _run, "orbit": _orbit, "continue": _continue}
        return commands[args.command](args)
    except (UsageError, OSError) as error:
        message = str(error)
    except (TypeError, ValueError) as error:  # a mistake in the model or in an argument
        if not _is_ours(error):
            raise
        message = " ".join(str(error).split())
    print(f"nsjax: error: {message}", file=sys.stderr)
    return USAGE


if __name__ == "__main__":
    sys.exit(main())
