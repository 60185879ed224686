"""What the linearised flow makes of neighbours of a periodic orbit: a tube around it."""

from typing import Any, TYPE_CHECKING

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._numerics._text import components
from ..derivatives._variational import fundamental_matrix
from ..orbits._orbit import Orbit
from ._path import Arc, arcs, chosen
from ._phase import phase_portrait
from ._style import axes_or_new, Labels, legend as add_legend, mode_line


if TYPE_CHECKING:
    from matplotlib.axes import Axes

CORNERS = 64  # of the polygon that stands for an ellipse


def perturbation_tube(
    orbit: Orbit,
    x: str | None = None,
    y: str | None = None,
    *,
    radius: Any = None,
    ellipses: int = 16,
    samples: int = 800,
    ax: "Axes | None" = None,
    labels: Labels = None,
    surfaces: bool = True,
    events: bool = True,
    legend: bool = True,
) -> "Axes":
    """Draws an orbit in the phase plane with the tube that neighbours form around it, as far as they are linear.

    An ellipse of perturbations of the base point becomes, at time t, its image under Φ(t, t0), which jumps at events by
    their saltation matrices (section 3.2). Where the orbit sticks the image is a line, and stays one.

    **Arguments:**

    - `orbit`: an `Orbit`.
    - `x`, `y`: names of components of the state; by default the first two. Others are not perturbed.
    - `radius`: the semi-axes of the ellipse at the base point, in units of `x` and `y`, or one number for both; by
        default a twentieth of the extent of the orbit. The flow is linearised, whatever the size that is drawn.
    - `ellipses`: how many images are outlined, at equal distances along the orbit.
    - `samples`: of how many images the tube is made.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"x": "x [m]"}`; by default the names of the components.
    - `surfaces`, `events`: whether to draw them, as in `phase_portrait`.
    - `legend`: whether to explain the colours.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component, a radius that is not positive, or an orbit without Φ: one that
    was not found, or leaves a surface that repels.
    """
    from matplotlib.collections import PolyCollection

    if not isinstance(orbit, Orbit):
        raise ValueError(f"Argument `orbit` must be an `Orbit`, but is of type {type(orbit).__name__}.")
    if not bool(jnp.all(jnp.isfinite(orbit.monodromy))):
        raise ValueError(
            "Argument `orbit` must have a finite fundamental matrix, but its `monodromy` is not: it was not found, or "
            "leaves a surface that repels."
        )
    for name, count in (("ellipses", ellipses), ("samples", samples)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"Argument `{name}` must be a positive integer, but got {count!r}.")
    names = list(components(orbit.y0))
    x, y = chosen(components(orbit.y0), [x, y])
    sol = orbit.solve()
    pieces = arcs(sol)
    extent = np.array([np.ptp(np.concatenate([arc.y[name] for arc in pieces])) for name in (x, y)])
    extent = np.where(extent > 0, extent, 1.0)
    radius = np.broadcast_to(extent / 20 if radius is None else np.asarray(radius, float), (2,))
    if not (np.all(np.isfinite(radius)) and np.all(radius > 0)):
        raise ValueError(f"Argument `radius` must be positive, but got {radius}.")

    times, which = _times(pieces, (x, y), extent, samples)
    ts = np.array([float(orbit.t0), *times, float(orbit.t0 + orbit.period)])
    how: dict[str, Any] = orbit.integrator.arguments
    del how["adjoint"]
    phi = fundamental_matrix(orbit.system, ts[0], ts[-1], orbit.y0, ts=ts, mode=tuple(orbit.mode) or None, **how)
    plane = [names.index(x), names.index(y)]
    angle = np.linspace(0, 2 * np.pi, CORNERS + 1)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    images = np.einsum("tij,cj->tci", np.asarray(phi)[:, plane][:, :, plane], circle)
    states = jax.vmap(lambda t: jfu.ravel_pytree(sol.evaluate(t))[0])(jnp.asarray(ts, orbit.t0.dtype))
    images += np.asarray(states)[:, None, plane]

    ax = axes_or_new(ax)
    outlined = np.unique(np.round((np.arange(ellipses) + 0.5) / ellipses * len(times) - 0.5).astype(int))
    for i, arc in enumerate(pieces):
        colour = mode_line(sol.system, arc.mode)["color"]
        # Opaque, so that images which overlap are no darker; with an edge, as some have no area.
        face = PolyCollection(images[1:-1][which == i], facecolors=_pale(colour), edgecolors="face", zorder=0.5)
        ax.add_collection(face)
        for k in outlined[which[outlined] == i]:
            ax.plot(*images[1 + k].T, color=colour, linewidth=0.8, zorder=1.5)
    ax.plot(*images[0].T, color="black", linewidth=1.5, zorder=3, label="perturbations (linear)")
    ax.plot(*images[-1].T, color="black", linewidth=2.5, linestyle=(0, (1, 1)), zorder=3, label="one period later")
    phase_portrait(orbit, x, y, ax=ax, labels=labels, surfaces=surfaces, events=events, legend=False)
    if legend:
        add_legend(ax)
    return ax


def _times(
    pieces: list[Arc], names: tuple[str, str], extent: np.ndarray, samples: int
) -> tuple[Float[np.ndarray, " times"], np.ndarray]:
    """Times inside the arcs, about equally far apart along the orbit as it is drawn, and the arc of each."""
    times, which, lengths = [], [], []
    for arc in pieces:
        path = np.stack([arc.y[name] for name in names], axis=-1) / extent
        lengths.append(np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))]))
    whole = sum(length[-1] for length in lengths) or 1.0
    for i, (arc, length) in enumerate(zip(pieces, lengths)):
        count = 1 + int(samples * length[-1] / whole)
        # Not at its ends, where Φ jumps.
        times.append(np.interp((np.arange(count) + 0.5) / count * length[-1], length, arc.t))
        which.append(np.full(count, i))
    return np.concatenate(times), np.concatenate(which)


def _pale(colour: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    red, green, blue = (1 - 0.35 * (1 - value) for value in to_rgb(colour))
    return red, green, blue
