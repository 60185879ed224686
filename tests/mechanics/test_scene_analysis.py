"""Everything that a system can be used for, a scene can: its parameters go by path."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import impact_oscillator

import nsjax
from nsjax.mechanics import (
    Characteristic,
    Coulomb,
    Damper,
    Falling,
    ForceElement,
    Friction,
    Harmonic,
    Scene,
    SceneModel,
    Spring,
    StaticPoint,
)


BELT = Scene({"x": 1.0}, spring=Spring("x", k=1.0), belt=Friction("x", v=0.2, slip=1.0, stick=2.0))


def test_an_equilibrium_is_continued_over_a_path():
    """The mass on a belt rests in slip where the spring balances the friction, k x = F(v)."""
    scene = Scene(
        {"x": 1.0}, spring=Spring("x", k=2.0), damper=Damper("x"), belt=Friction("x", Falling(1.0, 3.0), v=0.5)
    )
    start = nsjax.find_equilibrium(scene, scene.state({"x": 0.3}))
    branch = nsjax.continue_equilibrium(scene, start, "belt.v", (0.3, 2.0))
    np.testing.assert_allclose(branch.ys.q.x, 0.5 / (1 + 3 * branch.values), rtol=1e-9)
    (hopf,) = branch.bifurcations
    # The slope of the characteristic, -δ F_s/(1 + δ v)², takes the damping away at v.
    np.testing.assert_allclose(hopf.value, (np.sqrt(3 / 0.1) - 1) / 3, rtol=1e-9)


class Blocks(SceneModel):
    """The same belt under two blocks, which are tied to walls and to each other."""

    v: float = 0.2
    k: float = 1.0
    m: float = 1.0

    @property
    def scene(self):
        ties = {f"tie{i}": Spring(f"x{i}", k=self.k) for i in (1, 2)}
        belts = {f"belt{i}": Friction(f"x{i}", StaticPoint(1.0, 1.5), v=self.v) for i in (1, 2)}
        return Scene({"x1": self.m, "x2": self.m}, **ties, **belts, spring=Spring({"x1": 1, "x2": -1}, k=self.k))


@pytest.mark.slow
def test_a_model_may_be_built_as_a_scene():
    """Derivatives by a number that enters several effects are the sums of those by each."""
    blocks = Blocks()
    y0 = blocks.state({"x1": 1.5, "x2": 0.3})

    def end(system, where, v):
        return jnp.stack(jax.tree.leaves(nsjax.solve(eqx.tree_at(where, system, v), 0.0, 4.0, y0).y1))

    one, slope = jax.jvp(lambda v: end(blocks, lambda b: b.v, v), (jnp.asarray(0.2),), (jnp.asarray(1.0),))
    where = lambda scene: (scene.belt1.v, scene.belt2.v)  # noqa: E731
    other, both = jax.jvp(
        lambda v: end(blocks.scene, where, (v, v)), (jnp.asarray(0.2),), (jnp.asarray(1.0),)
    )  # fmt: skip
    np.testing.assert_allclose(one, other, rtol=1e-12)
    np.testing.assert_allclose(slope, both, rtol=1e-10)
    assert "belt2" in str(blocks) and blocks.period is None
    with pytest.raises(ValueError, match="`Blocks.mass.x1` must be positive|mass of `x1` must be positive"):
        nsjax.solve(Blocks(m=-1.0), 0.0, 1.0, y0)


@pytest.mark.slow
def test_a_sweep_over_a_parameter():
    def end(v):
        scene = eqx.tree_at(lambda scene: scene.belt.v, BELT, v)
        return nsjax.solve(scene, 0.0, 1.0, scene.state({"x": 2.5})).y1.q.x

    values = jnp.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(nsjax.sweep(end, values), 1 + 1.5 * np.cos(1.0), rtol=1e-7)


def test_a_scene_may_be_batched():
    """As an argument of `vmap` and `jit`: names are no numbers, and stay out of them."""
    many = jax.vmap(lambda k: Scene({"x": 1.0}, spring=Spring("x", k=k), rub=Friction("x", Coulomb(0.1))))
    scenes = many(jnp.array([1.0, 4.0]))
    run = jax.jit(jax.vmap(lambda scene: nsjax.solve(scene, 0.0, 1.0, scene.state({"x": 1.0})).y1.q.x))
    k = np.array([1.0, 4.0])
    np.testing.assert_allclose(run(scenes), 0.1 / k + (1 - 0.1 / k) * np.cos(np.sqrt(k)), rtol=1e-7)
    slope = jax.jacfwd(lambda scene: scene.force("spring", 0.0, scene.state({"x": 2.0}), [1]))(BELT)
    assert slope.spring.k == -2.0 and slope.belt.v == 0.0


@pytest.mark.slow
def test_a_scene_is_smoothed_and_banded():
    rubbing = Scene({"x": 1.0}, spring=Spring("x", k=1.0), rub=Friction("x", Coulomb(0.3), v=0.2))
    y0 = rubbing.state({"x": 1.0})
    exact = nsjax.solve(rubbing, 0.0, 2.0, y0).y1.q.x
    for other in (nsjax.smoothed(rubbing, eps=1e4), nsjax.banded(rubbing, eta=1e-6)):
        np.testing.assert_allclose(nsjax.solve(other, 0.0, 2.0, y0, max_steps=20000).y1.q.x, exact, atol=2e-4)


class Strap(ForceElement):
    """It pulls, and does not push."""

    def force(self, t, at, s):
        return -jnp.maximum(at.d, 0.0)


def test_a_force_with_kinks_is_marked():
    scene = Scene({"x": 1.0}, strap=Strap("x"), rub=Friction("x", Characteristic(lambda w: 0.2 + 0 * w)))
    marked = nsjax.mark_kinks(scene, scene.state())
    assert [k.name for k in marked.switches] == ["rub", "max_1"]


@pytest.mark.slow
def test_an_orbit_is_continued_over_a_path(tmp_path):
    """Over the velocity of the belt, with the period in closed form, and saved."""
    orbit = nsjax.find_orbit(BELT, BELT.state({"x": 2.0}), period=13.5)
    branch = nsjax.continue_orbit(BELT, orbit, "belt.v", (0.15, 0.4))
    v = np.array([branch.orbit(i).system.belt.v for i in range(0, len(branch.values), 5)])
    periods = np.array([branch.orbit(i).period for i in range(0, len(branch.values), 5)])
    np.testing.assert_allclose(periods, 2 / v + np.pi + 2 * np.arctan(v), rtol=1e-9)
    branch.save(tmp_path / "branch.npz")
    again = nsjax.OrbitBranch.load(tmp_path / "branch.npz", BELT)
    np.testing.assert_array_equal(again.values, branch.values)
    assert again.orbit(0).y0.q.x == branch.orbit(0).y0.q.x


@pytest.mark.slow
def test_a_forced_orbit_with_impacts_is_continued():
    scene = impact_oscillator()
    start = nsjax.solve(scene, 0.0, 30 * scene.period, scene.state({"x": 0.0}))
    orbit = nsjax.find_orbit(scene, start.y1)
    assert orbit.stable
    branch = nsjax.continue_orbit(scene, orbit, "drive.omega", (1.65, 1.75))
    assert branch.values.min() < 1.66 and branch.values.max() > 1.74
    np.testing.assert_allclose(orbit.period, 2 * np.pi / 1.7)


def test_the_pictures_of_a_scene():
    matplotlib = pytest.importorskip("matplotlib.pyplot")
    import diffrax

    sol = nsjax.solve(BELT, 0.0, 10.0, BELT.state({"x": 2.5}), saveat=diffrax.SaveAt(dense=True))
    assert nsjax.plot.phase_portrait(sol).get_xlabel() == "q.x"
    assert nsjax.plot.time_series(sol, "v.x").get_ylabel() == "v.x"
    matplotlib.close("all")


def test_a_period_follows_the_parameter():
    scene = Scene({"x": 1.0}, spring=Spring("x"), damper=Damper("x", c=0.2), drive=Harmonic("x", omega=2.0))
    orbit = nsjax.find_orbit(scene, scene.state())
    np.testing.assert_allclose(orbit.y0.q.x, (1 - 4) / ((1 - 4) ** 2 + 0.16), rtol=1e-9)
