"""Programs that are called for one point after the other: the same results as without."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics import _programs, _whole_loops
from nsjax._numerics._programs import keep_programs, Programs
from nsjax._numerics._repeated import Repeated, Same


class Found(NamedTuple):
    x: np.ndarray
    good: np.ndarray
    roots: tuple[np.ndarray, np.ndarray]
    count: np.ndarray


@pytest.fixture
def made(monkeypatch):
    """How often something was compiled."""
    seen, compile_ = [], Programs._compiled

    def spied(self, *args):
        seen.append(self)
        return compile_(self, *args)

    monkeypatch.setattr(Programs, "_compiled", spied)
    return seen


def fn(matrix, given, x):
    """With results of many kinds."""
    a, name = given
    roots = jnp.roots(jnp.stack([jnp.ones_like(a), a, a]), strip_zeros=False)
    return Found(matrix @ x, jnp.all(x > 0), (roots, a), jnp.asarray(len(name), jnp.int32))


MATRIX = np.asarray([[2.0, 1.0], [0.5, 3.0]])


def check(found, a, x):
    np.testing.assert_allclose(found.x, MATRIX @ x, rtol=1e-15)
    np.testing.assert_allclose(np.sort(found.roots[0]), np.sort(np.roots([1, a, a])), rtol=1e-14)
    assert found.good == np.all(x > 0) and found.roots[1] == a and found.count == 3
    kinds = [(type(part), part.dtype, part.shape) for part in jax.tree.leaves(found)]
    shapes = [(np.float64, x.shape), (bool, ()), (np.complex128, (2,)), (np.float64, ()), (np.int32, ())]
    assert kinds == [(np.ndarray, np.dtype(kind), shape) for kind, shape in shapes]


@pytest.mark.parametrize("loops", [False, True])
def test_results_of_all_kinds(made, loops):
    def told(*args):
        assert _whole_loops._here.wanted == loops
        return fn(*args)

    repeated = Repeated(told)
    for a in (1.0, 2.0):  # other arrays are no other program
        at = repeated.at(MATRIX, (jnp.asarray(a), "abc"), loops=loops)
        for x in (np.asarray([1.0, 2.0]), np.asarray([1.0, -2.0])):
            check(at(x), a, x)
    assert len(made) == 1
    check(at(np.ones((2, 3))), 2.0, np.ones((2, 3)))
    assert len(made) == 2
    jax.clear_caches()
    check(at(np.ones(2)), 2.0, np.ones(2))
    assert len(made) == 3
    repeated = Repeated(fn)
    at = repeated.at(MATRIX, (jnp.asarray(2.0), "abc"), loops=loops)
    with jax.disable_jit():
        check(at(np.ones(2)), 2.0, np.ones(2))


def test_settings_are_part_of_it():
    """The same arrays, and another program."""
    at = Repeated(lambda x: (x, jnp.zeros(()))).at()
    for wanted in (np.float64, np.float32, np.float64):
        with jax.enable_x64(wanted is np.float64):
            assert at(np.ones(2, np.float32))[1].dtype == wanted


def test_kept_from_one_process_to_the_next(made, tmp_path, monkeypatch):
    monkeypatch.setattr(_programs._Place, "folder", None)
    keep_programs(tmp_path)
    x = np.ones((2, 5))  # of no other test: what comes out of JAX's own cache is not written
    for _ in range(2):
        check(Repeated(fn).at(MATRIX, (jnp.asarray(1.0), "abc"))(x), 1.0, x)
    assert len(made) == 1 and len(list(tmp_path.iterdir())) == 1


def test_the_same_and_no_equal():
    a, b = np.ones(2), np.ones(2)
    assert Same(a) == Same(a) and hash(Same(a)) == hash(Same(a)) and Same(a) != Same(b) and Same(a) != a.tolist()
