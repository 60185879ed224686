"""The branches of a diagram, family by family."""

import argparse
import dataclasses
import warnings
from typing import Any

from .._numerics._stages import STAGES
from ..continuation.equilibria._branch import Branch
from ..continuation.equilibria._continue_equilibrium import continue_equilibrium
from ..continuation.orbits._branch import OrbitBranch
from ..continuation.orbits._continue_orbit import continue_orbit
from ..equilibria._find_equilibrium import find_equilibrium
from ..flow._results import RESULTS
from ..orbits._orbit import Orbit
from ..system._parameter import get_parameter, parameter_path
from ..system._system import System
from ._diagrams import Diagram
from ._family import Family, Followed, Start
from ._job import Job, model_file
from ._mistakes import advice, first_line, mistake
from ._pictures import stem
from ._search import controller, find, given_mode, Guess, guess_of, meter, note, start_of, try_guess


def value_of(system: System, diagram: Diagram) -> float:
    return float(get_parameter(system, parameter_path(system, diagram.parameter)))


def follow(args: argparse.Namespace, job: Job, diagram: Diagram, orbit: Orbit | None = None) -> list[Followed]:
    """The branches of a diagram, those that are there: why one is not is said.

    **Arguments:**

    - `orbit`: that of the job, if it is known.
    """
    if diagram.lasts and len(diagram.families) > 1:
        note(f"following {', '.join(family.name for family in diagram.families)}: {diagram.lasts} on one core")
    found = []
    for k, family in enumerate(diagram.families):
        what = family.name or ("equilibrium" if family.equilibria else "periodic orbit")
        given = k == 0 and args.y0 is not None
        start = None if given or family.start is None else family.start(job.system)
        if start is not None:
            value, (low, high) = value_of(start.system, diagram), diagram.interval_of(family)
            if not low <= value <= high:
                where = f"{diagram.parameter} = {value:g}, which is not in the range"
                STAGES.say(f"nsjax: no {what}: its start is at {where}")
                continue
        branch, trouble = (_equilibria if family.equilibria else _orbits)(args, job, diagram, family, start, orbit)
        if branch is None:
            STAGES.say(f"nsjax: no {what}: {trouble}")
            continue
        found.append(Followed(family, branch))
        if getattr(args, "save", None) is not None:
            args.save.mkdir(parents=True, exist_ok=True)
            branch.save(args.save / ("-".join([stem(job), *(family.name or "branches").split()]) + ".npz"))
    return found


def _equilibria(
    args: argparse.Namespace, job: Job, diagram: Diagram, family: Family, start: Start | None, _: Any
) -> tuple[Branch | None, str | None]:
    """The branches of a family of equilibria, or why there are none."""
    mode = given_mode(args, job) if start is None else None
    start = start or Start(job.system, start_of(job))
    note(f"looking for {family.name or 'an equilibrium'}")
    try:
        found = find_equilibrium(start.system, start.y0, mode=mode, throw=False)
    except RuntimeError as error:
        if mistake(error, model_file(args.system)) is not None:
            raise
        return None, first_line(error)
    if found.result != RESULTS.successful:
        return None, advice(found.result)
    if not found.admissible:
        return (
            None,
            "what was found lies beyond its surfaces. Start elsewhere (--y0), or change parameters (--set).",
        )
    note(f"following {family.name or 'the equilibrium'}")
    interval = diagram.interval_of(family)
    branch = continue_equilibrium(start.system, found, diagram.parameter, interval, progress_meter=meter())
    return family.part(branch), None


def _orbits(
    args: argparse.Namespace,
    job: Job,
    diagram: Diagram,
    family: Family,
    start: Start | None,
    orbit: Orbit | None,
) -> tuple[OrbitBranch | None, str | None]:
    """The branches of a family of periodic orbits, or why there are none."""
    system, trouble = job.system if start is None else start.system, None
    if start is not None:
        there = dataclasses.replace(job, system=system)
        orbit, trouble = try_guess(args, there, job.t0, Guess(start.y0, None, start.period))
    elif orbit is None:
        t0 = job.t0 if args.t0 is None else args.t0
        orbit, trouble = find(args, job, t0, (guess_of(args, job), given_mode(args, job)))
    if orbit is None:
        return None, trouble
    note(f"following {family.name or 'the orbit'}", compiles=True)
    how: dict[str, Any] = dict(max_laps=getattr(args, "max_laps", None) or family.laps, progress_meter=meter())
    if family.most is not None:
        how["max_branches"] = family.most
    with warnings.catch_warnings():
        if family.most is not None:  # that there are more is known
            warnings.filterwarnings("ignore", "There are more than `max_branches`")
        interval = diagram.interval_of(family)
        return continue_orbit(system, orbit, diagram.parameter, interval, **how, **controller(args)), None
