"""`rtol`, `atol` in place of a step size controller, and integers in place of numbers."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion
from programs import compilations

import nsjax
from nsjax import gallery


SYSTEM = gallery.StickSlip()
START = Motion(1.0, 0.5)


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_tolerances_are_those_of_the_default_controller():
    """And what is given is the program of what is not."""

    def steps(**how):
        return nsjax.solve(SYSTEM, 0.0, 3.0, START, max_steps=512, **how)

    plain = steps()
    with compilations() as compiled:
        for given, (rtol, atol) in {
            (("rtol", 1e-4), ("atol", 1e-5)): (1e-4, 1e-5),
            (("rtol", 1e-4),): (1e-4, 1e-8),
            (("atol", 1e-5),): (1e-8, 1e-5),
            (("solver", dfx.Tsit5()),): (1e-8, 1e-8),
        }.items():
            want = steps(stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol))
            have = steps(**dict(given))
            same((have.y1, have.stats), (want.y1, want.stats))
        same((have.y1, have.stats), (plain.y1, plain.stats))
        assert int(steps(rtol=1e-4, atol=1e-4).stats["num_steps"]) < int(plain.stats["num_steps"])
        assert not compiled


def test_a_tolerance_may_vary_within_a_program():
    @jax.jit
    def end(tol):
        return nsjax.solve(SYSTEM, 0.0, 3.0, START, rtol=tol, atol=tol, max_steps=512).y1

    rough = end(1e-4)
    direct = nsjax.solve(SYSTEM, 0.0, 3.0, START, rtol=1e-4, atol=1e-4, max_steps=512).y1
    np.testing.assert_allclose(rough, direct, rtol=1e-15)  # not to the last bit: it is compiled in another way
    assert 1e-12 < abs(rough.x - end(1e-12).x) < 1e-3  # the tolerance makes a difference


def test_no_equation_for_tolerances():
    """The program is the same, whichever way they are given, to the last letter."""

    def text(**how):
        return str(jax.make_jaxpr(lambda y: nsjax.solve(SYSTEM, 0.0, 3.0, y, throw=False, **how).y1)(START))

    assert text() == text(rtol=1e-8) == text(rtol=1e-8, atol=1e-8)
    assert text() == text(stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8))


def test_every_function_that_takes_a_controller_takes_tolerances():
    import inspect

    found = []
    for module in (nsjax, nsjax.flow, nsjax.maps, nsjax.derivatives, nsjax.orbits, nsjax.continuation):
        for name, public in vars(module).items():
            if name.startswith("_") or not callable(public):
                continue
            try:
                names = inspect.signature(public).parameters
            except ValueError:
                continue
            if "stepsize_controller" in names:
                found.append(name)
                assert "rtol" in names and "atol" in names, name
    assert {"solve", "find_orbit", "continue_orbit", "continue_orbits", "brute_force", "poincare_map"} <= set(found)


@pytest.mark.parametrize(
    "call",
    [
        lambda **how: nsjax.find_orbit(SYSTEM, START, **how),
        lambda **how: nsjax.stroboscopic_map(gallery.ForcedFriction(), START, **how),
        lambda **how: nsjax.fundamental_matrix(SYSTEM, 0.0, 1.0, START, **how),
        lambda **how: nsjax.brute_force(SYSTEM, "v_dr", [0.2], START, **how),
        lambda **how: nsjax.continue_orbits([], "v_dr", (0.1, 0.3), **how),
    ],
)
def test_both_at_once_are_refused_everywhere(call):
    with pytest.raises(ValueError, match="Drop `rtol` and `atol`, or drop `stepsize_controller`"):
        call(rtol=1e-6, atol=1e-6, stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6))


@pytest.mark.parametrize(
    "integers, floats",
    [
        (Motion(1, 0), Motion(1.0, 0.0)),
        (Motion(np.asarray(1), 0.5), Motion(1.0, 0.5)),
        (Motion(np.int32(1), np.int8(0)), Motion(1.0, 0.0)),
        (np.array([1, 0]), np.array([1.0, 0.0])),
    ],
)
def test_integers_become_floating_point_numbers(integers, floats):
    from nsjax.flow._arguments import checked_state

    have, want = checked_state(integers), checked_state(floats)
    same(have, want)
    assert {x.dtype for x in jax.tree.leaves(have)} == {jnp.dtype("float64")}


def test_integers_take_the_precision_of_what_is_beside_them():
    from nsjax.flow._arguments import checked_state

    for y in (Motion(1, jnp.float32(0.5)), Motion(jnp.asarray(1), jnp.float32(0.5)), Motion(1.0, jnp.float32(0.5))):
        assert {x.dtype for x in jax.tree.leaves(checked_state(y))} == {jnp.dtype("float32")}


def test_integers_wherever_a_state_is_taken():
    """The programs are those of floating point numbers: none is compiled anew."""
    whole = Motion(2, 0)
    modes = ("belt", {"belt": 0}, {"belt": -1})
    same(
        nsjax.saltation_matrix(SYSTEM, 0, whole, *modes, throw=False),
        nsjax.saltation_matrix(SYSTEM, 0.0, Motion(2.0, 0.0), *modes, throw=False),
    )
    plane, one_step = gallery.HopfPitchfork(mu=1.0), dict(max_steps=1, throw=False)
    found = nsjax.find_equilibrium(plane, gallery.Plane(2, 0), **one_step)
    same(found.y, nsjax.find_equilibrium(plane, gallery.Plane(2.0, 0.0), **one_step).y)
    several = nsjax.find_equilibria(plane, gallery.Plane(np.array([2, -2]), np.array([0, 0])))
    assert len(several) >= 2
    same(
        nsjax.solve(SYSTEM, 0, 3, Motion(1, 0), max_steps=512).y1,
        nsjax.solve(SYSTEM, 0.0, 3.0, Motion(1.0, 0.0), max_steps=512).y1,
    )


def test_newton_s_steps_are_named_as_in_optimistix():
    found = nsjax.find_equilibrium(Toppling(), Motion(1.0, 0.0), max_steps=1, throw=False)
    assert found.result != nsjax.RESULTS.successful
    with pytest.raises(TypeError, match="`max_newton_steps"):
        nsjax.find_orbit(SYSTEM, START, max_iterations=3)  # type: ignore[call-arg]


class Toppling(nsjax.System):
    """A pendulum; beside its upper rest the variational equation takes more steps than the solution."""

    unit: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.unit * jnp.sin(y.x / self.unit))


def test_a_fundamental_matrix_that_takes_too_many_steps():
    system, start, options = Toppling(), Motion(3.14, 0.0), dict(rtol=1e-10, atol=1e-10)
    steps = int(nsjax.solve(system, 0.0, 10.0, start, solver=dfx.Dopri8(), **options).stats["num_steps"])
    matrix = nsjax.fundamental_matrix(system, 0.0, 10.0, start, max_steps=steps, throw=False, **options)
    assert np.all(np.isnan(matrix))
    with pytest.raises(nsjax.SolveError, match="max_steps"):
        nsjax.fundamental_matrix(system, 0.0, 10.0, start, max_steps=steps, **options)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_a_fundamental_matrix_does_not_depend_on_units(unit):
    want = nsjax.fundamental_matrix(Toppling(), 0.0, 10.0, Motion(3.0, 0.0))
    atol = 1e-10 * min(1.0, unit)
    matrix = nsjax.fundamental_matrix(Toppling(unit), 0.0, 10.0, Motion(3.0 * unit, 0.0), rtol=1e-10, atol=atol)
    np.testing.assert_allclose(matrix, want, rtol=1e-7, atol=1e-8)
