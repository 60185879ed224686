"""What tests of branches share: orbits to start from, special points by their place, stability by simulation, and
branches made by hand."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from models import pid

import nsjax
from nsjax import find_orbit, gallery, OrbitBranch
from nsjax.continuation import OrbitBifurcation


QUICK = dict(solver=dfx.Tsit5())  # of half the size of the default; the search and the continuation share its program


def orbit_of(system, y0, **options):
    return find_orbit(system, y0, **(QUICK | options))


def continue_orbit(*args, **options):
    return nsjax.continue_orbit(*args, **(QUICK | options))


def the(branch, value, tolerance=1e-8):
    """The special point there."""
    found = [b for b in branch.special_points if abs(b.value - value) < tolerance]
    assert found, f"none at {value} among {[b.value for b in branch.special_points]}"
    return found[0]


def same_multipliers(found, want, tolerance=1e-6):
    """Both sides, in either order, and pairs in either order."""

    def listed(side):
        return sorted(np.round(np.asarray(side, complex), 12), key=lambda z: (-abs(z), z.imag))

    def close(a, b):
        pairs = list(zip(listed(a), listed(b), strict=True))
        return all(abs(x - y) < tolerance if np.isfinite(y) else np.isinf(x) for x, y in pairs)

    first, second = want
    a, b = found
    assert (close(a, first) and close(b, second)) or (close(a, second) and close(b, first)), (found, want)


def stability_agrees(branch, number, seed, laps=40):
    """Orbits at random points of the branches, perturbed, return or leave."""
    generator = np.random.default_rng(seed)
    tried = 0
    for part in branch.branches:
        rho = np.abs(np.asarray(part.multipliers))
        if part.system.period is None:
            trivial = np.argmin(np.abs(rho - 1), axis=1)
            rho = np.where(np.arange(rho.shape[1]) == trivial[:, None], 0, rho)
        rho = rho.max(axis=1)
        for i in generator.permutation(len(part))[:number]:
            if 0.8 < rho[i] < 1.2:
                continue  # too slow to tell
            here = dataclasses.replace(part.system, **{part.parameter: float(part.values[i])})
            y0 = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), part.ys)
            t0, period = float(part.ts[i]), float(part.periods[i])
            moved = jax.tree.map(lambda leaf: leaf + 1e-7, y0)
            end = nsjax.solve(
                here, t0, t0 + laps * period, moved, solver=dfx.Tsit5(), stepsize_controller=pid(1e-11),
                max_steps=100_000, max_events=1000, throw=False,
            )  # fmt: skip
            away = max(abs(float(a) - float(b)) for a, b in zip(end.y1, y0))
            assert (away < 1e-6) == bool(part.stable[i]), (part.values[i], rho[i], away)
            tried += 1
    return tried


def special_at(kind, value, before, after=None, **changes):
    """A corner from one pair of multipliers to another, or a smooth point."""
    matrices = np.diag(before), np.diag(before if after is None else after)
    finite = np.all(np.isfinite(matrices))
    crossings = (
        nsjax.setvalued.eigenvalue_crossings(*matrices, multipliers=True) if after is not None and finite else []
    )
    sides = tuple(np.array(sorted(np.diag(m), key=lambda z: -abs(z)), complex) for m in matrices)
    fields = dict(
        kind=kind, discontinuous=after is not None, criticality=None, evidence="both", by_count=kind, by_crossing=None,
        transition=None, parameter="omega", value=value, period=6.0, t=0.0, y=gallery.Motion(1.0, 0.0),
        count=((1,), (1,)), surfaces=(), multipliers=sides, monodromies=matrices, crossings=crossings, halves=[],
    )  # fmt: skip
    return OrbitBifurcation(**fields | changes)


def branch_of(system, parameter, values, heights, multipliers, special=(), indices=(), others=()):
    values, heights = np.array(values, float), np.array(heights, float)
    multipliers = np.array(multipliers, complex)
    moduli = np.abs(multipliers)
    n = len(values)
    return OrbitBranch(
        system=system, parameter=parameter, values=values, periods=np.full(n, 6.0), orders=np.ones(n, int),
        ts=np.zeros(n), ys=gallery.Motion(0.5 * heights, np.zeros(n)), low=gallery.Motion(-heights, -2 * heights),
        high=gallery.Motion(0.5 * heights, heights), mean=gallery.Motion(np.zeros(n), np.zeros(n)),
        multipliers=multipliers, stable=np.all(moduli <= 1, axis=1), itineraries=("",) * n, special=tuple(special),
        indices=tuple(indices), ends=("", ""), others=tuple(others), admissible=np.ones(n, bool),
        segments=((),) * n, records={"top": heights, "rows": np.zeros((n, 2))},
    )  # fmt: skip


def same(found, want):
    """Number for number, and the same special points in both."""
    assert type(found) is type(want) and len(found.branches) == len(want.branches)
    named = {}
    for one, other in zip(found.branches, want.branches):
        fields = {field.name for field in dataclasses.fields(other)} - {"system", "special", "others"}
        assert jax.tree.structure(one.ys) == jax.tree.structure(other.ys)
        for name in fields:
            jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(other, name))
        assert len(one.special) == len(other.special)
        for a, b in zip(one.special, other.special):
            assert named.setdefault(id(b), a) is a
            assert str(a) == str(b)
    assert str(found) == str(want)
    assert eqx.tree_equal(found.system, want.system)
