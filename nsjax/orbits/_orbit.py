"""A periodic orbit, with its Floquet multipliers."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, Generic

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._numerics._text import between, listed, shown
from .._types import Number, Scalar, StateT, Y
from ..derivatives._floquet import trivial
from ..derivatives._saltation import saltation_matrices
from ..flow._archive import Archive, plain, save, table
from ..flow._integrator import Integrator
from ..flow._results import is_okay, outcomes, RESULTS
from ..flow._solution import Events, Itinerary, Solution
from ..flow._solve import solve
from ..system._model import SwitchedSystem
from ..system._system import System
from ._maximum import largest
from .segments._arcs import Arcs, Path, path_of, SAMPLES


@shown
class Orbit(eqx.Module, Generic[StateT]):
    """A periodic solution.

    **Attributes:**

    - `t0`, `y0`, `mode`: time, state and mode at its base point; for an autonomous system a point away from events.
    - `period`: its period (`order` times that of the forcing).
    - `events`: the event log of one period.
    - `monodromy`: Φ(t0 + period, t0), shape `(n, n)`, for the state flattened by `ravel_pytree`; infinite where the
        orbit leaves a surface that repels, where there is none.
    - `multipliers`: its eigenvalues, the Floquet multipliers, largest modulus first; infinite, one for each time that
        the orbit leaves a surface that repels.
    - `structural_zeros`: how many of them vanish whatever the parameters, because the orbit slides or rests.
    - `stable`: whether all multipliers lie inside the unit circle, the trivial one of an autonomous system left out.
    - `residual`: the largest component of y(t0 + period) - y0; of an orbit in segments that of their equations,
        relative to the sizes of states, times and surfaces.
    - `admissible`: whether the orbit keeps to its modes: stays on its sides of the surfaces, with |λ| within its bound
        while it slides and a pushing force while it rests. One found by shooting does.
    - `violation`, `violation_t`: how far it does not, in the unit of h, λ or of the force, and when.
    - `arcs`: times, states and modes of the smooth arcs between the events.
    - `result`: `RESULTS`.
    """

    system: System
    t0: Scalar
    y0: StateT
    mode: Int[Array, " switches"]
    period: Scalar
    events: Events[StateT]
    monodromy: Float[Array, "n n"]
    multipliers: Complex[Array, " n"]
    structural_zeros: Int[Array, ""]
    stable: Bool[Array, ""]
    residual: Scalar
    admissible: Bool[Array, ""]
    violation: Scalar
    violation_t: Scalar
    arcs: Arcs
    result: RESULTS
    integrator: Integrator = eqx.field(static=True)  # so that orbits come out of `vmap`

    @property
    def itinerary(self) -> Itinerary:
        """The modes the orbit passes through, beginning with that of its base point."""
        e = self.events
        return Itinerary(self.mode, e.switch, e.mode_after, e.num, e.names)

    @property
    def monodromy_jumps(self) -> Float[Array, "events n n"]:
        """The saltation matrices by which the fundamental matrix jumps at `events`; NaN past the last."""
        return saltation_matrices(self.system, self.events)

    @property
    def trivial(self) -> Bool[Array, "*batch n"]:
        """Which multiplier is that of a shift along the orbit: of an autonomous system the one nearest to 1."""
        if self.system.period is not None:
            return jnp.zeros(self.multipliers.shape, bool)
        return trivial(self.multipliers)

    def poincare_derivative(self, normal: Y | None = None) -> Float[Array, "n n"]:
        """The derivative of the Poincaré map at the base point, (I - f nᵀ / (nᵀ f)) Φ, (6.7).

        Its eigenvalues are the multipliers, with 0 in place of the trivial one.

        **Arguments:**

        - `normal`: n, the normal of the section, a state; by default that of the section perpendicular to the flow.

        **Returns:** the matrix, for the state flattened by `ravel_pytree`. For a forced system, whose section is a
        phase of the forcing, it is the monodromy matrix.

        **Raises:** `ValueError` for a forced system with a `normal`.
        """
        if self.system.period is not None:
            if normal is not None:
                raise ValueError("Argument `normal` must be None for a forced system: its section is a phase of it.")
            return self.monodromy
        model = SwitchedSystem.forwards(self.system, self.t0, self.y0)
        f = ravel(model.flow(self.t0, self.y0, model.state_at(self.t0, self.y0, tuple(self.mode))))
        n = f if normal is None else ravel(normal).astype(f.dtype)
        return self.monodromy - jnp.outer(f, n @ self.monodromy) / (n @ f)

    def path(self, samples: int = SAMPLES) -> Path:
        """States along its arcs, each followed in its own mode: also where the flow would leave an orbit that is
        infinitely or violently unstable.

        **Arguments:**

        - `samples`: how many in each arc (or in each of its pieces), both ends included.

        **Returns:** a `Path` with `t`, `y` and `mode`, one row for each arc; those past the last have no length.
        """
        return path_of(self.system, self.arcs, samples, self.integrator)

    def maximum(self, of: Callable[[Scalar, StateT], Number]) -> Scalar:
        """The largest value along the orbit of a quantity of the state, with derivatives by the parameters.

        ```python
        amplitude = orbit.maximum(lambda t, y: jnp.abs(y.x))  # as in Figs. 6.12 to 6.21
        ```

        **Arguments:**

        - `of`: a function of time and state, smooth along each arc but where it is not largest.

        **Returns:** the value, in the unit of `of`. Derivatives jump where the maximum does from one place to another.
        """
        return largest(self.system, self.arcs, self.integrator, of)

    def solve(
        self, *, saveat: dfx.SaveAt = dfx.SaveAt(dense=True), periods: float = 1, **kwargs: Any
    ) -> Solution[StateT]:
        """The solution over one or several periods from the base point; further arguments as for `nsjax.solve`.

        It leaves an orbit that is infinitely unstable at the surface that repels: see `path`.
        """
        end = self.t0 + periods * self.period
        how = self.integrator.arguments
        if kwargs.keys() & {"rtol", "atol"}:
            how = how | dict(stepsize_controller=None)
        mode = tuple(self.mode) if self.events.names else None
        return solve(self.system, self.t0, end, self.y0, mode=mode, saveat=saveat, **(how | kwargs))

    def save(self, path: str | os.PathLike) -> None:
        """Writes the orbit to a file, an `.npz` of plain arrays with a description in JSON; a batch of them too."""
        parts = dict(orbit=self, integrator=plain(repr(self.integrator)))
        save(path, "Orbit", SAVED, self.system, self.y0, parts, (Integrator,), result=self.result)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        system: System,
        y: StateT | None = None,
        *,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        rtol: float | None = None,
        atol: float | None = None,
        max_steps: int = 4096,
        max_events: int = 64,
    ) -> "Orbit[StateT]":
        """Reads what `save` wrote. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples. (The numbers do not matter, the shapes do.)
        - `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`, `max_events`: those with which the orbit was
            found: by them it is followed, as by `path` and `solve`.

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model or
        solver.
        """
        archive = Archive(path, "Orbit", SAVED, system, y)
        orbit = archive.part("orbit", result=RESULTS.successful)
        integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(
            orbit.t0.dtype, (1e-12, 1e-6), rtol=rtol, atol=atol
        )
        names = "`solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps` and `max_events`"
        archive.check_integrator(integrator, names, "orbit was found")
        return dataclasses.replace(orbit, integrator=integrator)

    def __str__(self) -> str:
        if jnp.ndim(self.period):
            good = np.asarray(is_okay(self.result))
            stable = np.asarray(self.stable)[good]
            return (
                f"{good.size} searches for periodic orbits of {type(self.system).__name__}: {good.sum()} found\n"
                f"  {stable.sum()} stable, {(~stable).sum()} unstable, periods {between(np.asarray(self.period)[good])}"
            )
        kind = f"{'stable' if self.stable else 'unstable'} periodic orbit"
        if not is_okay(self.result):
            kind = f"failed search ({outcomes(self.result)}) for a periodic orbit"
        text = (
            f"{kind} of {type(self.system).__name__}\n"
            f"  period       {float(self.period):.15g}\n"
            f"  base point   t = {float(self.t0):.6g}, y = ({listed(ravel(self.y0), 12)})\n"
            f"  itinerary    {self.itinerary}\n"
            f"  multipliers  {listed(self.multipliers)}\n"
            f"  residual     {float(self.residual):.1e}"
        )
        if not self.admissible:
            text += f"\n  leaves its modes by {float(self.violation):.3g} at t = {float(self.violation_t):.6g}"
        return text


SAVED = table(Orbit, Events, Arcs)


def ravel(y: Y) -> Array:
    return jfu.ravel_pytree(y)[0]


def distance(a: Array, b: Array) -> Array:
    return jnp.max(jnp.abs(a - b), axis=-1)


def fractions(autonomous: bool, order: int) -> tuple[list[int], np.ndarray]:
    """Primes p for which an orbit may repeat itself p times, and the fractions of its period at which to look."""
    primes = [p for p in (2, 3, 5, 7) if autonomous or order % p == 0]
    return primes, np.array(sorted({j / 8 for j in range(1, 8)} | {1 / p for p in primes}))


def judge(
    converged: Bool[Array, ""],
    x: Array,
    later: Float[Array, "fractions n"],
    autonomous: bool,
    order: int,
    smallest: Scalar,
) -> RESULTS:
    """What was found, from the states at fractions of the period. States below `smallest` count as zero."""
    primes, shares = fractions(autonomous, order)
    away = distance(later, x)
    amplitude, size = jnp.max(away), smallest + jnp.max(jnp.abs(x))
    repeats = jnp.zeros((), bool)
    for p in primes:
        repeats = repeats | (away[int(np.argmin(np.abs(shares - 1 / p)))] <= 1e-6 * amplitude)
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.orbit_not_found)
    result = RESULTS.where(converged & repeats, RESULTS.orbit_is_multiple_cover, result)
    return RESULTS.where(autonomous & converged & (amplitude <= 1e-8 * size), RESULTS.orbit_is_equilibrium, result)
