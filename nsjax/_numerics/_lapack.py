"""The functions of `jax.numpy.linalg` that call LAPACK, for programs that `vmap` may batch.

jaxlib (0.10 and 0.11) divides the work of a large batch among the threads of XLA's pool, and waits for them on a thread
of that pool: where every thread waits so, the program stands still for ever. A batch whose work is below a bound is not
divided. So larger ones are worked out in groups below it, one after the other.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from ._select import select


UNDIVIDED = 200_000  # operations, by jaxlib's estimate, below which a batch is not divided


class _Svd(NamedTuple):
    u: Array
    s: Array
    vh: Array


def _grouped(fn: Callable[..., Any], operations: int) -> Callable[..., Any]:
    """`fn` of matrices with any number of leading axes, in groups under `vmap`. jaxlib's estimate for one matrix is at
    most `operations` times the number of entries times the larger dimension, also of complex numbers."""

    @custom_vmap
    def groups(*matrices: Array) -> Any:
        lead = matrices[0].shape[:-2]
        shapes = [x.shape[len(lead) :] for x in matrices]
        work = max(operations * math.prod(shape) * max(shape) for shape in shapes)
        most, total = max(1, (UNDIVIDED - 1) // work), math.prod(lead)
        if total <= most:
            return fn(*matrices)
        flat = [x.reshape(total, *shape) for x, shape in zip(matrices, shapes)]
        found = lax.map(lambda group: fn(*group), flat, batch_size=most)
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), found)

    @groups.def_vmap
    def _lanes(size: int, batched: list[bool], *matrices: Array) -> tuple[Any, Any]:
        found = groups(*[x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(matrices, batched)])
        return found, jax.tree.map(lambda _: True, found)

    # JAX neither differentiates a `custom_vmap` whose rule calls itself, nor any in reverse mode: derivatives of these
    # functions are not in groups (those of `solve`, `inv` and `slogdet` are other systems, which are).
    call = jax.custom_jvp(lambda *matrices: groups(*matrices))
    call.defjvp(lambda primals, tangents: jax.jvp(fn, primals, tangents))
    return call


_solve = _grouped(jnp.linalg.solve, 3)
_slogdet = _grouped(lambda a: tuple(jnp.linalg.slogdet(a)), 3)
qr = _grouped(lambda a: tuple(jnp.linalg.qr(a)), 12)
eig = _grouped(lambda a: tuple(jnp.linalg.eig(a)), 30)
eigvals = _grouped(jnp.linalg.eigvals, 30)
_thin = _grouped(lambda a: _Svd(*jnp.linalg.svd(a, full_matrices=False)), 30)
_values = _grouped(ft.partial(jnp.linalg.svd, compute_uv=False), 30)


def solve(a: Array, b: Array) -> Array:
    """x with a x = b, a vector or the columns of a matrix."""
    if b.ndim == 1:
        return solve(a, b[:, None])[:, 0]
    return lax.custom_linear_solve(lambda x: a @ x, b, lambda _, b: _solve(a, b), lambda _, b: _solve(a.T, b))


def inv(a: Array) -> Array:
    """The inverse of a matrix."""
    return solve(a, jnp.eye(len(a), dtype=a.dtype))


@jax.custom_jvp
def slogdet(a: Array) -> tuple[Array, Array]:
    """The sign of the determinant of a matrix, and the logarithm of its absolute value."""
    return _slogdet(a)


@slogdet.defjvp
def _slogdet_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    sign, log = slogdet(*primals)
    return (sign, log), (jnp.zeros_like(sign), jnp.trace(solve(*primals, *tangents)))


def svd(a: Array) -> tuple[Array, Array, Array]:
    """The singular values of a matrix, with as many vectors on either side."""
    return _thin(a)


def singular_values(a: Array) -> Array:
    return _values(a)


def pinv(a: Array, rtol: float | None = None) -> Array:
    """The pseudoinverse of a matrix; singular values below `rtol`, relative to the largest, are zero. By default those
    are that are rounding."""
    u, s, vh = svd(a)
    good = s > (max(a.shape) * float(jnp.finfo(s.dtype).eps) if rtol is None else rtol) * s[0]
    return (vh.T * select(good, 1 / select(good, s, 1), 0)) @ u.T


class LinearSolver(lx.AbstractLinearSolver):
    """A solver of lineax, of systems for one vector: in place of `lineax.LU`, or where the matrix may be singular
    (`regular=False`) of `lineax.SVD`."""

    regular: bool = True

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Array:
        return operator.as_matrix()

    def compute(self, state: Array, vector: Array, options: dict[str, Any]) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        x = solve(state, vector) if self.regular else pinv(state) @ vector
        return x, lx.RESULTS.successful, {}

    def transpose(self, state: Array, options: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        return state.T, {}

    def conj(self, state: Array, options: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        return jnp.conj(state), {}

    def assume_full_rank(self) -> bool:
        return self.regular
