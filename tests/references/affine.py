"""Random piecewise-affine systems (`exact.Case`) as models."""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from exact import Shape
from jaxtyping import Array

import nsjax


class Affine(nsjax.System):
    """`exact.Case` as a model; columns that are zero for a shape are left out, so that their structure is known."""

    F: Array
    D: Array
    G: Array
    off: Array
    bound: Array
    e: Array
    omega: Array
    shape: Shape = eqx.field(static=True)

    def extended(self, t, y, clock):
        ticks = [jnp.cos(self.omega * t), jnp.sin(self.omega * t)] if clock else []
        return jnp.concatenate([y, jnp.ones(1), *[x[None] for x in ticks]])

    def signals(self, t):
        """Functions of time that jump."""
        return jnp.zeros(0)

    def whole(self, t, y, clock):
        return jnp.concatenate([self.extended(t, y, clock), self.signals(t)])

    def vector_field(self, t, y, s):
        z, n = self.whole(t, y, self.shape.forced), self.shape.positions
        force = self.F[n:, : len(z)] @ z + self.D[n:] @ jnp.stack([s[k.name] for k in switches(self.shape)])
        return jnp.concatenate([y[n : 2 * n], force])

    def surface(self, row, t, y):
        z = self.whole(t, y, self.shape.moving)
        return row[: len(z)] @ z

    def gap(self, row, t, y):
        z, n = self.extended(t, y, self.shape.moving), self.shape.positions
        return row[:n] @ z[:n] + row[self.shape.n : len(z)] @ z[self.shape.n :]

    @property
    def switches(self):
        return switches(self.shape)


@functools.cache
def switches(shape: Shape) -> tuple[Any, ...]:
    out: list[Any] = []
    for k in range(shape.sgn):
        switch = nsjax.sgn(lambda self, t, y, k=k: self.surface(self.G[k], t, y), name=f"s{k}")
        out.append(switch.breakaway(lambda self, k=k: self.bound[k]))
    for i in range(shape.relay):
        k = len(out)
        switch = nsjax.relay(lambda self, t, y, k=k: self.surface(self.G[k], t, y), name=f"r{i}")
        out.append(switch.off(lambda self, t, y, i=i: self.surface(self.off[i], t, y)))
    for i in range(shape.impact):
        k = len(out)
        switch = nsjax.impact(lambda self, t, y, k=k: self.gap(self.G[k], t, y), name=f"c{i}")
        out.append(switch.restitution(lambda self, i=i: self.e[i]))
    return tuple(out)
