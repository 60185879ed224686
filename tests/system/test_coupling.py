"""What is independent is solved apart: the structure of the multipliers, against dense algebra and against systems that
stand alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from models import Motion, Point

import nsjax
from nsjax import solve
from nsjax.system._coupling import Coupling
from nsjax.system._mode import ModeState
from nsjax.system._model import SwitchedSystem


def blocks(*sizes, order=None):
    """Which values act on which surfaces, in blocks; `order` shuffles them."""
    owner = np.repeat(np.arange(len(sizes)), sizes)
    owner = owner if order is None else owner[order]
    return owner[:, None] == owner


def test_independent_values_are_one_column():
    found = Coupling.of(np.eye(5, dtype=bool), ())
    assert found.colours == ((0, 1, 2, 3, 4),) and found.groups == (((0,), (1,), (2,), (3,), (4,)),)


def test_colours_and_blocks():
    touches = np.eye(6, dtype=bool)
    touches[0, 3] = touches[4, 1] = True  # acts in one direction only: coupled all the same
    found = Coupling.of(touches, ((1, 4),))
    assert {frozenset(block) for group in found.groups for block in group} == {
        frozenset(block) for block in [(0, 3), (1, 4), (2,), (5,)]
    }
    assert ((1, 4),) in found.groups  # surfaces that may coincide are looked at one by one
    for i in range(6):  # of the values that act on one surface no two have one colour
        assert all(touches[i, list(colour)].sum() <= 1 for colour in found.colours)
    assert found.colours == ((0, 1, 2, 5), (3, 4))


class Stack(nsjax.System):
    """v' = p - A Sgn(v): the value of each switch acts where A has an entry."""

    A: np.ndarray
    p: Array

    @property
    def switches(self):
        return tuple(nsjax.sgn(lambda self, t, y, i=i: y.x[i], name=f"s{i}") for i in range(len(self.A)))

    def vector_field(self, t, y, s):
        n = len(self.A)
        rows = [sum(float(self.A[i, j]) * s[f"s{j}"] for j in range(n) if self.A[i, j]) for i in range(n)]
        return Point(self.p - jnp.stack(rows))


SHAPES = {
    "apart": blocks(1, 1, 1, 1, 1),
    "pairs": blocks(2, 2, 2, order=[0, 3, 1, 4, 2, 5]),
    "mixed": blocks(1, 2, 3, 1, order=[3, 6, 0, 1, 4, 2, 5]),
    "one large": blocks(5, 1, 1, order=[5, 0, 1, 6, 2, 3, 4]),
    "three": blocks(2, 1, order=[0, 2, 1]),
    "one way": np.tril(np.ones((4, 4), bool)),
    "one after the other": np.eye(5, dtype=bool) | np.eye(5, k=-1, dtype=bool),
    "bands": np.tri(7, k=1, dtype=bool) & np.tri(7, k=1, dtype=bool).T,
    "short chains": np.kron(np.eye(2), np.eye(3) + np.eye(3, k=1)).astype(bool)[:, [1, 0, 2, 4, 3, 5]][
        [1, 0, 2, 4, 3, 5]
    ],
}


@pytest.mark.parametrize("name", SHAPES)
def test_multipliers(name):
    """(2.20) over what is held, whatever the shape of the matrix, in lanes that hold different surfaces."""
    rng, touches = np.random.default_rng(0), SHAPES[name]
    m = len(touches)
    A = np.where(touches, rng.uniform(0.2, 1.0, (m, m)), 0.0) + 2 * np.eye(m)
    p, y = jnp.asarray(rng.normal(size=m)), Point(jnp.zeros(m))
    model = SwitchedSystem.forwards(Stack(A, p), jnp.asarray(0.0), y)
    modes = rng.integers(-1, 2, (16, m)).astype(np.int32)

    @jax.jit
    @jax.vmap
    def lanes(mode):
        state = ModeState.of(tuple(mode), (None,) * m)
        s = model.values(jnp.asarray(0.0), y, state)
        _, matrix = model.linear(jnp.asarray(0.0), y, state, tuple(mode.astype(float)))
        return jnp.stack(s), model.flow(jnp.asarray(0.0), y, state).x, matrix

    for mode, s, f, matrix in zip(modes, *lanes(jnp.asarray(modes))):
        np.testing.assert_allclose(matrix, -A, rtol=1e-14)
        held, want = mode == 0, mode.astype(float)
        want[held] = np.linalg.solve(A[np.ix_(held, held)], (p - A @ mode)[held])
        np.testing.assert_allclose(s, want, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(f, np.where(held, 0, p - A @ want), rtol=1e-12, atol=1e-13)


class Rubbing(nsjax.System):
    """n blocks on a belt that know nothing of each other; of one a stick-slip oscillator."""

    k: Array

    @property
    def switches(self):
        def contact(i):
            return nsjax.sgn(lambda self, t, y: y.v[i] - 0.3, name=f"b{i}").breakaway(lambda self: 1.5)

        return tuple(contact(i) for i in range(len(self.k)))

    def vector_field(self, t, y, s):
        friction = jnp.stack([s[f"b{i}"] for i in range(len(self.k))])
        return Motion(y.v, -self.k * y.x - friction)


@pytest.mark.slow
def test_blocks_that_know_nothing_of_each_other():
    """Six at once, more than are tried in all their modes, two of them the same: each is what it is alone, also where
    both are at their surfaces at one instant."""
    k, x = jnp.array([1.0, 1.3, 1.7, 1.3, 0.6, 2.2]), jnp.array([2.5, 1.8, 0.4, 1.8, -0.7, 1.1])
    together = solve(Rubbing(k), 0.0, 20.0, Motion(x, 0 * x))
    run = jax.jit(lambda k, x: solve(Rubbing(k), 0.0, 20.0, Motion(x, 0 * x)))
    number = 0
    for i in range(len(k)):
        alone = run(k[i : i + 1], x[i : i + 1])
        np.testing.assert_allclose(together.y1.x[i], alone.y1.x[0], atol=1e-7)
        own = together.events.t[together.events.switch == i]
        np.testing.assert_allclose(own, alone.events.t[: int(alone.events.num)], atol=1e-7)
        number += len(own)
    assert int(together.events.num) == number == 25 and together.unique
