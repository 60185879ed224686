"""A thousand random guesses on each system: nothing that is called an orbit is none, and no number is missing."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
from models import pid, Stop

from nsjax import find_orbit, gallery, is_okay, solve, sweep


pytestmark = pytest.mark.slow

NUMBER = 1000
METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-11), max_steps=2000, max_events=16)


def ravel(ys):
    return jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(ys)


def search(system, like, low, high, period=None, **options):
    """Orbits from guesses in a box, the period's included."""
    rng = np.random.default_rng(5)
    _, unravel = jfu.ravel_pytree(like)
    starts = jax.vmap(unravel)(jnp.asarray(rng.uniform(low, high, (NUMBER, 2))))
    periods = None if period is None else jnp.asarray(period * rng.uniform(0.6, 1.6, NUMBER))

    def one(guess):
        y0, period = guess
        orbit = find_orbit(system, y0, period=period, throw=False, **METHOD, **options)
        return eqx.filter(orbit, eqx.is_array)

    return jax.tree.map(np.asarray, sweep(one, (starts, periods)))


def check(system, orbits, sign=1.0):
    """Every orbit returns, by another solver, and no sooner than it says."""
    good = np.flatnonzero(np.asarray(is_okay(orbits.result)))
    y0, period, multipliers = jax.tree.map(
        lambda x: jnp.asarray(x[good]), (orbits.y0, orbits.period, orbits.multipliers)
    )
    for number in (ravel(y0), period, orbits.residual[good], np.abs(multipliers)):
        assert not np.any(np.isnan(number))
    mode = jnp.asarray(orbits.mode[good])
    shares = np.array([1 / 7, 1 / 5, 1 / 3, 0.4, 0.5, 0.6, 2 / 3, 0.8, 1.0])

    @jax.jit
    @jax.vmap
    def follow(y0, period, mode):
        sol = solve(
            system, 0.0, sign * period, y0, mode=tuple(mode), solver=dfx.Dopri8(), stepsize_controller=pid(1e-12),
            saveat=dfx.SaveAt(ts=sign * period * shares), max_events=32, throw=False,
        )  # fmt: skip
        return sol.ys, sol.result

    ys, result = follow(y0, period, mode)
    points = np.stack([np.asarray(x) for x in jax.tree.leaves(ys)], axis=-1)
    start = np.asarray(ravel(y0))
    size = 1 + np.abs(points).max(axis=(1, 2))
    finite = np.where(np.isfinite(multipliers), np.abs(multipliers), 1).max(axis=1)
    assert np.all(np.asarray(is_okay(result)))
    assert np.all(np.abs(points[:, -1] - start).max(axis=1) <= 1e-7 * size * (1 + finite))
    sooner = np.abs(points[:, :-1] - start[:, None]).max(axis=2)
    away = sooner.max(axis=1)
    assert np.all(away > 1e-8 * size)
    divides = np.isin(shares[:-1], [1 / 7, 1 / 5, 1 / 3, 0.5])
    assert np.all(sooner[:, divides].min(axis=1) > 1e-7 * away)
    return good


def different(orbits, good):
    """How many orbits there are, by period and multipliers."""
    rows = np.column_stack([orbits.period[good], np.abs(orbits.multipliers[good]), orbits.events.num[good]])
    kinds = []
    for row in np.where(np.isfinite(rows), rows, 1e9):
        if not any(np.allclose(row, k, rtol=1e-5, atol=1e-6) for k in kinds):
            kinds.append(row)
    return kinds


AUTONOMOUS = {  # a box of starts, a period, and whether it runs backwards; each has one orbit
    "2.4": ([-1.5, -1.5], [1.5, 1.0], 12.0, False),
    "3.4": ([-2.5, -2.0], [2.5, 1.0], 13.5, False),
    "5.7": ([-2.0, -2.5], [2.0, 2.5], 4.0, False),
    "6.7": ([-2.5, -2.0], [2.5, 1.0], 12.6, False),
    "6.7 backwards": ([0.0, -0.5], [2.0, 0.2], 6.4, True),
}
FORCED = {  # parameters, order, and how many orbits of it are known: see `orbit_reference`
    "3.5": (gallery.DiscontinuousSupport, {}, 1, 1),
    "6.6": (gallery.Trilinear, {}, 1, 3),
    "6.8": (gallery.ForcedFriction, {}, 1, 2),  # apart from the mirrored one, whose multipliers are the same
    "6.9": (gallery.ForcedStickSlip, dict(omega=1.68), 2, 4),
    "stop": (Stop, dict(omega=3.0), 2, 2),
}


@pytest.mark.parametrize("key", AUTONOMOUS)
def test_autonomous(key):
    low, high, period, backward = AUTONOMOUS[key]
    entry = gallery.entry(key.split()[0])
    like = jax.tree.map(float, entry.y0)
    orbits = search(entry.system(), like, low, high, period, backward=backward)
    good = check(entry.system(), orbits, -1.0 if backward else 1.0)
    assert len(good) > NUMBER / 3 and len(different(orbits, good)) == 1


@pytest.mark.parametrize("key", FORCED)
def test_forced(key):
    system, parameters, order, known = FORCED[key]
    system = system(**parameters)
    orbits = search(system, gallery.Motion(0.0, 0.0), [-3.0, -3.0], [3.0 if key != "stop" else 0.2, 3.0], order=order)
    good = check(system, orbits)
    assert len(good) > NUMBER / 3 and len(different(orbits, good)) == known
