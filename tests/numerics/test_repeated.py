"""Programs that are called for one point after the other: the same results as without."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nsjax._numerics import _programs
from nsjax._numerics._programs import keep_programs
from nsjax._numerics._repeated import Repeated, Same


class Found(NamedTuple):
    x: np.ndarray
    good: np.ndarray
    roots: tuple[np.ndarray, np.ndarray]
    count: np.ndarray


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


def test_results_of_all_kinds():
    traced = []

    def told(*args):
        traced.append(args)
        return fn(*args)

    repeated = Repeated(told)
    for a in (1.0, 2.0):  # other arrays are no other program
        at = repeated.at(MATRIX, (jnp.asarray(a), "abc"))
        for x in (np.asarray([1.0, 2.0]), np.asarray([1.0, -2.0])):
            check(at(x), a, x)
    assert len(traced) == 1
    check(at(np.ones((2, 3))), 2.0, np.ones((2, 3)))
    assert len(traced) == 2
    jax.clear_caches()
    check(at(np.ones(2)), 2.0, np.ones(2))
    assert len(traced) == 3
    with jax.disable_jit():
        check(at(np.ones(2)), 2.0, np.ones(2))


def test_numbers_that_are_equal_and_no_others():
    """True is 1, and another program."""
    repeated = Repeated(lambda flag, x: x + (2 if flag is True else 3))
    assert [float(repeated.at(flag)(np.zeros(()))) for flag in (True, 1, True)] == [2, 3, 2]


def test_settings_are_part_of_it():
    """The same arrays, and another program."""
    at = Repeated(lambda x: (x, jnp.zeros(()))).at()
    for wanted in (np.float64, np.float32, np.float64):
        with jax.enable_x64(wanted is np.float64):
            assert at(np.ones(2, np.float32))[1].dtype == wanted


def test_kept_from_one_process_to_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(_programs._Place, "folder", None)
    keep_programs(tmp_path)
    traced, trace = [], _programs._traced
    monkeypatch.setattr(_programs, "_traced", lambda *given: traced.append(given) or trace(*given))
    x = np.ones((2, 5))
    for _ in range(2):
        check(Repeated(fn).at(MATRIX, (jnp.asarray(1.0), "abc"))(x), 1.0, x)
    assert len(traced) == 1 and len(list(tmp_path.iterdir())) == 1


def test_the_same_and_no_equal():
    a, b = np.ones(2), np.ones(2)
    assert Same(a) == Same(a) and hash(Same(a)) == hash(Same(a)) and Same(a) != Same(b) and Same(a) != a.tolist()
