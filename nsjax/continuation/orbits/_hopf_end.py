"""Where a branch of periodic orbits shrinks to an equilibrium: a Hopf bifurcation."""

import dataclasses
from typing import NamedTuple

import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from ...equilibria._equilibrium import Equilibrium
from ...equilibria._find_equilibrium import find_equilibrium
from ...flow._results import is_okay
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import TIME
from ._bifurcation import OrbitBifurcation
from ._tracer import OrbitPoint, Trace


SECANTS = 12  # steps to where the real part is zero
EXACT = 1e-13  # of the parameter, relative


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
    fold, before = trace.spots[-1], trace.spots[-2]
    if curve.model.system.period is not None or fold.itinerary.ends[0] != TIME or _size(fold) > 0.5 * _size(before):
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
    distance = abs(before.parameter - value)
    if abs(fold.parameter - value) > 0.25 * distance or np.linalg.norm(mean - y) > _size(fold) + 1e-3 * _size(before):
        return None
    spot = dataclasses.replace(_point(fold, near, value, y), stable=before.stable)
    way = 1 if before.parameter > value else -1
    return spot, OrbitBifurcation.hopf(name, spot, curve, way, "supercritical" if side > 0 else "subcritical")


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
    look, period = fold.look, np.asarray(2 * np.pi / at.root.imag)
    stretch = float(period / look.period)
    begin = look.begin[0]
    monodromy = expm(np.asarray(at.found.jacobian) * float(period))
    multipliers = np.linalg.eigvals(monodromy).astype(complex)
    multipliers = multipliers[np.argsort(-np.abs(multipliers), kind="stable")]
    still = {part: np.broadcast_to(y, np.shape(getattr(look, part))) for part in ("x", "last", "xs", "low", "high")}
    times = {part: begin + stretch * (getattr(look, part) - begin) for part in ("begin", "end", "ts")}
    look = look._replace(parameter=np.asarray(value), period=period, mean=y, square=y**2, **still, **times)
    return dataclasses.replace(fold, look=look, multipliers=multipliers, monodromy=monodromy)
