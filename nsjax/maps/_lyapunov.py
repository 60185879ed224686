"""Lyapunov exponents: how fast neighbouring solutions part on average, by orthogonalisation along the flow."""

from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics._compile import interactive
from .._numerics._lapack import qr, slogdet
from .._numerics._select import select
from .._numerics._text import listed, positive, shown
from .._types import Scalar, Y
from ..derivatives._saltation import saltation_matrices
from ..derivatives._variational import arcs
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._mode_flow import ModeFlow
from ..flow._results import is_okay, outcomes, raise_if, RESULTS
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._iterate import Start
from ._stroboscopic import Advance, phase_map


BLOCKS = 16  # the standard error is taken over at least so many


@shown
class LyapunovSpectrum(eqx.Module):
    """Lyapunov exponents of a solution.

    **Attributes:**

    - `exponents`: in descending order, as far as they are known, shape `(exponents,)` [1/time]. -inf where sticking, or
        an impact into rest, forgets a direction; NaN where the solution failed.
    - `errors`: their standard errors [1/time]; NaN where the exponent is not finite.
    - `rates`: what each interval contributes, shape `(span, exponents)` [1/time]; their mean is `exponents`.
    - `interval`: from one row to the next [time].
    - `divergence`: the mean rate at which volumes grow, from the trace of the field and the determinants of the
        saltation matrices [1/time], or None. The sum of all exponents must come to the same.
    - `y1`: the state at the end.
    - `result`: `RESULTS`.
    """

    exponents: Float[Array, " exponents"]
    errors: Float[Array, " exponents"]
    rates: Float[Array, "span exponents"]
    interval: Scalar
    divergence: Scalar | None
    y1: Y
    result: RESULTS

    @property
    def history(self) -> Float[Array, "span exponents"]:
        """The estimates after each interval [1/time]."""
        number = jnp.arange(1, self.rates.shape[-2] + 1, dtype=self.rates.dtype)
        return jnp.cumsum(self.rates, axis=-2) / number[:, None]

    @property
    def residual(self) -> Scalar | None:
        """By how much the sum of the exponents misses `divergence` [1/time]: NaN where both are infinite."""
        return None if self.divergence is None else jnp.sum(self.exponents, axis=-1) - self.divergence

    @property
    def dimension(self) -> Float[np.ndarray, "..."]:
        """The Kaplan-Yorke dimension of the attractor: j + (λ_1 + ... + λ_j) / |λ_{j+1}|, with the last j for which the
        sum is not negative. An exponent within two of its errors of zero counts as zero.

        **Raises:** `ValueError` where that takes more exponents than there are."""
        rates, errors = np.asarray(self.exponents), np.asarray(self.errors)
        rates = np.where(np.abs(rates) <= 2 * errors, 0, rates)
        size = sum(np.size(leaf) for leaf in jax.tree.leaves(self.y1)) // max(1, np.size(self.interval))
        if rates.shape[-1] < size and (np.cumsum(rates, axis=-1) >= 0).all(axis=-1).any():
            raise ValueError("The dimension takes more exponents than were asked for: leave out `exponents=`.")
        return np.vectorize(_kaplan_yorke, signature="(n)->()")(rates)

    def __str__(self) -> str:
        if self.rates.ndim > 2:
            many = f"{' x '.join(map(str, self.rates.shape[:-2]))} spectra"
            return f"{many} of {self.rates.shape[-1]} Lyapunov exponents\n  result  {outcomes(self.result)}"
        span = self.rates.shape[0]
        lines = [f"Lyapunov exponents over {span} intervals of {float(self.interval):.10g}: {outcomes(self.result)}"]
        for rate, error in zip(np.asarray(self.exponents), np.asarray(self.errors)):
            lines.append(f"  {rate:.8g}" + (f" ± {error:.1g}" if np.isfinite(error) else ""))
        if self.residual is not None:
            sums = listed(cast(Any, jnp.stack([jnp.sum(self.exponents), jnp.asarray(self.divergence)])))
            lines.append(f"  sum and mean divergence  {sums}")
        return "\n".join(lines)


def _kaplan_yorke(rates: np.ndarray) -> float:
    if not (rates == rates).all():
        return np.nan
    sums = np.cumsum(rates)
    j = int(np.argmin(sums >= 0)) if (sums < 0).any() else len(rates)
    if j in (0, len(rates)):
        return float(j)
    return j + sums[j - 1] / abs(rates[j])


class _Volume(ModeFlow):
    """The field of one mode, with the integral of its divergence."""

    def vector_field(self, t: Scalar, y: Any, s: Any) -> Any:
        flat, unravel = jfu.ravel_pytree(y[0])

        def rhs(x: Array) -> Array:
            return jfu.ravel_pytree(self.model.flow(t, unravel(x), self.state))[0]

        return unravel(rhs(flat)), jnp.trace(jax.jacfwd(rhs)(flat))


def _growth_of_volume(system: System, sol: Solution, t0: Scalar, y0: Y, integrator: Integrator) -> Scalar:
    """The logarithm of the factor by which a small volume has grown along a solution."""
    model = SwitchedSystem.forwards(system, t0, y0)
    begin, end, states, modes = arcs(sol, t0, y0)

    def arc(k: Array, total: Scalar) -> Scalar:
        y = jax.tree.map(lambda x: x[k], states)
        flow = _Volume(model, model.state_at(begin[k], y, tuple(modes[k])))
        sol = integrate(flow, begin[k], end[k], (y, jnp.zeros_like(t0)), integrator)
        return total + sol.y1[1]

    events = sol.events
    total = lax.fori_loop(0, events.num + 1, arc, jnp.zeros_like(t0))
    if not events.t.size:
        return total
    happened = jnp.arange(events.t.size, dtype=events.num.dtype) < events.num
    jumps = jax.vmap(slogdet)(saltation_matrices(system, events))[1]
    return total + jnp.sum(select(happened, jumps, 0))


def _orthogonalised(w: Array) -> tuple[Array, Array]:
    """W = Q R: Q, and the logarithms of the diagonal of R, minus infinity where there is nothing but rounding."""
    q, r = qr(w)
    size = jnp.abs(jnp.diagonal(r))
    rounding = 32 * len(w) * jnp.finfo(w.dtype).eps * jnp.linalg.norm(w)
    nothing = size <= rounding
    return q, select(nothing, -jnp.inf, jnp.log(select(nothing, 1, size)))


@interactive
def _follow(
    step: Advance,
    system: System,
    start: tuple[Scalar, Y, Any],
    basis: Array,
    counts: tuple[int, int, int],
    volume: bool,
) -> tuple[Array, Array | None, Y, RESULTS]:
    """The logarithms of each interval after the transient, and those of its parts together."""
    t0, y0, given = start
    transient, span, parts = counts
    begin: Start = step.start(system, t0, y0, given)
    _, unravel = jfu.ravel_pytree(y0)
    part = step.horizon(system, t0) / parts

    def lapse(here: tuple, k: Array) -> tuple[tuple, tuple]:
        x, mode, result, q = here
        a, b = begin.t0 + part * k, begin.t0 + part * (k + 1)

        def flow(x: Array) -> tuple[Array, Solution]:
            options = dict(mode=begin.given(system, mode) or None, still=True)
            sol = integrate(system, a, b, unravel(x), step.integrator, **options)
            return jfu.ravel_pytree(sol.y1)[0], sol

        along = jax.vmap(lambda v: jax.jvp(flow, (x,), (v,), has_aux=True), 1, (None, 1, None))
        x1, w, sol = along(q)
        # What has failed stays failed; it goes on from NaN, which takes no step.
        result = RESULTS.where(is_okay(result) & ~is_okay(sol.result), sol.result, result)
        lost = select(is_okay(result), 0, jnp.nan).astype(x.dtype)
        q, logs = _orthogonalised(w)
        grown = _growth_of_volume(system, sol, a, unravel(x), step.integrator) if volume else None
        return (x1 + lost, sol.mode1, result, q), (logs + lost, grown)

    here = jfu.ravel_pytree(begin.y)[0], begin.mode, begin.result, basis
    # One loop, transient included: a second would be a program of the same size.
    turns = jnp.tile(jnp.arange(parts, dtype=part.dtype), transient + span)
    (x, _, result, _), rows = lax.scan(lapse, here, turns)

    def by_interval(x: Array) -> Array:
        return jnp.sum(x.reshape(transient + span, parts, *x.shape[1:]), axis=1)[transient:]

    logs, grown = jax.tree.map(by_interval, rows)
    return logs, grown, unravel(x), result


def standard_errors(rates: Float[Array, "span exponents"]) -> Float[Array, " exponents"]:
    """The largest that the three longest blocks of 1, 2, 4, ... intervals give: rates that follow one another are not
    independent, and those of an orbit of several intervals cancel in long blocks only."""
    span, found = len(rates), []
    length = 1
    while length == 1 or span // length >= BLOCKS:
        blocks = span // length
        means = jnp.mean(rates[: blocks * length].reshape(blocks, length, -1), axis=1)
        found.append(jnp.std(means, axis=0, ddof=1) / blocks**0.5)
        length *= 2
    error = jnp.max(jnp.stack(found[-3:]), axis=0)
    return select(jnp.isfinite(jnp.mean(rates, axis=0)), error, jnp.nan)


def lyapunov_spectrum(
    system: System,
    y0: Y,
    *,
    transient: int,
    span: int,
    exponents: int | None = None,
    interval: Any = None,
    parts: int = 1,
    divergence: bool = False,
    t0: Any = 0.0,
    mode: Any = None,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 256,
    throw: bool = True,
) -> LyapunovSpectrum:
    """The Lyapunov exponents of a solution: a basis of perturbations is carried along the flow, jumps at events
    included (the saltation matrices of Müller 1995), and orthogonalised after each interval (Benettin et al. 1980).

    ```python
    found = nsjax.lyapunov_spectrum(system, State(1.0, 0.0), transient=200, span=10_000)
    print(found, found.dimension)
    ```

    A largest exponent that is positive means chaos. It vmaps over states and parameters. Those of a solution that
    tends to a periodic orbit are the logarithms of its Floquet multipliers over the period. One of an autonomous system
    is 0, if it does not come to rest.

    **Arguments:**

    - `system`: the model.
    - `y0`: the state at `t0`.
    - `transient`: how many intervals are left out; the basis turns into its directions meanwhile.
    - `span`: how many intervals are averaged over.
    - `exponents`: how many, from the largest on; by default as many as the state has components.
    - `interval`: of an autonomous system, the time between two rows of `LyapunovSpectrum.rates`: that of one
        oscillation or so. A forced one is taken from period to period.
    - `parts`: the basis is orthogonalised so many times in an interval. What shrinks within one part by more than
        rounding tells (a factor of 1e13 in float64) counts as forgotten.
    - `divergence`: whether to compute the mean growth of volumes by another way, as a check.
    - `t0`: the phase of the forcing [time].
    - `mode`, `solver`, `stepsize_controller`, `rtol`, `atol`: as for `solve`. `max_steps`, `max_events`: for each part.
    - `throw`: whether a failure raises; if not, look at `LyapunovSpectrum.result`.

    **Returns:** a `LyapunovSpectrum`.

    **Raises:** `ValueError` for mistakes in the arguments; a runtime error where `solve` fails.
    """
    positive("transient", transient + 1 if isinstance(transient, int) else transient)
    for name, number in (("span", span), ("parts", parts)):
        positive(name, number)
    t0, y0, given = checked_start(system, t0, y0, mode)
    size = len(jfu.ravel_pytree(y0)[0])
    number = size if exponents is None else exponents
    positive("exponents", number)
    if number > size:
        raise ValueError(f"Argument `exponents` must be at most {size}, the components of the state, but got {number}.")
    if divergence and number < size:
        raise ValueError("`divergence=True` needs all exponents: leave out `exponents=`.")
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(t0.dtype, rtol=rtol, atol=atol)
    system = arrays_of(system, t0.dtype)
    step = _step(system, interval, t0, integrator)
    # No direction of the coordinates: one of these may never turn into that of the largest exponent.
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((size, number)))[0].astype(t0.dtype)
    logs, grown, y1, result = _follow(
        step, system, (t0, y0, given), jnp.asarray(basis), (transient, span, parts), divergence
    )
    time = step.horizon(system, t0)
    rates = logs / time
    mean = None if grown is None else jnp.mean(grown) / time
    out = LyapunovSpectrum(jnp.mean(rates, axis=0), standard_errors(rates), rates, time, mean, y1, result)
    return raise_if(~is_okay(result), result, out) if throw else out


def _step(system: System, interval: Any, t0: Scalar, integrator: Integrator) -> Advance:
    if system.period is not None:
        if interval is not None:
            raise ValueError(
                "A forced system is taken from period to period: leave out `interval=`; `parts=` divides the period."
            )
        return phase_map(system, 1, integrator)
    if interval is None:
        raise ValueError(
            f"`{type(system).__name__}` is autonomous: argument `interval` must say after what time the basis is "
            "orthogonalised, that of one oscillation or so."
        )
    return Advance(integrator, 1, jnp.asarray(interval, t0.dtype))
