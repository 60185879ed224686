"""How solutions are computed: the method and its bounds, for `solve` and for all that is built on it."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from diffrax._root_finder import use_stepsize_tol
from jax.core import Tracer

from .._numerics._first_pass import is_first_pass, is_sweep
from .._numerics._select import select
from .steppers._exponential import AbstractExponential, Affine


class Integrator(NamedTuple):
    """Those arguments of `solve` that say how, and not what."""

    solver: Any  # until `checked` None, by default
    stepsize_controller: Any  # the same
    max_steps: int = 4096
    max_events: int = 256
    adjoint: dfx.AbstractAdjoint = dfx.ForwardMode()
    open: bool = False  # whether nothing was said of solver and steps, so that another method may be taken

    def __repr__(self) -> str:  # as it is kept in files
        return f"Integrator({', '.join(f'{name}={value!r}' for name, value in self.arguments.items())})"

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of `solve`."""
        return {name: value for name, value in self._asdict().items() if name != "open"}

    def checked(
        self,
        dtype: Any,
        tolerance: tuple[float, float] = (1e-8, 1e-5),
        *,
        rtol: Any = None,
        atol: Any = None,
        default: dfx.AbstractSolver = dfx.Tsit5(),
    ) -> "Integrator":
        """The same with a step size controller and a solver in the form that the loop needs.

        **Arguments:**

        - `dtype`: that of the state.
        - `tolerance`: the default, in double and in single precision.
        - `rtol`, `atol`: those of the default controller, in place of `tolerance`.
        - `default`: the solver, if none is given.
        """
        solver, adjoint = default if self.solver is None else self.solver, self.adjoint
        if not isinstance(solver, dfx.AbstractSolver):
            raise TypeError(
                f"Argument `solver` must be a diffrax solver such as `diffrax.Tsit5()`, but got {solver!r}."
            )
        for name, value in (("max_steps", self.max_steps), ("max_events", self.max_events)):
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"Argument `{name}` must be a positive integer, but got {value!r}.")
        if isinstance(solver, AbstractExponential) and isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
            raise ValueError(
                "Argument `adjoint` must not be `RecursiveCheckpointAdjoint` for `Exponential` or `Affine`, whose "
                "matrix exponential is a loop of unknown length; use `diffrax.DirectAdjoint()`."
            )
        controller = _controller(self.stepsize_controller, dtype, tolerance, dict(rtol=rtol, atol=atol))
        found = self._replace(solver=_implicit(solver, controller, adjoint), stepsize_controller=controller)
        return found._replace(open=self.solver is None and self.stepsize_controller is None)

    @property
    def takes_exact(self) -> bool:
        """Whether models for which there is an exact flow are solved by it: if `Affine` is named, and within a sweep if
        no method is."""
        by_model = is_sweep() and self.open and not isinstance(self.adjoint, dfx.RecursiveCheckpointAdjoint)
        return by_model or isinstance(self.solver, Affine)

    @property
    def may_be_plain(self) -> bool:
        """Whether the exact flow may leave over what is not plain, for a second program."""
        return is_first_pass() and self.takes_exact and isinstance(self.adjoint, dfx.ForwardMode)

    def smallest_size(self, dtype: Any) -> Any:
        """Returns the size below which states of an orbit count as zero: 1 in the unit of the state, unless an `atol`
        below the default of `find_orbit`, 1e-12 (float32: 1e-6), says that states are small. It is never zero."""
        default, least = 1e-12 if jnp.finfo(dtype).eps < 1e-10 else 1e-6, float(jnp.finfo(dtype).tiny)
        given = jax.tree.leaves(getattr(self.stepsize_controller, "atol", default))  # one for each leaf of the state?
        if all(isinstance(atol, float | int) for atol in given):
            return min(max(min(given) / default, least), 1.0)
        return jnp.clip(jnp.min(jnp.stack([jnp.min(atol) for atol in given])) / default, least, 1)

    def sizes_at(self, x: Any, field: Any, span: Any) -> Any:
        """Returns a bound of the size of each component of the state along a solution of length `span`, from a state x
        and the field there."""
        return jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(field * span)), self.smallest_size(x.dtype))

    def sizes_of(self, x: Any, field: Any, span: Any) -> Any:
        """Returns the size of each component of the state along a solution of length `span`, from the largest absolute
        values x of some of its states; where these are all zero, from the field at one of them."""
        small = x <= 1e-6 * jnp.abs(field * span)
        return select(small, self.sizes_at(x, field, span), jnp.maximum(x, self.smallest_size(x.dtype)))

    def in_sizes(self, dtype: Any) -> "Integrator":
        """The same for a state that is measured in its sizes."""
        controller = self.stepsize_controller
        if not hasattr(controller, "atol"):
            return self
        smallest = self.smallest_size(dtype)
        atol = jax.tree.map(lambda atol: atol / smallest, controller.atol)
        return self._replace(stepsize_controller=eqx.tree_at(lambda c: c.atol, controller, atol))

    def with_arrays(self, dtype: Any) -> "Integrator":
        """The same with tolerances that are arrays, so that a new one is no new program."""
        controller = self.stepsize_controller
        plain = [n for n in ("rtol", "atol") if isinstance(getattr(controller, n, None), (int, float))]
        controller = eqx.tree_at(
            lambda c: [getattr(c, n) for n in plain],
            controller,
            [jnp.asarray(getattr(controller, n), dtype) for n in plain],
        )
        return self._replace(stepsize_controller=controller)


def _implicit(solver: Any, controller: Any, adjoint: Any) -> Any:
    """Gives an implicit solver's root finder the tolerances of the step size controller, and the solver a kind of loop
    that can be differentiated, as diffrax does."""
    if not isinstance(solver, dfx.AbstractImplicitSolver):
        return solver
    open_ = [n for n in ("rtol", "atol", "norm") if getattr(solver.root_finder, n) is use_stepsize_tol]
    if open_ and not isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        raise ValueError(
            "Argument `stepsize_controller` must be adaptive for an implicit solver whose root finder has no "
            "tolerances, but got a fixed one. Use `diffrax.PIDController(rtol=..., atol=...)`, or pass "
            "`root_finder=diffrax.VeryChord(rtol=..., atol=..., norm=optimistix.max_norm)` to the solver."
        )
    if getattr(solver, "scan_kind", "") is None and not isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, "lax", is_leaf=lambda x: x is None)
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, n) for n in open_], solver, [getattr(controller, n) for n in open_]
    )


def _with_tolerances(controller: Any, given: dict[str, Any], default: float) -> dfx.AbstractStepSizeController:
    """The default controller with these tolerances."""
    names = " and ".join(f"`{name}`" for name in given)
    if controller is not None:
        raise ValueError(
            f"Argument `stepsize_controller` must not be given together with {names}, which set the tolerances of the "
            f"default one. Drop {names}, or drop `stepsize_controller`."
        )
    for name, value in given.items():
        numeric = eqx.is_array_like(value) and not isinstance(value, bool | complex)
        if not numeric or jnp.ndim(value) != 0:
            raise TypeError(f"Argument `{name}` must be a number, a tolerance such as 1e-8, but got {value!r}.")
    return dfx.PIDController(rtol=given.get("rtol", default), atol=given.get("atol", default))


def _controller(
    controller: Any, dtype: Any, tolerance: tuple[float, float], given: dict[str, Any]
) -> dfx.AbstractStepSizeController:
    eps = float(jnp.finfo(dtype).eps)
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        controller = _with_tolerances(controller, given, tolerance[0] if eps < 1e-10 else tolerance[1])
    elif controller is None:
        tol = tolerance[0] if eps < 1e-10 else tolerance[1]
        return dfx.PIDController(rtol=tol, atol=tol)
    if not isinstance(controller, dfx.AbstractStepSizeController):
        raise TypeError(
            "Argument `stepsize_controller` must be a diffrax step size controller, such as "
            f"`diffrax.PIDController(rtol=1e-8, atol=1e-8)`, but got {controller!r}."
        )
    values = {n: getattr(controller, n, None) for n in ("rtol", "atol")}
    values = {n: float(x) for n, x in values.items() if eqx.is_array_like(x) and not isinstance(x, Tracer)}
    source = "Arguments `rtol` and `atol`" if given else "Argument `stepsize_controller`"
    for name, value in values.items():
        if not value >= 0:
            raise ValueError(f"{source} must have {name} >= 0, but got {name} = {value}.")
    if len(values) == 2 and not any(values.values()):
        raise ValueError(f"{source} must have a tolerance above zero, but rtol = atol = 0.")
    for name, bound, allowed in (
        ("dtmax", "above zero", jnp.greater),
        ("dtmin", "of at least zero", jnp.greater_equal),
    ):
        limit = getattr(controller, name, None)
        if eqx.is_array_like(limit) and not isinstance(limit, Tracer) and not allowed(limit, 0):
            raise ValueError(f"{source} must have a step `{name}` {bound}, but got {name} = {float(limit)}.")
    rtol = getattr(controller, "rtol", None)
    # A step of size one is rounded by about eps; its error estimate by a few times that. (Inside `jit` the
    # tolerance may have no value yet.)
    least = 8 * eps
    known = eqx.is_array_like(rtol) and not isinstance(rtol, Tracer)
    if known and 0 < float(rtol) < least:
        cure = (
            "Call `jax.config.update('jax_enable_x64', True)` and pass float64 values, or loosen the tolerance."
            if eps > 1e-10
            else "Loosen the tolerance."
        )
        raise ValueError(
            f"{source} must have a tolerance that {dtype} can hold (rtol >= {least:.1e}), but "
            f"got rtol = {float(rtol):.1e}. {cure}"
        )
    return controller
