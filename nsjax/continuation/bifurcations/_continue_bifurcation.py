"""Curves of special points of periodic orbits in two parameters."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.flatten_util as jfu
import numpy as np
from jaxtyping import Complex, Float

from ..._numerics._tables import frame
from ..._numerics._text import components, listed, shown
from ..._types import Y
from ...orbits.segments._equations import OrbitCurve
from ...system._parameter import get_parameter, parameter_path
from ...system._system import System
from .._branch import CLOSED
from .._checks import check_interval
from .._tracer import Trace, Zero
from ..orbits._bifurcation import OrbitBifurcation, Origin
from ..orbits._record import states_of
from ..orbits._test_functions import CORNERS, Test
from ..orbits._tracer import midpoint, OrbitPoint
from ..orbits.corners._corner import is_impact
from ._branch_points import BranchLocus
from ._surface import BifurcationTracer, CUSP, lift, Place, RESONANCES, surfaces_of, touches
from ._tracer import CurveTracer, FAILED, LAST


@shown
class CodimensionTwo(NamedTuple):
    """A point at which a curve of special points meets another one, or turns back.

    **Attributes:**

    - `name`: "cusp", "fold-flip", "1:1 resonance", "fold at a corner of floor", ...
    - `values`: of the two parameters.
    - `period`, `multipliers`: of the orbit there.
    - `t`, `y`: a time, and the orbit's state then.
    """

    name: str
    values: Float[np.ndarray, "2"]
    period: float
    multipliers: np.ndarray
    t: float
    y: Y

    def __str__(self) -> str:
        return f"{self.name} at ({listed(self.values, 10)}), period {self.period:.10g}"


@shown
class BifurcationCurve(eqx.Module):
    """A curve of special points of periodic orbits in the plane of two parameters.

    **Attributes:**

    - `system`: the model.
    - `kind`: "fold", "flip", "Neimark-Sacker", "symmetry breaking", "transcritical"; of corners "grazing" (the orbit
        touches a surface), "tangency" (it comes onto one, or leaves it, tangentially), or "corner" (a segment of it
        vanishes, or one is about to appear).
    - `surfaces`: the switches whose surfaces it touches at a corner.
    - `parameters`: their names.
    - `values`: shape `(points, 2)`.
    - `periods`: of the orbits [time].
    - `multipliers`: shape `(points, n)`; at a corner those of one side, NaN where they are limits only.
    - `ts`, `ys`: a time, and the state of each orbit then; leaves with a leading axis.
    - `special`: its points of codimension two, in their order.
    - `indices`: at which point of the curve each is.
    - `ends`: why it begins and ends where it does.
    """

    system: System
    kind: str
    surfaces: tuple[str, ...]
    parameters: tuple[str, str]
    values: Float[np.ndarray, "points 2"]
    periods: Float[np.ndarray, " points"]
    multipliers: Complex[np.ndarray, "points n"]
    ts: Float[np.ndarray, " points"]
    ys: Y
    special: tuple[CodimensionTwo, ...]
    indices: tuple[int, ...]
    ends: tuple[str, str]

    @property
    def discontinuous(self) -> bool:
        """Whether its points are corners."""
        return bool(self.surfaces)

    @property
    def name(self) -> str:
        """With the surfaces: "grazing of floor"."""
        return self.kind + (f" of {', '.join(self.surfaces)}" if self.surfaces else "")

    def to_dataframe(self) -> Any:
        """A row for each point: the two parameters by their names, `period`, `t`, the components of the state,
        `multiplier`, and the name of the point of codimension two there (`special`; empty where there is none).

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        special = np.full(len(self), "", dtype=object)
        for point, i in zip(self.special, self.indices):
            special[min(max(i, 0), len(self) - 1)] = point.name
        columns = [*zip(self.parameters, np.asarray(self.values).T), ("period", self.periods), ("t", self.ts)]
        columns += [*components(self.ys, 1).items(), ("multiplier", self.multipliers), ("special", special)]
        return frame("BifurcationCurve.to_dataframe", columns)

    def __len__(self) -> int:
        return len(self.values)

    def __str__(self) -> str:
        low, high = np.min(self.values, axis=0), np.max(self.values, axis=0)
        where = ", ".join(f"{p} in [{a:.6g}, {b:.6g}]" for p, a, b in zip(self.parameters, low, high))
        lines = [
            f"curve of periodic orbits of {type(self.system).__name__}: {self.name}",
            f"  {where}: {len(self)} points",
        ]
        lines.append(f"  from {self.ends[0]} to {self.ends[1]}")
        for point in self.special:
            at = ", ".join(f"{p} = {v:.10g}" for p, v in zip(self.parameters, point.values))
            lines.append(f"  {point.name} at {at}, period {point.period:.10g}")
        return "\n".join(lines)


def continue_bifurcation(
    special: OrbitBifurcation,
    parameter: str,
    interval: tuple[float, float],
    *,
    first: tuple[float, float] | None = None,
    max_step: float = 0.02,
    max_points: int = 500,
) -> BifurcationCurve:
    """Follows a special point of a branch of periodic orbits in a second parameter: the curve on which orbits fold,
    flip, lose a symmetry, graze a surface, or change their itinerary.

    ```python
    branch = nsjax.continue_orbit(system, orbit, "omega", (0.5, 2.0))
    curve = nsjax.continue_bifurcation(branch.bifurcations[0], "k_f", (1.0, 8.0))
    print(curve)
    nsjax.plot.parameter_plane(curve)
    ```

    The orbits of one itinerary over two parameters are a surface, on which the points looked for are the zeros of a
    test function: where its projection on the plane of the parameters is singular (a fold), a multiplier is -1, two
    have the product 1, a segment has no length. The curve is followed on the surface, where a cusp is a point like
    others, and so are turns in either parameter. Along it all other test functions are watched: their zeros are the
    curve's points of codimension two. It goes on through them, and ends where the itinerary changes, or where there is
    no bifurcation of its kind beyond.

    **Arguments:**

    - `special`: a special point, from the branches that `continue_orbit` found.
    - `parameter`: the name of another parameter than that of the branch.
    - `interval`: of this parameter.
    - `first`: the interval of the parameter of the branch; by default that of the branch.
    - `max_step`: the longest step, in units of the state, of the orbit's period, and of the intervals.
    - `max_points`: in each of the two directions in which the curve is followed.

    **Returns:** a `BifurcationCurve`.

    **Raises:** `ValueError` for an unknown parameter, or that of the branch; for an interval without the point; for a
    special point that was loaded from a file (the way to it is not stored: find the branch again), that is not known
    as the zero of an equation ("end"), or that does not lie on a curve.
    """
    origin, path, low, high = _checked(special, parameter, interval, first)
    surface, spot, test = lift(origin, path, low, high)
    locus, place = _locus(special, parameter, surface, spot, test)
    tracer = CurveTracer(locus, max_step, max_points)
    ahead, later = tracer.trace(place)
    back, earlier = (Trace((place,)), []) if ahead.closed else tracer.trace(place.turned)
    names = (special.parameter, parameter)
    kind, surfaces = _kind(surface, spot, special, test)
    spots = [place.spot for place in back.points[:0:-1] + ahead.points]
    shift = len(back.points) - 1
    met = [(shift - i, zero) for i, zero in earlier[::-1]] + [(shift + i, zero) for i, zero in later]
    ends = [CLOSED if ahead.closed else _end(surface, t, names) for t in (back, ahead)]
    known = [(i, zero) for i, zero in met if zero.test.kind not in ("low", "high")]
    bases = [midpoint(surface, s, s.itinerary.rows) for s in spots]
    unravel = jfu.ravel_pytree(surface.like)[1]
    silent = {test.kind for test in locus.silent}

    def multipliers(spot: OrbitPoint) -> np.ndarray:
        rho = np.asarray(spot.multipliers, complex)
        return np.full_like(rho, np.nan) if "flip" in silent else rho

    def codimension_two(i: int, zero: Zero[Place]) -> CodimensionTwo:
        (t, x, _), spot = bases[i], zero.point.spot
        return CodimensionTwo(
            name=_name(surface, kind, zero.test, spot),
            values=np.array(spot.look.parameter),
            period=float(spot.look.period),
            multipliers=multipliers(spot),
            t=t,
            y=unravel(x),
        )

    return BifurcationCurve(
        system=surface.model.system,
        kind=kind,
        surfaces=surfaces,
        parameters=names,
        values=np.stack([np.asarray(s.look.parameter) for s in spots]),
        periods=np.array([float(s.look.period) for s in spots]),
        multipliers=np.stack([multipliers(s) for s in spots]),
        ts=np.array([t for t, _, _ in bases]),
        ys=states_of(surface.like, np.stack([x for _, x, _ in bases])),
        special=tuple(codimension_two(i, zero) for i, zero in known),
        indices=tuple(i for i, _ in known),
        ends=(ends[0], ends[1]),
    )


def _checked(
    special: OrbitBifurcation, parameter: str, interval: tuple[float, float], first: tuple[float, float] | None
) -> tuple[Origin, tuple[str, ...], np.ndarray, np.ndarray]:
    """Where the curve sets out, the second parameter, and the ends of both intervals."""
    origin = special.origin
    if origin is None and special.kind == "Hopf":
        raise ValueError(
            "Argument `special` must be a bifurcation of periodic orbits, but at this Hopf bifurcation they shrink to "
            "an equilibrium."
        )
    if origin is None:
        raise ValueError(
            "Argument `special` must come from `continue_orbit` itself, but was loaded from a file, which does not "
            "hold the equations that were solved: call `continue_orbit` again, for a short interval."
        )
    if origin.test.kind == "guard" or special.kind == "unresolved":
        raise ValueError(
            f"Argument `special` must be a zero of an equation, but at {special.parameter} = {special.value:.10g} "
            f"({special.name}) only the neighbourhood is known."
        )
    curve = origin.curve
    system = curve.model.system
    path = parameter_path(system, parameter)
    if path in curve.free.paths:
        raise ValueError(f"Argument `parameter` must be another one than that of the branch, `{parameter}`.")
    if first is None:
        first = float(curve.low), float(curve.low + curve.width)
    check_interval("interval", interval, float(get_parameter(system, path)), "at the special point")
    check_interval("first", first, special.value, "at the special point")
    low, high = (np.array([first[i], interval[i]], float) for i in (0, 1))
    return origin, path, low, high


def _locus(
    special: OrbitBifurcation, parameter: str, surface: OrbitCurve, spot: OrbitPoint, test: Test
) -> tuple[BifurcationTracer | BranchLocus, Place]:
    """The tracer of the curve, and its place at the special point, with a look at both sides of it."""
    kind_of_locus = BranchLocus if test.kind == "branch" else BifurcationTracer
    locus = kind_of_locus(surface, test, float(spot.look.branch[1]))
    try:
        place = locus.place(spot)
        place = locus.place(locus.step(place, 0.0), place.tangent, place.heading)
        near = [locus.place(locus.step(place, s), place.tangent, place.heading) for s in (1e-3, -1e-3)]
    except FAILED as why:
        raise ValueError(
            f"Argument `special` must lie on a curve of such points in {special.parameter} and {parameter}, but beside "
            f"this {special.name} none was found: {why}."
        ) from why
    return locus.with_silent([place, *near]), place


def _kind(curve: OrbitCurve, spot: OrbitPoint, special: OrbitBifurcation, test: Test) -> tuple[str, tuple[str, ...]]:
    if test.kind not in (*CORNERS, "grazing"):
        return special.kind, ()
    return _touching(curve, spot, test), special.surfaces or surfaces_of(curve, spot, test)


def _touching(curve: OrbitCurve, spot: OrbitPoint, test: Test) -> str:
    """How the orbit meets a surface at a corner."""
    if test.kind == "rate":
        return "grazing" if is_impact(curve, spot, test.row) else "tangency"
    if test.kind == "duration" and touches(spot.itinerary, test.row):
        return "grazing"
    return "grazing" if test.kind in ("guard", "grazing") else "corner"


def _name(curve: OrbitCurve, kind: str, test: Test, spot: OrbitPoint) -> str:
    if test.kind in (*CORNERS, "grazing"):
        touched = ", ".join(surfaces_of(curve, spot, test))
        if kind in ("grazing", "tangency", "corner"):
            other = _touching(curve, spot, test)
            return f"double {kind}" if other == kind else f"{kind} and {other} of {touched}"
        return f"{kind} at a {_touching(curve, spot, test)} of {touched}"
    if test == CUSP or test in RESONANCES:
        return test.kind
    both = {kind, test.kind}
    if both == {"fold", "flip"}:
        return "fold-flip"
    if test.kind == "Neimark-Sacker" and kind in ("fold", "flip"):
        pair = np.any(np.abs(np.imag(spot.multipliers)) > 1e-3)
        return f"{kind}-Neimark-Sacker" if pair else {"fold": "1:1 resonance", "flip": "1:2 resonance"}[kind]
    other = {"branch": "branch point"}.get(test.kind, test.kind)
    return f"{kind}-{other}"


def _end(curve: OrbitCurve, traced: Trace[Place], names: tuple[str, str]) -> str:
    end, spot = traced.end, traced.points[-1].spot
    if end is None:
        at = ", ".join(f"{n} = {v:.6g}" for n, v in zip(names, spot.look.parameter))
        return f"{traced.why}, at {at}"
    if end.test.kind in ("low", "high"):
        return f"{names[end.test.row]} = {spot.look.parameter[end.test.row]:.6g}"
    if end.test.kind in LAST[:5]:
        return f"a {_touching(curve, spot, end.test)} of {', '.join(surfaces_of(curve, spot, end.test))}"
    return end.test.kind
