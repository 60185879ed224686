"""The options of the command line, and the checks of those that name files."""

import argparse
import pathlib
import tempfile
from typing import NoReturn

from .._numerics._programs import cache_folder
from .._version import __version__
from ._diagrams import DIAGRAMS
from ._job import unknown, UsageError
from ._scorecard import EQUILIBRIA, FAMILIES, NUMBERS_OF, ORBITS


USAGE = 2  # exit status
SECTIONS = (NUMBERS_OF, *EQUILIBRIA, *ORBITS, *FAMILIES)  # of the scorecard


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, without the usage."""
        self.exit(USAGE, f"{self.prog}: error: {message}\n")


def parse(argv: list[str]) -> argparse.Namespace:
    """The words of the command line, by option.

    **Raises:** `UsageError` where `--json`, `--out` or `--save` cannot be written; other mistakes end the program.
    """
    args = _parser().parse_args(_joined(argv))
    if getattr(args, "out", None) is not None:
        _check_folder(args.out, "--out")
    if getattr(args, "save", None) is not None:
        _check_folder(args.save, "--save")
    if getattr(args, "json", None) not in (None, "-"):
        _check_file(pathlib.Path(args.json), "--json")
    for section in getattr(args, "sections", ()):
        if section not in SECTIONS:
            raise unknown("section", section, SECTIONS)
    return args


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise ValueError
    return number


_count.__name__ = "positive integer"  # argparse says "invalid positive integer value: '0'"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="nsjax", description="Piecewise-smooth dynamics: the systems of Leine (2000), and your own.")
    parser.epilog = (
        f"Programs are kept in {cache_folder()}, so that a second call starts sooner; the environment "
        "variable JAX_COMPILATION_CACHE_DIR names another folder, and --no-cache neither reads nor writes one. The "
        "folder may be removed at any time. What a command is doing goes to standard error, unless it is --quiet."
    )
    parser.add_argument("--version", action="version", version=f"nsjax {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="{list,run,orbit,continue,scorecard}")
    commands.add_parser("list", help="list the systems of the gallery")
    run = commands.add_parser("run", help="simulate a system, find its periodic orbit, write tables and pictures")
    orbit = commands.add_parser("orbit", help="find a periodic orbit")
    follow = commands.add_parser(
        "continue", help="follow a periodic orbit, or equilibria, while a parameter varies, with pictures"
    )
    card = commands.add_parser(
        "scorecard", help="compute what the thesis states, and compare: three minutes, or by sections"
    )
    card.add_argument(
        "sections", nargs="*", metavar="SECTION",
        help=f"only some: {', '.join(SECTIONS)} (the last three take minutes each, and are not among all)",
    )  # fmt: skip
    for command in (run, orbit, follow, card):
        add = command.add_argument
        add("--no-cache", action="store_true", help=f"compile anew, and keep nothing in {cache_folder()}")
        add("-q", "--quiet", action="store_true", help="do not tell on standard error what is being done")
        add("--traceback", action="store_true", help="show the whole traceback of an error")
    for command in (run, orbit, follow):
        add = command.add_argument
        add(
            "system",
            metavar="S",
            help="a key of `list`, such as 3.4, or a model of yours: path/model.py:ClassName (:ClassName only if "
            "the file has several)",
        )
        add("--set", action="append", default=[], metavar="name=value", help="parameters, with commas or repeated")
        add("--period", type=float, help="guess of the period of an orbit of an autonomous system")
        add("--order", type=_count, default=None, help="subharmonic order of an orbit of a forced system")
        add("--mode", action="append", default=[], metavar="name=value", help="mode of a switch at the start: -1, 0, 1")
        add("--tol", type=float, help="relative and absolute tolerance of the integration (default: 1e-12)")
        add("--t0", type=float, help="start time")
        add(
            "--json",
            metavar="FILE",
            help="write the numbers as JSON; - is standard output, and nothing else goes there",
        )
    lasting = "; ".join(f"{key} takes {diagram.lasts}" for key, diagram in DIAGRAMS.items() if diagram.lasts)
    follow.epilog = f"This takes minutes; {lasting}, on one core. How far it is goes to standard error."
    run.add_argument("--y0", metavar="x=..,v=..", help="where the simulation starts; names of the state, or numbers")
    run.add_argument("--t1", type=float, help="end time (default: that of the gallery, 20 periods, or 100)")
    run.add_argument(
        "--branches",
        action="store_true",
        help=f"draw the diagrams of the thesis too, of {', '.join(DIAGRAMS)}: minutes",
    )
    for command in (orbit, follow):
        command.add_argument(
            "--y0",
            metavar="x=..,v=..",
            help="guess of a state on the orbit, or of an equilibrium; names of the state, or numbers",
        )
    follow.add_argument("--param", metavar="NAME", help="the parameter that varies")
    follow.add_argument("--range", metavar="LO,HI", help="of the parameter; the start is sought at its value in --set")
    follow.add_argument(
        "--equilibria",
        action="store_true",
        help="follow equilibria and no orbits (A.7 has nothing else; of A.9, both are shown without this)",
    )
    follow.add_argument(
        "--max-laps",
        type=_count,
        default=None,
        metavar="N",
        help="the longest period that is followed, over that of the orbit (default: 4, of A.9 2)",
    )
    follow.add_argument(
        "--save",
        type=pathlib.Path,
        metavar="FOLDER",
        help="keep the branches in files, to be read by `Branch.load` and `OrbitBranch.load`",
    )
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


# Minutes of work would be lost where their results cannot be written.


def _check_folder(folder: pathlib.Path, flag: str) -> None:
    """That files can be written into a folder, which need not exist. Nothing is left behind."""
    try:
        nearest = next(path for path in (folder, *folder.parents) if path.exists())
        if not nearest.is_dir():
            raise UsageError(f"{flag}: {str(nearest)!r} is a file, not a folder.")
        with tempfile.TemporaryFile(dir=nearest):  # permissions do not tell of a read-only or full disk
            pass
    except OSError as error:
        raise UsageError(f"{flag}: {str(folder)!r} cannot be written: {error.strerror}.") from None


def _check_file(file: pathlib.Path, flag: str) -> None:
    """That a file can be written, whose folder need not exist."""
    if file.is_dir():
        raise UsageError(f"{flag}: {str(file)!r} is a folder, not a file.")
    if not file.exists():
        return _check_folder(file.parent, flag)
    try:
        with file.open("ab"):
            pass
    except OSError as error:
        raise UsageError(f"{flag}: {str(file)!r} cannot be written: {error.strerror}.") from None
