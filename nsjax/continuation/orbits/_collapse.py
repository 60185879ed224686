"""Where a branch of periodic orbits shrinks to an equilibrium: at a Hopf bifurcation, or at a corner."""

import dataclasses
from typing import NamedTuple

import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ...equilibria._equilibrium import Equilibrium
from ...equilibria._find_equilibrium import find_equilibrium
from ...flow._results import is_okay
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import TIME
from .._tracer import Trace, Zero
from ._bifurcation import OrbitBifurcation
from ._tracer import OrbitPoint, OrbitTracer


SECANTS = 12  # steps to where the real part is zero
EXACT = 1e-13  # of the parameter, relative
SHRUNK = 1e-4  # the size of an orbit, over that at the point before
SHARES = np.array([0.2, 0.4, 0.6, 0.8])  # of the way to the point before, at which orbits are looked at


class _Beside(NamedTuple):
    """An equilibrium, and of its eigenvalues that next to the frequency of an orbit."""

    found: Equilibrium
    root: complex


def hopf_end(name: str, curve: OrbitCurve, trace: Trace) -> tuple[OrbitPoint, OrbitBifurcation] | None:
    """The point at which the orbits of a trace that ends in a fold have shrunk to an equilibrium; None for a fold.

    The parameter is even in the size of the orbits, so that their branch looks as if it turned back there; what it
    goes back along are the same orbits half a period later. The equations are singular at size zero, and the fold is
    only seen beside the point: that is a zero of the real part of the equilibrium's eigenvalue, which is found here.
    """
    fold, before, early = trace.points[-1], trace.points[-2], trace.points[-min(5, len(trace.points))]
    small = fold.itinerary.ends[0] == TIME and _size(before) < _size(early)
    if curve.model.system.period is not None or not small:
        return None
    mean = np.asarray(fold.look.mean)
    value, near = fold.parameter, _beside(curve, fold, fold.parameter, mean)
    other, away = before.parameter, _beside(curve, fold, before.parameter, np.asarray(before.look.mean))
    if near is None or away is None:
        return None
    side = away.root.real
    for _ in range(SECANTS):
        if near.root.real == away.root.real:
            break
        step = -near.root.real * (value - other) / (near.root.real - away.root.real)
        other, away, value = value, near, value + step
        near = _beside(curve, fold, value, np.asarray(jfu.ravel_pytree(near.found.y)[0]))
        if near is None:
            return None
        if abs(step) <= EXACT * abs(value):
            break
    y = np.asarray(jfu.ravel_pytree(near.found.y)[0])
    # Beside the point the parameter goes with the square of the size. At a fold it does not, wherever a Hopf point is.
    by_value = (early.parameter - before.parameter) / (before.parameter - value)
    by_size = (_size(early) / _size(before)) ** 2 - 1
    if abs(by_value - by_size) > 0.1 * by_size or np.linalg.norm(mean - y) > _size(before):
        return None
    spot = dataclasses.replace(_point(fold, near, value, y), stable=before.stable)
    way = 1 if before.parameter > value else -1
    return spot, OrbitBifurcation.hopf(name, spot, curve, way, "supercritical" if side > 0 else "subcritical")


def limits(tracer: OrbitTracer, trace: Trace, zero: Zero) -> Zero:
    """A corner at which orbits shrink to a point, with the limit of their multipliers there.

    At the point the equations do not determine them: whatever is left of the orbit is rounding. Beside it the monodromy
    matrix depends smoothly on the place along the branch; it is a polynomial through five orbits.
    """
    before, spot = trace.points[-2], zero.point
    if len(before.look.u) != len(spot.look.u) or _size(spot) > SHRUNK * _size(before):
        return zero
    way = np.asarray(spot.look.u - before.look.u)
    length = float(before.look.tangent @ way)
    beside = [tracer.at(before, (1 - x) * length, before.look.u + (1 - x) * way) for x in SHARES]
    shares = np.array([x for x, there in zip(SHARES, beside) if there is not None] + [1.0])
    found = [there.monodromy for there in beside if there is not None] + [before.monodromy]
    # Lagrange's polynomials at zero.
    weights = [np.prod([-x / (a - x) for x in shares if x != a]) for a in shares]
    monodromy = sum(w * np.asarray(m) for w, m in zip(weights, found))
    return zero._replace(point=dataclasses.replace(spot, stable=before.stable, **floquet(monodromy)))


def floquet(monodromy: np.ndarray) -> dict[str, np.ndarray]:
    rho = np.linalg.eigvals(monodromy).astype(complex)
    return dict(monodromy=monodromy, multipliers=rho[np.argsort(-np.abs(rho), kind="stable")])


def _size(spot: OrbitPoint) -> float:
    return float(np.linalg.norm(np.asarray(spot.look.high) - np.asarray(spot.look.low)))


def _beside(curve: OrbitCurve, orbit: OrbitPoint, value: float, guess: np.ndarray) -> _Beside | None:
    system = curve.model_at(jnp.asarray(value)).system
    y = jfu.ravel_pytree(curve.like)[1](jnp.asarray(guess))
    found = find_equilibrium(system, y, t=float(orbit.look.begin[0]), throw=False)
    if not is_okay(found.result) or not bool(found.admissible):
        return None
    roots = np.asarray(found.eigenvalues)
    roots = roots[np.isfinite(roots)]
    frequency = 2 * np.pi / float(orbit.look.period)
    root = complex(roots[np.argmin(np.abs(roots - 1j * frequency))]) if len(roots) else 0j
    return _Beside(found, root) if root.imag > 0 else None


def _point(fold: OrbitPoint, at: _Beside, value: float, y: np.ndarray) -> OrbitPoint:
    """The orbit of size zero."""
    from scipy.linalg import expm  # slow to import

    look, period = fold.look, np.asarray(2 * np.pi / at.root.imag)
    stretch = float(period / look.period)
    begin = look.begin[0]
    still = {part: np.broadcast_to(y, np.shape(getattr(look, part))) for part in ("x", "last", "xs", "low", "high")}
    times = {part: begin + stretch * (getattr(look, part) - begin) for part in ("begin", "end", "ts")}
    look = look._replace(parameter=np.asarray(value), period=period, mean=y, square=y**2, **still, **times)
    return dataclasses.replace(fold, look=look, **floquet(expm(np.asarray(at.found.jacobian) * float(period))))
