"""The generalized Jacobian of a non-smooth continuous field: what it is on each side of the surfaces at a point."""

import itertools
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics._text import between, shown
from .._types import Y
from ..flow._arguments import checked_start
from ..system._model import SwitchedSystem
from ..system._parameter import get_parameter, parameter_path, put_parameter
from ..system._system import arrays_of, System


LARGE = 4  # rows of a matrix that is not printed in full


@shown
class GeneralizedJacobian(NamedTuple):
    """The vertices of Clarke's generalized Jacobian, whose convex hull it is (4.16).

    **Attributes:**

    - `surfaces`: the names of the switches on whose surfaces the point lies.
    - `vertices`: ∂f/∂y on each side of each: one axis of length two for every surface, the side h < 0 first, then
        `(n, n)`. As `eigenvalue_crossings` takes them: for one surface `*vertices`, for two `vertices`.
    - `by_parameter`: ∂f/∂μ likewise, then `(n,)`; None if no parameter was named. (5.14), (5.21)
    """

    surfaces: tuple[str, ...]
    vertices: Float[Array, "*sides n n"]
    by_parameter: Float[Array, "*sides n"] | None

    def __str__(self) -> str:
        where = " and ".join(self.surfaces) or "no surface"
        lines = [f"generalized Jacobian on {where}"]
        for side in itertools.product((0, 1), repeat=len(self.surfaces)):
            named = ", ".join(f"{name} {'> 0' if s else '< 0'}" for name, s in zip(self.surfaces, side))
            matrix = np.asarray(self.vertices[side])
            rows = "; ".join(" ".join(f"{x:.6g}" for x in row) for row in matrix)
            if len(matrix) > LARGE:
                rows = f"{len(matrix)} rows, entries {between(matrix)}"
            lines.append(f"  {named + ': ' if named else ''}[{rows}]")
        return "\n".join(lines)


def generalized_jacobian(
    system: System,
    y: Y,
    *,
    t: Any = 0.0,
    parameter: str | None = None,
    mode: Any = None,
    tolerance: float | None = None,
) -> GeneralizedJacobian:
    """The generalized Jacobian of a field that is continuous, but has kinks on the surfaces of `sgn` switches.

    Such a field is written with `sgn` switches: |h| is `h * s.name`, max(0, h) is `h * (1 + s.name) / 2`; or with
    `jnp.abs` and the like, of which `mark_kinks` makes such switches. Away from surfaces there is one vertex, the
    Jacobian.

    **Arguments:**

    - `system`: the model.
    - `y`: the point.
    - `t`: the time.
    - `parameter`: the name of a field of `system`, for ∂f/∂μ.
    - `mode`: values of relays, 0 by default.
    - `tolerance`: how small |h| counts as zero, by default 1e-9 (float32: 1e-4).

    **Returns:** a `GeneralizedJacobian`.

    **Raises:** `ValueError` where the field jumps at the point: there it has no generalized Jacobian (see
    `saltation_matrix` for what a solution's derivative does); or for an unknown parameter.
    """
    t, y, given = checked_start(system, t, y, mode)
    system = arrays_of(system, t.dtype)
    small = (1e-9 if jnp.finfo(t.dtype).eps < 1e-10 else 1e-4) if tolerance is None else tolerance
    model = SwitchedSystem.forwards(system, t, y)
    flat, unravel = jfu.ravel_pytree(y)
    values, on = [], []
    for k, switch in enumerate(model.switches):
        if not switch.signed:
            values.append(jnp.asarray(given.get(switch.name, 0), t.dtype))
            continue
        h = model.least(k, t, y)
        on += [k] * bool(jnp.abs(h) <= small)
        values.append(jnp.sign(h))
    surfaces = tuple(model.switches[k].name for k in on)

    def sided(side: tuple[int, ...]) -> tuple[Any, ...]:
        s = list(values)
        for k, sign in zip(on, side):
            s[k] = jnp.asarray(sign, t.dtype)
        return tuple(s)

    def field(system: System, x: Array, s: tuple) -> Array:
        return jfu.ravel_pytree(SwitchedSystem.forwards(system, t, y).field(t, unravel(x), s))[0]

    sides = [sided(side) for side in itertools.product((-1, 1), repeat=len(on))]
    fields = jnp.stack([field(system, flat, s) for s in sides])
    jump = jnp.max(jnp.abs(fields - fields[0]))
    if jump > 1e3 * small * (1 + jnp.max(jnp.abs(fields))):
        raise ValueError(
            f"The field of `{type(system).__name__}` jumps by {float(jump):.3g} on the surface of "
            f"{' and '.join(surfaces)}: it is of Filippov's type there, and has no generalized Jacobian."
        )
    shape = (2,) * len(on)
    vertices = jnp.stack([jax.jacfwd(lambda x, s=s: field(system, x, s))(flat) for s in sides])
    by_parameter = None
    if parameter is not None:
        path = parameter_path(system, parameter)

        def moved(p: Array, s: tuple) -> Array:
            return field(put_parameter(system, path, p), flat, s)

        rows = [jax.jacfwd(moved)(get_parameter(system, path), s) for s in sides]
        by_parameter = jnp.stack(rows).reshape(*shape, -1)
    return GeneralizedJacobian(surfaces, vertices.reshape(*shape, *vertices.shape[1:]), by_parameter)
