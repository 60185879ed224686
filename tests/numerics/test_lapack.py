"""Functions of LAPACK in batches: the values of `jax.numpy.linalg`, in calls that jaxlib does not divide among threads."""

import ast
import math
import pathlib
import subprocess
import sys

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import nsjax
from nsjax import gallery
from nsjax._numerics import _lapack
from nsjax.equilibria import find_equilibrium


PACKAGE = pathlib.Path(nsjax.__file__).parent
RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(300, 5, 5)), RNG.normal(size=(300, 5))  # 28 to 533 in a group
PAIRS = {
    "solve": (_lapack.solve, jnp.linalg.solve),
    "solve for a matrix": (lambda a, b: _lapack.solve(a, a.T + b), lambda a, b: jnp.linalg.solve(a, a.T + b)),
    "inv": (lambda a, b: _lapack.inv(a), lambda a, b: jnp.linalg.inv(a)),
    "slogdet": (lambda a, b: _lapack.slogdet(a), lambda a, b: tuple(jnp.linalg.slogdet(a))),
    "qr": (lambda a, b: _lapack.qr(a), lambda a, b: tuple(jnp.linalg.qr(a))),
    "singular values": (lambda a, b: _lapack.singular_values(a), lambda a, b: jnp.linalg.svd(a, compute_uv=False)),
    "svd": (lambda a, b: _lapack.svd(a[:3])[1], lambda a, b: jnp.linalg.svd(a[:3], compute_uv=False)),
    "eigvals": (lambda a, b: jnp.sort(_lapack.eigvals(a)), lambda a, b: jnp.sort(jnp.linalg.eigvals(a))),
    "pinv": (lambda a, b: _lapack.pinv(a[:3]), lambda a, b: jnp.linalg.pinv(a[:3])),
}


def check(found, want):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11 * np.max(np.abs(y), initial=1e-300))


@pytest.mark.parametrize("name", PAIRS)
def test_values_and_derivatives_in_batches(name):
    """Alone, in a batch, in two axes of one, and with derivatives of both orders of transformation."""
    ours, theirs = PAIRS[name]
    check(ours(A[0], B[0]), theirs(A[0], B[0]))
    check(jax.jit(jax.vmap(ours))(A, B), jax.vmap(theirs)(A, B))
    nested = jax.jit(jax.vmap(jax.vmap(ours, (0, None)), (0, 0)))(A.reshape(3, 100, 5, 5), B[:3])
    check(nested, jax.vmap(jax.vmap(theirs, (0, None)), (0, 0))(A.reshape(3, 100, 5, 5), B[:3]))
    if name == "eigvals":  # sorted complex numbers
        return
    check(jax.jit(jax.vmap(jax.jacfwd(ours)))(A[:40], B[:40]), jax.vmap(jax.jacfwd(theirs))(A[:40], B[:40]))
    outside = jax.jit(jax.jacfwd(lambda a: jax.vmap(ours)(a, B[:40])))(A[:40])
    check(outside, jax.jacfwd(lambda a: jax.vmap(theirs)(a, B[:40]))(A[:40]))


def test_second_derivatives():
    ours, theirs = PAIRS["slogdet"]
    ours, theirs = (lambda a, b, fn=fn: fn(a, b)[1:] for fn in (ours, theirs))
    check(
        jax.vmap(jax.hessian(lambda a: ours(a, B[0])[0]))(A[:20]),
        jax.vmap(jax.hessian(lambda a: theirs(a, B[0])[0]))(A[:20]),
    )


@pytest.mark.parametrize("regular", [True, False])
def test_solver_of_lineax(regular):
    a = A[0].copy()
    if not regular:
        a[4] = a[0] + a[1]
    right = a @ B[0]
    operator = lx.MatrixLinearOperator(jnp.asarray(a))
    found = lx.linear_solve(operator, jnp.asarray(right), _lapack.LinearSolver(regular), throw=False).value
    np.testing.assert_allclose(found, np.linalg.pinv(a) @ right, rtol=1e-11)


# jaxlib's estimates of the work for one matrix (n, m): jaxlib/cpu/lapack_kernels.cc.
WORK = {
    "lu": lambda n, m: n * m * min(n, m),
    "triangular_solve": lambda n, m: n * m * max(n, m),
    "geqrf": lambda n, m: 2 * n * m * min(n, m),
    "householder_product": lambda n, m: 4 * n * m * min(n, m),
    "svd": lambda n, m: 10 * n * m * min(n, m),
    "eig": lambda n, m: 10 * n * m * min(n, m),
    "eigh": lambda n, m: 5 * n * m * min(n, m),
    "cholesky": lambda n, m: n * m * min(n, m) // 3,
    "schur": lambda n, m: 5 * n * m * min(n, m),
}


def largest_work(jaxpr):
    """The largest work of a call of LAPACK in a program."""
    found = [0]
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in WORK:
            *lead, n, m = eqn.invars[-1].aval.shape
            complex_numbers = jnp.issubdtype(eqn.invars[-1].aval.dtype, jnp.complexfloating)
            found.append(WORK[eqn.primitive.name](n, m) * math.prod(lead) * (3 if complex_numbers else 1))
        found += map(largest_work, jex.jaxprs_in_params(eqn.params))
        rule = eqn.params.get("call")
        if eqn.primitive.name == "custom_vmap_call":
            found.append(largest_work(rule.jaxpr))
    return max(found)


def test_the_work_of_a_batch_is_seen():
    lanes = jax.make_jaxpr(jax.vmap(jnp.linalg.solve))(np.zeros((8192, 4, 4)), np.zeros((8192, 4)))
    assert largest_work(lanes.jaxpr) == 8192 * 64
    ours = jax.make_jaxpr(jax.vmap(_lapack.solve))(np.zeros((8192, 4, 4)), np.zeros((8192, 4)))
    assert 64 <= largest_work(ours.jaxpr) < _lapack.UNDIVIDED


LANES = 100_000  # of two states


@pytest.mark.parametrize(
    "what",
    ["an equilibrium", "an orbit", pytest.param("an orbit by segments", marks=pytest.mark.slow), "a monodromy matrix"],
)
def test_no_program_of_ours_has_large_batches(what):
    """Pitfall 60."""
    entry = gallery.entry("1.1(2)")
    system, start = entry.system(), entry.orbit.y0
    methods = {"an orbit": "shooting", "an orbit by segments": "segments"}

    def fn(x):
        y0 = start._replace(x=x)
        if what == "an equilibrium":
            return find_equilibrium(gallery.StickSlip(F_slip=x), gallery.entry("3.4").orbit.y0, throw=False).y
        if what == "a monodromy matrix":
            return nsjax.fundamental_matrix(system, 0.0, 1.0, y0, throw=False)
        orbit = nsjax.find_orbit(system, y0, method=methods[what], throw=False)
        return orbit.multipliers

    program = jax.make_jaxpr(jax.vmap(jax.jacfwd(fn) if what == "an equilibrium" else fn))(np.ones(LANES))
    assert largest_work(program.jaxpr) < _lapack.UNDIVIDED


CALLS = (
    "solve",
    "inv",
    "pinv",
    "svd",
    "qr",
    "eig",
    "eigvals",
    "eigh",
    "eigvalsh",
    "cholesky",
    "slogdet",
    "det",
    "lstsq",
)


def test_two_modules_call_lapack():
    """Within programs; functions of NumPy are not."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in CALLS and ast.unparse(node.value) == "jnp.linalg":
                found.add(path.relative_to(PACKAGE).as_posix())
            if (
                isinstance(node, ast.Attribute)
                and ast.unparse(node.value) == "lx"
                and node.attr in ("LU", "SVD", "QR", "AutoLinearSolver")
            ):
                found.add(path.relative_to(PACKAGE).as_posix())
    assert found == {"_numerics/_lapack.py", "_numerics/_linalg.py"}


STRESS = """
import faulthandler
faulthandler.dump_traceback_later(240, exit=True)
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
from nsjax._numerics import _lapack
rng = np.random.default_rng(0)
a = rng.normal(size=(4, 8192, 4, 4))

@jax.jit
def run(a):
    each = [jax.vmap({call})(a[i]) for i in range(4)]  # which XLA hands to its threads together
    return sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(each))

for k in range({count}):
    run(a).block_until_ready()
print("done")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "call", ["lambda a: _lapack.solve(a, a[0])", "_lapack.singular_values", "_lapack.eigvals", "_lapack.qr"]
)
def test_batches_come_to_their_end(call):
    """Pitfall 60. With `jnp.linalg.solve` the first of these stands still within a second (jaxlib 0.10, two threads)."""
    count = 1000 if "solve" in call else 100
    code = STRESS.replace("{call}", call).replace("{count}", str(count))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0 and run.stdout == "done\n", run.stderr
