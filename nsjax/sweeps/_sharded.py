"""Sweeps over a mesh of devices, as one program: for arguments that are spread over devices already, within `jax.jit`,
and for meshes of several processes."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._numerics._first_pass import whole_pass
from .._numerics._text import known
from ._chunks import in_chunks
from ._lanes import default_chunk, Lanes


Axes = tuple[str, ...]


def spread_over(mapped: Any) -> tuple[Any, Axes] | None:
    """The mesh, and those of its axes along which the first argument that is spread over several devices has its lanes;
    None if there is none. (Of a tracer it is known only where the mesh's axes are explicit.)"""
    for leaf in jax.tree.leaves(mapped):
        sharding = leaf.sharding if isinstance(leaf, jax.Array) and known(leaf) else jax.typeof(leaf).sharding
        if isinstance(sharding, NamedSharding) and len(sharding.spec) and sharding.mesh.size > 1:
            axes = sharding.spec[0]
            if isinstance(axes, str | tuple) and axes:
                return sharding.mesh, (axes,) if isinstance(axes, str) else axes
    return None


def sharded(fn: Callable[..., Any], lanes: Lanes, chunk: int | None, mesh: Any, axes: Axes) -> Any:
    """Each device has its share of the lanes, in chunks, and keeps it."""
    shares = math.prod(mesh.shape[name] for name in axes)
    share = -(-lanes.number // shares)
    if chunk is None:
        chunk = default_chunk(share, mesh.devices.flat[0].platform if isinstance(mesh, Mesh) else jax.default_backend())
    short, mapped, place = share * shares - lanes.number, lanes.mapped, jax.device_put
    if short:
        mapped = jax.tree.map(lambda x: jnp.concatenate([x, *[x[-1:]] * short]), mapped)
    if not known(mapped):
        # Where the arguments' types do not say how they are spread, that is left to the compiler: JAX's derivatives
        # outside of `jax.jit` know of no other way.
        explicit = spread_over(mapped) is not None
        mesh, place = mesh if explicit else _automatic(mesh), jax.reshard if explicit else lambda x, _: x
    mapped = place(mapped, NamedSharding(mesh, PartitionSpec(axes)))
    out = _run(fn, mapped, lanes.rest, chunk, mesh, axes)
    if not short:
        return out
    # An array that is not as long everywhere there cannot be: all of it goes to each device.
    return jax.tree.map(lambda x: x[: lanes.number], place(out, NamedSharding(mesh, PartitionSpec())))


def _automatic(mesh: Mesh) -> Mesh:
    return Mesh(mesh.devices, mesh.axis_names)


@eqx.filter_jit
def _run(fn: Callable[..., Any], mapped: Any, rest: Any, chunk: int, mesh: Any, axes: Axes) -> Any:
    shared, static = eqx.partition((fn, rest), eqx.is_array)

    def share(shared: Any, mapped: Any) -> Any:
        fn, rest = eqx.combine(shared, static)
        with whole_pass():
            return in_chunks(fn, mapped, rest, chunk)

    # (Loops of diffrax's step control mix what differs between devices with what does not, which the check refuses.)
    specs = PartitionSpec(), PartitionSpec(axes)
    return jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False)(shared, mapped)
