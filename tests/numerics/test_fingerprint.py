"""What a program is made of: equal if nothing differs, different if anything does that could matter."""

import functools
import itertools
import textwrap
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._fingerprint import Fingerprint, is_library, UnknownError


MODEL = """
import enum, math
from typing import NamedTuple
import equinox as eqx
import jax, jax.numpy as jnp
import numpy as np
import nsjax

TABLE = np.arange(3.0)
HALF = 0.5

class State(NamedTuple):
    x: jax.Array
    v: jax.Array

class Law(enum.Enum):
    COULOMB = 1
    STRIBECK = 2

def inner(x):
    return HALF * x

def force(x):
    def twice(x):
        return 2 * inner(x)
    return twice(x) + TABLE[0]

def ours(factor=3):
    def decorate(fn):
        return lambda *args: factor * fn(*args)
    return decorate

@ours()
def decorated(x):
    return x

jitted = jax.jit(lambda x: x + 1)

class Base(nsjax.System):
    def stiffness(self):
        return 1.0

class Model(Base):
    m: float = 1.0
    power: int = eqx.field(default=2, static=True)
    law: Law = eqx.field(default=Law.COULOMB, static=True)

    @property
    def weight(self):
        return 9.81 * self.m

    def vector_field(self, t, y, s):
        return State(y.v, -self.stiffness() * force(y.x) - s.belt * decorated(jitted(y.v)) + math.sin(1.0))

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - 0.2

    @belt.breakaway
    def belt(self):
        return 2.0
"""
CHANGES = [
    ("np.arange(3.0)", "np.arange(3.0) + 1"),
    ("HALF = 0.5", "HALF = 0.25"),
    ("return 2 * inner(x)", "return 3 * inner(x)"),
    ("return 2 * inner(x)", "return 2 * inner(2 * x)"),
    ("factor=3", "factor=4"),
    ("x + 1", "x - 1"),
    ("return 1.0", "return 1"),
    ("default=2", "default=3"),
    ("law: Law = eqx.field(default=Law.COULOMB", "law: Law = eqx.field(default=Law.STRIBECK"),
    ("9.81", "9.8"),
    ("math.sin", "math.cos"),
    ("y.v - 0.2", "y.v - 0.3"),
    ("return 2.0", "return 2.5"),
    ("class Model(Base)", "class Model(nsjax.System)"),
    ("    @belt.breakaway\n    def belt(self):\n        return 2.0\n", ""),
]


def written(text):
    """What the text of a module defines."""
    module = types.ModuleType("written_by_a_user")
    exec(compile(text, "a file of the user", "exec"), vars(module))
    return module


def print_of(*values, traced=True):
    fingerprint = Fingerprint()
    for value in values:
        (fingerprint.traced if traced else fingerprint.constant)(value)
    return fingerprint.digest


def model_of(text):
    module = written(text)
    return print_of((module.Model(), module.State(jnp.zeros(()), jnp.zeros(()))))


def test_the_same_code_is_the_same():
    assert model_of(MODEL) == model_of(MODEL)
    assert model_of(MODEL) == model_of(
        "# a comment\n\n" + MODEL.replace("    return HALF", "    # why\n    return HALF")
    )
    assert model_of(MODEL) == model_of(MODEL + "\n\nUNUSED = 3\n\ndef unused(x):\n    return x\n")


@pytest.mark.parametrize("old, new", CHANGES)
def test_whatever_differs_is_seen(old, new):
    """Constants, functions that functions call, globals, closures, defaults, base classes, static fields, decorators."""
    assert MODEL.count(old) == 1
    assert model_of(MODEL.replace(old, new)) != model_of(MODEL)


def test_numbers_of_the_model_are_none_of_the_program():
    """Its arrays are arguments, of which the kind counts."""
    module = written(MODEL)
    one, two = (module.Model(m=jnp.asarray(m)) for m in (1.0, 2.0))
    assert print_of(one) == print_of(two) != print_of(module.Model(m=1.0))
    kinds = [
        1.0,
        np.zeros(2),
        np.zeros(3),
        np.zeros(3, np.float32),
        np.zeros(3, int),
        np.zeros((3, 1)),
        jnp.asarray(1.0),
    ]
    kinds += [np.float64(1.0), (np.zeros(2),), [np.zeros(2)], {"a": np.zeros(2)}, None, 1, True, "a", b"a", -0.0, 0.0]
    for a, b in itertools.combinations(kinds, 2):
        same = isinstance(a, jax.Array) and isinstance(b, np.float64)
        assert (print_of(a) == print_of(b)) == (same and jnp.asarray(a).aval == jax.typeof(b))
    assert print_of(jnp.asarray(1.0)) != print_of(jnp.asarray([1.0])[0])  # the first is weakly typed


def test_arrays_that_a_program_takes_as_they_are():
    """Those in closures, defaults and static fields."""

    def holding(values, default=0):
        array = np.asarray(values)
        return lambda x, more=np.asarray(default): x + array + more

    assert print_of(holding([1.0])) == print_of(holding([1.0]))
    assert print_of(holding([1.0])) != print_of(holding([2.0]))
    assert print_of(holding([1.0])) != print_of(holding([1.0], 1))
    assert print_of(functools.partial(max, 1)) != print_of(functools.partial(max, 2))
    # Of a `Partial` of JAX they are arguments.
    partial = [jax.tree_util.Partial(jnp.sin, np.full(2, x)) for x in (1.0, 2.0)]
    assert print_of(partial[0]) == print_of(partial[1])


def test_objects_that_refer_to_themselves():
    class Knot:
        def __init__(self, value):
            self.value, self.me = value, self

    def again(n):
        return again(n - 1) if n else 0

    assert print_of(Knot(1)) == print_of(Knot(1)) != print_of(Knot(2))
    assert print_of(again) == print_of(again)


def test_rules_of_derivatives_are_code_too():
    def ruled(factor):
        @jax.custom_jvp
        def fn(x):
            return x

        fn.defjvp(lambda primals, tangents: (fn(*primals), factor * tangents[0]))
        return fn

    assert print_of(ruled(1.0)) == print_of(ruled(1.0)) != print_of(ruled(2.0))
    assert print_of(jax.jit(ruled(1.0))) != print_of(jax.jit(ruled(2.0)))


def test_modules_that_are_imported_within_a_function():
    def ours():
        import math

        import jax.numpy

        return math, jax.numpy

    def theirs():
        import helpers_of_a_user  # pyright: ignore[reportMissingImports]

        return helpers_of_a_user

    assert print_of(ours) == print_of(ours)
    with pytest.raises(UnknownError, match="helpers_of_a_user"):
        print_of(theirs)


def test_sets_have_no_order():
    words = [f"word {i}" for i in range(20)]
    assert print_of(frozenset(words), traced=False) == print_of(frozenset(reversed(words)), traced=False)
    assert print_of({1, 2}, traced=False) != print_of({1, 3}, traced=False)


@pytest.mark.parametrize(
    "thing", [types.ModuleType("helpers"), object(), iter([1]), np.asarray([object()]), open, memoryview(b"a")]
)
def test_what_cannot_be_told(thing):
    if thing is open:  # built in: known by name
        assert print_of(thing) == print_of(thing) != print_of(len)
        return
    with pytest.raises(UnknownError):
        print_of(lambda: thing)


def test_what_belongs_to_libraries():
    assert all(map(is_library, (jnp.sin.__wrapped__, eqx.Module, np.ndarray, int, functools.wraps, textwrap.dedent)))
    assert not any(map(is_library, (model_of, pytest.raises, written(MODEL).Model)))
