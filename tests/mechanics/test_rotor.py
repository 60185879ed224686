"""The forces on the drillstring against the equations of Appendix A, which are in polar coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax.mechanics import (
    Coulomb,
    Damper,
    Falling,
    FluidForce,
    Friction,
    Scene,
    Spring,
    stator_contact,
    TurningForce,
    Viscoelastic,
)


# Appendix C.6; J, k_phi, T_0 and delta are ours.
P = dict(m=1.0, m_f=1.0, c=0.3, D=0.1, k=1.0, R_c=1.0, R=2.0, k_b=50.0, c_b=30.0, mu=0.5, B_1=0.1, B_2=0.05)
OMEGA, J, K_PHI, T_0, DELTA = 1.3, 1.7, 0.8, 0.6, 0.4


def whirl(**fluid):
    p = P
    lateral = dict(
        kx=Spring("x", k=p["k"]), ky=Spring("y", k=p["k"]), cx=Damper("x", c=p["c"]), cy=Damper("y", c=p["c"])
    )
    rotation = dict(omega=OMEGA, **fluid)
    return lateral | dict(
        fluid=FluidForce("x", "y", p["m_f"], p["D"], B_1=p["B_1"], B_2=p["B_2"], **rotation),
        wall=stator_contact(
            "x", "y", Viscoelastic(p["k_b"], p["c_b"]), R_c=p["R_c"], R=p["R"], friction=Coulomb(p["mu"]), **rotation
        ),
    )


def whirl_model():
    """Section A.7: the rotor turns uniformly."""
    return Scene({"x": P["m"], "y": P["m"]}, **whirl())


def full_model():
    """Section A.9."""
    return Scene(
        {"x": P["m"], "y": P["m"], "phi": J},
        **whirl(spin="phi"),
        shaft=Spring("phi", k=K_PHI),
        bit=Friction("phi", Falling(T_0, DELTA), v=-OMEGA),
    )


def polar(r, dr, alpha, da, omega, roll, touch):
    """r'' and α'' by (A.15), with the contact force and its friction, and F_bT."""
    p = P
    f_n = (p["k_b"] * (r - p["R_c"]) + p["c_b"] * dr) * touch
    f_t = -p["mu"] * roll * f_n
    m_a, drag = p["m"] + p["m_f"], p["D"] + p["B_2"] * r**2
    stiff = p["k"] - omega**2 / 4 * p["m_f"] + p["m_f"] * omega * da + p["B_1"] * r**2
    ddr = r * da**2 - ((p["c"] + drag) * dr + stiff * r + f_n) / m_a
    dda = (p["m_f"] * omega * dr + drag * omega / 2 * r + f_t - (p["c"] + drag) * da * r) / m_a
    return ddr, (dda - 2 * dr * da) / r, f_t


@pytest.mark.parametrize("touch", [0, 1])
@pytest.mark.parametrize("roll", [-1, 1])
def test_whirl_with_fluid_and_contact_forces(touch, roll):
    """Cartesian accelerations of the scene, turned into polar ones, are those of (A.15) and (A.51)."""
    r, dr, alpha, da, phi, dphi = 1.1, 0.3, 0.7, -0.4, 0.2, 0.5
    c, s = np.cos(alpha), np.sin(alpha)
    q = dict(x=r * c, y=r * s)
    v = dict(x=dr * c - r * da * s, y=dr * s + r * da * c)
    switches = dict(wall=2.0 * touch - 1, **{"wall.friction": float(roll)}, bit=1.0)

    def accelerations(scene, q, v):
        y = jax.tree.map(jnp.asarray, scene.state(q, v))
        values = tuple(jnp.asarray(switches[k.name]) for k in scene.switches)
        return np.array(scene.vector_field(jnp.asarray(0.0), y, scene.values(values)).v)

    def expected(omega):
        ddr, dda, f_t = polar(r, dr, alpha, da, omega, roll, touch)
        radial, around = ddr - r * da**2, r * dda + 2 * dr * da
        f_alpha = P["m"] * around + P["c"] * da * r - f_t  # the fluid's, (A.14)
        return [radial * c - around * s, radial * s + around * c], f_t * P["R"] - f_alpha * r

    found = accelerations(whirl_model(), q, v)
    np.testing.assert_allclose(found, expected(OMEGA)[0], rtol=1e-12, atol=1e-12)
    lateral, torque = expected(OMEGA + dphi)
    bit = -T_0 / (1 + DELTA * (OMEGA + dphi))
    found = accelerations(full_model(), q | dict(phi=phi), v | dict(phi=dphi))
    np.testing.assert_allclose(found, [*lateral, (-K_PHI * phi + torque + bit) / J], rtol=1e-12, atol=1e-12)


def test_the_middle_of_the_stator_is_no_singularity():
    scene = full_model()
    y = jax.tree.map(jnp.asarray, scene.state({"phi": 0.3}))
    off = tuple(jnp.asarray(s) for s in (-1.0, 1.0, 1.0))
    slope = jax.jacfwd(lambda y: scene.vector_field(jnp.asarray(0.0), y, scene.values(off)))(y)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slope))


@pytest.mark.slow
def test_pure_rolling_has_its_radius_and_whirl_in_closed_form():
    """Equilibrium e4 of the whirl model without B_1, B_2: backward whirl Ω = -R ω/r, where the radial balance (A.31) is
    (k - ω²/4 m_f) r - m_f ω² R - m_a R² ω²/r + k_b (r - R_c) = 0."""
    omega, p = 0.5, P
    scene = Scene(
        {"x": p["m"], "y": p["m"]},
        kx=Spring("x", k=p["k"]),
        ky=Spring("y", k=p["k"]),
        cx=Damper("x", c=p["c"]),
        cy=Damper("y", c=p["c"]),
        fluid=FluidForce("x", "y", p["m_f"], p["D"], omega),
        wall=stator_contact(
            "x", "y", Viscoelastic(p["k_b"], p["c_b"]), R_c=p["R_c"], R=p["R"], friction=Coulomb(p["mu"]), omega=omega
        ),
    )
    a = p["k"] - omega**2 / 4 * p["m_f"] + p["k_b"]
    b = -(p["m_f"] * omega**2 * p["R"] + p["k_b"] * p["R_c"])
    r = max(np.roots([a, b, -(p["m"] + p["m_f"]) * (p["R"] * omega) ** 2]).real)
    y0 = scene.state({"x": r}, {"y": -p["R"] * omega})
    sol = nsjax.solve(scene, 0.0, 3.0, y0, mode={"wall": 1, "wall.friction": 0})
    assert list(sol.mode1) == [1, 0]
    angle = -p["R"] * omega / r * 3.0
    np.testing.assert_allclose([sol.y1.q.x, sol.y1.q.y], [r * np.cos(angle), r * np.sin(angle)], rtol=1e-6)


def test_a_force_that_turns():
    """On a mass held by springs: a circle of the radius f_0 / (k - m ω²), once it is on it."""
    omega, f_0, k, m = 0.7, 0.3, 2.0, 1.5
    scene = Scene(
        {"x": m, "y": m}, kx=Spring("x", k=k), ky=Spring("y", k=k), turns=TurningForce("x", "y", f_0=f_0, omega=omega)
    )
    assert float(scene.period) == pytest.approx(2 * np.pi / omega)
    r, t = f_0 / (k - m * omega**2), 2.3
    sol = nsjax.solve(scene, 0.0, t, scene.state(dict(x=r), dict(y=r * omega)))
    where = [sol.y1.q.x, sol.y1.q.y, sol.y1.v.x, sol.y1.v.y]
    c, s = np.cos(omega * t), np.sin(omega * t)
    np.testing.assert_allclose(where, [r * c, r * s, -r * omega * s, r * omega * c], atol=1e-7)
    with pytest.raises(ValueError, match="turns.omega"):
        nsjax.solve(Scene({"x": m, "y": m}, turns=TurningForce("x", "y", omega=-1.0)), 0.0, 1.0, scene.state())
