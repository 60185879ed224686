"""What the README and the docstrings say of a model works as it is printed there."""

import pathlib
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from models import Heat, Motion, Thermostat

import nsjax


ROOT = pathlib.Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
MODELLING = (ROOT / "docs" / "guide" / "modelling.md").read_text()


class Line(NamedTuple):
    x: Array | float


class Driven(nsjax.System):
    omega: float = 2.0

    def vector_field(self, t, y, s):
        return Line(-y.x + jnp.cos(self.omega * t))


def test_a_forced_model_says_its_period_as_in_the_guide():
    """Without it the error says what to write; with the lines of the guide the orbit is found, in closed form
    x(0) = 1/(1 + ω²)."""
    with pytest.raises(ValueError, match=r"has no `period`.*return 2 \* jnp.pi / self.omega"):
        nsjax.find_orbit(Driven(), Line(0.0), period=3.0)
    (block,) = [text for text in re.findall(r"```python\n(.*?)```", MODELLING, re.DOTALL) if "def period(self)" in text]
    namespace = {"jnp": jnp, "nsjax": nsjax, "Heat": Heat}
    exec(block, namespace)
    orbit = nsjax.find_orbit(namespace["Driven"](), Heat(0.0))
    np.testing.assert_allclose(orbit.y0.T, 1 / 5, atol=1e-12)
    assert "period" in nsjax.System.__doc__


def test_the_surfaces_of_a_relay_are_levels():
    """A relay that starts on where it should be off switches off at once, as its docstring says."""

    assert "levels and not edges" in nsjax.relay.__doc__
    system = Thermostat()
    sol = nsjax.solve(system, 0.0, 0.2, Heat(25.0), mode={"heater": 1})
    np.testing.assert_allclose(sol.y1.T, 5 + 20 * np.exp(-0.2), rtol=1e-8)
    assert not sol.mode1.any()


def test_what_cannot_be_vmapped_is_named():
    text = " ".join(README.split())
    assert (
        "set-valued eigenvalues and searches that try one thing after another run in Python; all else can be vmapped"
        in text
    )
    with pytest.raises(ValueError, match="`order` must be given under `jit` and `vmap`"):
        jax.vmap(lambda x: nsjax.find_orbit(nsjax.gallery.thesis("6.8"), Motion(x, 0.0), order=None).period)(
            jnp.ones(2)
        )
