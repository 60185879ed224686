"""The falling friction characteristic of (2.28) and (2.31)."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def falling(s: Float[Array, ""], v_rel: Float[Array, ""], delta: Float[Array, ""]) -> Float[Array, ""]:
    """s / (1 + δ|v_rel|) with s in Sgn(v_rel), as a function that is affine in s and smooth at v_rel = 0 for fixed s.

    It is ½(1 + s) g(v_rel) - ½(1 - s) g(-v_rel) with g(w) = 1 / (1 + δ w): each region's own characteristic, weighted
    by s, hence exact for s = ±1, and s itself while sticking at v_rel = 0.

    **Arguments:**

    - `s`: the value of the switch.
    - `v_rel`: relative velocity of the rubbing bodies [m/s].
    - `delta`: δ > 0, how fast friction falls [s/m].

    **Returns:** the friction force over its value at v_rel = 0 (dimensionless).
    """

    # |v_rel| itself would not do: at an event v_rel is zero up to rounding, so that its derivative would be that of
    # the region which rounding chose and not that of the region s. The g of one region continues smoothly to the
    # other side, where stages of an overshooting step ask for it; it is held constant from δ w = -1/2, before its pole
    # at δ w = -1. Only s of the wrong sign gives weight to values there.
    def g(w: Float[Array, ""]) -> Float[Array, ""]:
        return 1 / (1 + jnp.maximum(delta * w, -0.5))

    return (1 + s) / 2 * g(v_rel) - (1 - s) / 2 * g(-v_rel)
