"""What a scene is: a system that has just what its effects need, says what it is, and names mistakes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from programs import equations_of
from scenes import impact_oscillator, TWINS

import nsjax
from nsjax.mechanics import (
    Backlash,
    Contact,
    Coulomb,
    Damper,
    Effect,
    Friction,
    Harmonic,
    PolynomialSpring,
    Rigid,
    Scene,
    Spring,
    SquareWave,
    Velocity,
    Viscoelastic,
)


FULL = Scene(
    {"x": 1.0, "z": 2.0},
    spring=Spring("x", k=1.5),
    belt=Friction("x", v=0.2, slip=1.0, stick=2.0),
    stop=Contact(lambda q: 4.0 - q.x, Rigid(e=0.5), friction=Coulomb(mu=0.3, along="z")),
    drive=Harmonic("z", omega=2.0),
)


def program(system, y):
    y = jax.tree.map(jnp.asarray, y)
    return jax.make_jaxpr(lambda y: nsjax.solve(system, 0.0, 10.0, y, throw=False).y1)(y)


def size(system, y):
    return sum(1 for _ in equations_of(program(system, y).jaxpr))


@pytest.mark.parametrize("name", TWINS)
def test_a_scene_is_no_larger_than_a_model_by_hand(name):
    scene, hand, y = TWINS[name]
    sizes = size(scene, jax.tree.unflatten(jax.tree.structure(scene.state()), jax.tree.leaves(y))), size(hand, y)
    print(name, sizes, sizes[0] / sizes[1])
    assert sizes[0] <= 1.03 * sizes[1]


def test_an_effect_that_is_not_listed_leaves_no_trace():
    parts = dict(spring=Spring("x", k=1.0), belt=Friction("x", v=0.2, slip=1.0, stick=2.0))
    never = Scene({"x": 1.0}, **parts)
    more = dict(
        stop=Contact({"x": -1}, Rigid(), gap=4.0), drive=Harmonic("x"), damper=Damper("x"), play=Backlash("x", 2.0)
    )
    once = Scene({"x": 1.0}, **more, **parts)
    y = never.state({"x": 2.5})
    without = once.without(*more)
    assert jax.tree.structure(without) == jax.tree.structure(never)
    assert str(program(without, y)) == str(program(never, y))
    assert without.period is None and once.period is not None
    assert size(Scene({"x": 1.0}), y) < size(never, y) / 3


def test_a_chain_costs_what_its_links_cost():
    def field(n):
        names = [f"x{i}" for i in range(n)]
        links = {f"s{i}": Spring({names[i]: 1, names[i + 1]: -1}) for i in range(n - 1)}
        scene = Scene(dict.fromkeys(names, 1.0), **links)
        y = jax.tree.map(jnp.asarray, scene.state())
        return len(jax.make_jaxpr(lambda y: scene.vector_field(0.0, y, scene.values(())))(y).eqns)

    sizes = [field(n) for n in (4, 8, 12)]
    assert sizes[2] - sizes[1] == sizes[1] - sizes[0]


def test_a_state_is_read_by_name():
    y = FULL.state({"x": 2}, v={"z": -1.0})
    assert (y.q.x, y.q.z, y.v.x, y.v.z) == (2.0, 0.0, 0.0, -1.0)
    assert list(nsjax.plot.components(y)) == ["q.x", "q.z", "v.x", "v.z"]
    doubled = jax.jit(lambda y: jax.tree.map(lambda x: 2 * x, y))(y)
    assert type(doubled) is type(y) and doubled.q.x == 4
    many = jax.vmap(lambda x: FULL.state({"x": x}))(jnp.arange(3.0))
    np.testing.assert_array_equal(many.q.x, [0, 1, 2])
    with pytest.raises(ValueError, match="`q` must name coordinates of the scene .x, z., but names `X`.*Did you mean"):
        FULL.state({"X": 1.0})


def test_effects_and_parameters_are_read_by_name():
    assert FULL.belt.v == 0.2 and FULL.mass.z == 2.0 and FULL.stop.friction.law.mu == 0.3
    assert list(FULL.effects) == ["spring", "belt", "stop", "drive"]
    assert [k.name for k in FULL.switches] == ["belt", "stop", "stop.friction"]
    np.testing.assert_allclose(FULL.period, np.pi)
    with pytest.raises(AttributeError, match="no attribute or effect `bolt`. Did you mean `belt`?"):
        _ = FULL.bolt
    path = nsjax.system._parameter.parameter_path
    assert path(FULL, "belt.v") == ("belt", "v")
    assert path(FULL, "stop.e") == ("stop", "law", "e")
    assert path(FULL, "stop.mu") == path(FULL, "mu") == ("stop", "friction", "law", "mu")
    assert path(FULL, "mass.z") == ("mass", "z")
    smooth = nsjax.smoothed(Scene({"x": 1.0}, belt=Friction("x", Coulomb(), v=0.2)), eps=1e3)
    assert path(smooth, "belt.v") == path(smooth, "v") == ("system", "belt", "v")
    with pytest.raises(ValueError, match="must be one of spring.k, belt.v, .*Did you mean `belt.v`"):
        path(FULL, "belt.w")


def test_what_a_scene_prints():
    assert (
        str(FULL)
        == """\
scene of x, z
  1 x'' = spring + belt + stop
  2 z'' = stop.friction + drive
  spring         Spring along x: -k d,  k = 1.5
  belt           Friction along x: -slip s,  slip = 1, stick = 2, v = 0.2
  stop           Contact along d(q): N >= 0,  g' -> -e g',  e = 0.5
  stop.friction  Friction along z: -N (mu s),  mu = 0.3
  drive          Harmonic along z: f_0 cos(omega t),  f_0 = 1, omega = 2
  switches: belt (sgn), stop (impact), stop.friction (sgn)"""
    )
    assert "0 = 0" not in str(Scene({"x": 1.0})) and "1 x'' = 0" in str(Scene({"x": 1.0}))
    beam = Scene(["x", "phi"], mass=[[2.0, 0.5], [0.5, 1.0]], it=Spring({"x": 1, "phi": -2.0}))
    assert "2 x'' + 0.5 phi'' = it" in str(beam) and "along x - 2 phi" in str(beam)
    assert "Coriolis" in str(Scene(["x"], mass=lambda q: [[1 + q.x**2]]))
    assert jax.jit(lambda k: str(Scene({"x": k}, it=Spring("x", k=k))) and k)(1.0) == 1.0


def test_the_force_of_an_effect():
    y = FULL.state({"x": 1.0}, {"x": 0.2, "z": 0.5})
    modes = {"belt": 0, "stop": 0, "stop.friction": 1}
    np.testing.assert_allclose(FULL.force("spring", 0.0, y, modes), -1.5)
    np.testing.assert_allclose(FULL.force("belt", 0.0, y, modes), 1.5)  # sticks, and balances the spring
    np.testing.assert_allclose(FULL.force("belt", 0.0, y, [1, 0, 1]), -1.0)
    assert FULL.force("stop", 0.0, y, modes) == 0
    pressed = FULL.state({"x": 4.0}, {"z": 0.5})
    np.testing.assert_allclose(FULL.force("stop", 0.0, pressed, [-1, 1, 1]), -6 + 1)  # the wall would have to pull
    y = FULL.state({"x": -1.0}, {"x": 0.2, "z": 0.5})
    np.testing.assert_allclose(FULL.force("drive", np.pi / 2, y, modes), -1.0)
    with pytest.raises(
        ValueError, match=r"the mode of each switch \(belt, stop, stop.friction\), but got \{'belt': 0\}"
    ):
        FULL.force("belt", 0.0, y, {"belt": 0})
    with pytest.raises(ValueError, match="must name effects of the scene .*, but got 'bolt'.*Did you mean `belt`"):
        FULL.force("bolt", 0.0, y, modes)
    support = Scene({"x": 1.0}, s=Contact({"x": -1}, Viscoelastic(4.0, 0.5), gap=1.0))
    np.testing.assert_allclose(support.force("s", 0.0, support.state({"x": 1.5}), [1]), 2.0)


@pytest.mark.parametrize("scene", [FULL, impact_oscillator(), TWINS["chain"][0]])
def test_sketches_are_drawn(scene):
    ax = scene.sketch()
    texts = {text.get_text() for text in ax.texts}
    assert {*scene.coordinates, *scene.effects} <= texts
    ax.figure.draw_without_rendering()
    for arrow in ax.texts:  # those of forces stand highest
        assert arrow.get_text() or ax.viewLim.contains(*arrow.xy)
    other = nsjax.plot.sketch(scene.without(*scene.effects), ax=plt.figure().add_subplot())
    assert set(scene.coordinates) <= {text.get_text() for text in other.texts}
    plt.close("all")


@pytest.mark.parametrize("factor", [-1, -1.0, -2.0])
def test_a_stop_on_the_right_is_drawn_as_one(factor):
    """Whatever number the direction is written with: to the right of the block, and no circle tied to it."""
    scene = Scene(dict(x=1.0), wall=Contact({"x": factor}, Rigid(e=0.8), gap=1.0))
    ax = scene.sketch()
    (name,) = (text for text in ax.texts if text.get_text() == "wall")
    assert name.get_position()[0] > 0.5
    assert not any(line.get_marker() == "o" or line.get_linestyle() == "--" for line in ax.lines)
    plt.close("all")


def test_a_sketch_of_everything():
    scene = Scene(
        ["a", "b"],
        mass=lambda q: [[1.0, 0.0], [0.0, 1.0 + q.a**2]],
        odd=Spring(lambda q: q.a * q.b),
        turn=Damper(Velocity(lambda q, v: q.a * v.b)),
        play=Backlash({"a": 1, "b": -1}),
        rub=Friction({"a": 1, "b": -1}, Coulomb(0.3)),
        soft=Contact("b", Viscoelastic()),
        floor=Friction("b", Coulomb(0.3)),
        cubic=PolynomialSpring({"a": 2, "b": -1}, k3=1.0),
    )
    assert set(scene.effects) <= {text.get_text() for text in scene.sketch().texts}
    plt.close("all")


# Periods.


def test_forces_with_a_common_period():
    def scene(*omegas):
        return Scene({"x": 1.0}, **{f"f{i}": Harmonic("x", omega=o) for i, o in enumerate(omegas)})

    np.testing.assert_allclose(scene(2.0, 3.0).period, 2 * np.pi)
    np.testing.assert_allclose(scene(3.0, 2.0, 2.5).period, 4 * np.pi)
    np.testing.assert_allclose(Scene({"x": 1.0}, a=SquareWave("x", T=0.5), b=SquareWave("x", T=0.75)).period, 1.5)
    with pytest.raises(ValueError, match="periods of `f0` and `f1` must have a common multiple, but they are 6.28"):
        scene(1.0, np.sqrt(2))
    with pytest.raises(ValueError, match="periods of `f0` and `f1` must be known numbers where the scene is made"):
        jax.jit(lambda a, b: scene(a, b).period)(1.0, 2.0)
    assert jax.jit(lambda a: scene(a).period)(1.0) == 2 * jnp.pi
    two = scene(1.0, 2.0)
    changed = eqx.tree_at(lambda scene: scene.f0.omega, two, 0.9)
    with pytest.raises(ValueError, match="periods of `f0` and `f1` must have a common multiple"):
        _ = changed.period
    both = eqx.tree_at(lambda scene: (scene.f0.omega, scene.f1.omega), two, (0.9, 1.8))
    np.testing.assert_allclose(both.period, 2 * np.pi / 0.9)
    np.testing.assert_allclose(jax.jit(lambda scene: scene.period)(both), 2 * np.pi / 0.9)


# Mistakes.

MISTAKES = {
    "must act along coordinates of the scene .x, z., but asks for `X`.*Did you mean `x`": lambda: dict(it=Spring("X")),
    "function of effect `it` must ask for coordinates": lambda: dict(it=Spring(lambda q: q.y)),
    "function of effect `it` must return a scalar": lambda: dict(it=Spring(lambda q: jnp.stack([q.x, q.z]))),
    "`along` must be the name of a coordinate": lambda: dict(it=Spring(3.0)),
    "Effect `force` must have another name, as a scene has `force` already": lambda: dict(force=Spring("x")),
    "there is no effect `flor`.*Did you mean `floor`": lambda: dict(
        rub=Friction("x", Coulomb(), normal="flor"), floor=Contact("z", Rigid())
    ),
    "must take its normal force from a `Contact`, but `floor` is a `Spring`": lambda: dict(
        rub=Friction("x", Coulomb(), normal="floor"), floor=Spring("z")
    ),
    "Effect `stop.friction` must act along coordinates": lambda: dict(
        stop=Contact("x", Rigid(), friction=Coulomb(0.3, along="y"))
    ),
    "`friction` of `Contact` must say in which direction": lambda: dict(stop=Contact("x", Rigid(), friction=Coulomb())),
    "takes the normal force of this contact, but names `other`": lambda: dict(
        stop=Contact("x", Rigid(), friction=Friction("z", Coulomb(), normal="other"))
    ),
    "`law` of `Contact` must be": lambda: dict(stop=Contact("x", 0.5)),
    "`law` of `Friction` must be a friction law, or `slip`": lambda: dict(rub=Friction("x")),
    "give no `law`": lambda: dict(rub=Friction("x", Coulomb(), slip=1.0)),
    "must be a `FrictionLaw`": lambda: dict(rub=Friction("x", 1.0)),
    "`it` must be an instance of `nsjax.mechanics.Effect`.*Call it": lambda: dict(it=Spring),
    "must have one of `k1`, `k2`, `k3`": lambda: dict(it=PolynomialSpring("x")),
}


@pytest.mark.parametrize("text", MISTAKES)
def test_mistakes_are_named(text):
    with pytest.raises((ValueError, TypeError), match=text):
        Scene({"x": 1.0, "z": 1.0}, **MISTAKES[text]())


COORDINATES = {
    "mass of `z` must be positive, but is -1": lambda: Scene({"x": 1.0, "z": -1.0}),
    "mass of `x` must be positive, but is 0": lambda: Scene({"x": 0}),
    "must be positive definite, but has the eigenvalue -1": lambda: Scene(["x", "z"], mass=[[1.0, 2.0], [2.0, 1.0]]),
    "must be symmetric, but has 2 for .x, z. and 1 for .z, x.": lambda: Scene(
        ["x", "z"], mass=[[4.0, 2.0], [1.0, 4.0]]
    ),
    "mass matrix must be 2 by 2": lambda: Scene(["x", "z"], mass=np.eye(3)),
    "must name coordinates of the scene .x, z., but names `y`": lambda: Scene(["x", "z"], mass=lambda q: {"y": 1.0}),
    "The mass of `z` must be positive, but it has none": lambda: Scene(["x", "z"], mass=lambda q: {"x": 1.0}),
    "Argument `mass` must give the mass matrix just if": lambda: Scene(["x"]),
    "must give masses by name": lambda: Scene("x"),
    "names that can stand in `y.q.name`": lambda: Scene({"x 1": 1.0}),
    "must name at least one": lambda: Scene({}),
    "name each coordinate once": lambda: Scene(["x", "x"], mass=np.eye(2)),
}


@pytest.mark.parametrize("text", COORDINATES)
def test_mistakes_in_coordinates_and_masses_are_named(text):
    with pytest.raises((ValueError, TypeError), match=text):
        COORDINATES[text]()


class Stray(Effect):
    def forces(self, t, y, s):
        return {"y": y.q.x}


def test_mistakes_that_the_first_use_finds():
    for effect, text in (
        (Spring(Velocity(lambda q, v: v.x)), "`Velocity` is no derivative of a distance"),
        (Stray(), "Effect `it` must act along coordinates of the scene .x., but asks for `y`"),
    ):
        scene = Scene({"x": 1.0}, it=effect)
        with pytest.raises(ValueError, match=text):
            nsjax.solve(scene, 0.0, 1.0, scene.state())


def test_what_another_effect_needs_cannot_be_left_out():
    scene = Scene({"x": 1.0, "z": 1.0}, floor=Contact("z", Rigid()), rub=Friction("x", Coulomb(), normal="floor"))
    with pytest.raises(ValueError, match="Effect `rub` must take its normal force from a contact"):
        scene.without("floor")
    assert scene.without("rub", "floor").switches == ()
    with pytest.raises(ValueError, match="must name effects of the scene"):
        scene.without("flor")


def test_values_that_cannot_be_are_found_before_anything_is_solved():
    for scene, text in (
        (Scene({"x": 1.0}, stop=Contact("x", Rigid(e=1.5))), "`Scene.stop.restitution` must be a number from 0 to 1"),
        (Scene({"x": 1.0}, rub=Friction("x", slip=2.0, stick=1.0)), "`Scene.rub.breakaway` must be at least 1"),
        (Scene({"x": 1.0}, drive=Harmonic("x", omega=-1.0)), "`Scene.drive.omega` must be above zero, but is -1"),
    ):
        with pytest.raises(ValueError, match=text):
            nsjax.solve(scene, 0.0, 1.0, scene.state({"x": 1.0}))


def test_an_effect_is_abstract():
    with pytest.raises(TypeError, match="abstract"):
        Effect()  # pyright: ignore


def test_units_of_coordinates():
    """They are kept by `without`, and change nothing that is computed."""
    scene = Scene({"x": 1.0, "phi": 2.0}, units={"phi": "rad"}, it=Spring("x", k=1.0), shaft=Spring("phi", k=1.0))
    assert scene.units == {"phi": "rad"} == scene.without("it").units
    plain = Scene({"x": 1.0, "phi": 2.0}, it=Spring("x", k=1.0), shaft=Spring("phi", k=1.0))
    assert plain.units == {} and str(plain) == str(scene)
    with pytest.raises(ValueError, match=r"`units` must name coordinates of the scene \(x, phi\).*Did you mean `phi`"):
        Scene({"x": 1.0, "phi": 2.0}, units={"phy": "rad"})
