"""Lyapunov exponents against closed forms and independent computations."""

import branch_reference
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exponents import ImpactOscillator, largest_exponent, mean_of_finite, StickSlip
from models import Beats, PeriodicHammer, pid
from tent import Corner

import nsjax
from nsjax import gallery
from nsjax.gallery import Motion
from nsjax.maps._lyapunov import standard_errors


class Tent(nsjax.System):
    """At each beat x is mapped onto a tent: its exponent is the logarithm of the slope, and that of the phase is 0."""

    rise: float = 1.9
    fall: float = 1.9

    def vector_field(self, t, y, s):
        return Beats(jnp.zeros_like(y.x), jnp.ones_like(y.phase))

    @nsjax.impact
    def beat(self, t, y):
        return 1 - y.phase

    @beat.reset
    def beat(self, t, y):
        return Beats(jnp.minimum(self.rise * y.x, self.fall * (1 - y.x)), y.phase - 1)


class Damped(nsjax.System):
    """Three exponents: -ζω twice, and that of a variable of its own; the switch is crossed without effect on them."""

    c: float = 0.2
    decay: float = 1.0
    omega: float = 2.0

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def vector_field(self, t, y, s):
        x, v, z = y
        return jnp.stack([v, -x - self.c * v + jnp.cos(self.omega * t), -self.decay * z + s.side])

    @nsjax.sgn
    def side(self, t, y):
        return y[0]


QUICK = dict(solver=diffrax.Tsit5())  # of half the size of the default

STOPPED = PeriodicHammer(x_w=0.0, f_0=-1.0, omega=2.825)  # chaotic; the mirror image of `ImpactOscillator`


class Driven(nsjax.System):
    """A forced block on a belt, held by a spring, whose friction is three times as strong at rest; chaotic."""

    omega: float = 2.1
    a: float = 1.7
    belt_velocity: float = 0.6
    stick: float = 3.0

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.belt + self.a * jnp.cos(self.omega * t))

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.belt_velocity

    @belt.breakaway
    def belt(self):
        return self.stick


@pytest.mark.slow
def test_the_tent_map():
    """To rounding; as lanes; and the determinants of its resets have the same sum."""

    def spectrum(slope):
        start = Beats(0.3712, 0.25)
        kwargs = dict(transient=100, span=20, interval=1.0, divergence=True, max_events=4)  # 1.5**-100 is nothing
        kwargs |= dict(solver=diffrax.Heun())  # exact here
        return nsjax.lyapunov_spectrum(Tent(slope, slope), start, **kwargs)

    slopes = np.array([1.5, 1.7, 1.9])
    found = jax.jit(jax.vmap(spectrum))(jnp.asarray(slopes))
    np.testing.assert_allclose(found.exponents[:, 0], np.log(slopes), atol=1e-12)
    np.testing.assert_allclose(found.exponents[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(found.residual, 0, atol=1e-12)
    np.testing.assert_allclose(found.history[:, -1], found.exponents, atol=1e-14)
    np.testing.assert_allclose(found.dimension, 2)
    assert "3 spectra of 2" in str(found)


@pytest.mark.slow
def test_a_skew_tent():
    """Onto the whole interval: the measure is uniform, and the exponent H = -p ln p - (1 - p) ln(1 - p). After n beats the
    pieces are multiples of 4^-n, for p = 1/4: one start in the middle of each gives the mean without an error."""
    p, beats = 0.25, 4

    def growth(x):
        kwargs = dict(transient=0, span=beats, interval=1.0, max_events=4)
        return jnp.sum(nsjax.lyapunov_spectrum(Tent(1 / p, 1 / (1 - p)), Beats(x, 0.25), **kwargs).exponents)

    found = nsjax.sweep(growth, (jnp.arange(4.0**beats) + 0.5) / 4**beats)  # the other exponent is 0
    assert float(jnp.mean(found)) == pytest.approx(-p * np.log(p) - (1 - p) * np.log(1 - p), abs=1e-12)
    assert float(jnp.std(found)) > 0.1


@pytest.mark.slow
def test_decay_of_a_linear_system():
    """A field that jumps by what the other variables do not feel: the exponents are those of the linear parts."""
    exact = diffrax.PIDController(rtol=1e-12, atol=1e-12)
    kwargs = dict(transient=120, span=64, divergence=True, max_events=8, stepsize_controller=exact, **QUICK)
    found = nsjax.lyapunov_spectrum(Damped(), jnp.array([1.0, 0.0, 0.5]), **kwargs)
    # The two of the oscillator turn into each other: each goes as 1 / span, their sum is exact.
    assert float(jnp.sum(found.exponents[:2])) == pytest.approx(-0.2, abs=1e-10)
    np.testing.assert_allclose(found.exponents[:2], -0.1, atol=2e-2)
    assert float(found.exponents[2]) == pytest.approx(-1, abs=1e-10)
    assert abs(float(found.residual)) < 1e-9 and float(found.divergence) == pytest.approx(-1.2, abs=1e-9)
    assert found.dimension == 0


def test_sticking_forgets():
    """One exponent of the stick-slip orbit of section 3.4 is 0, the other minus infinity, from any phase on."""
    period = 10 + np.pi + 2 * np.arctan(0.2)
    entry = nsjax.gallery.entry("3.4")
    kwargs = dict(transient=2, span=8, interval=period / 4, **QUICK)
    found = nsjax.lyapunov_spectrum(nsjax.gallery.thesis("3.4"), entry.y0, **kwargs)
    assert abs(float(found.exponents[0])) < 1e-8 and float(found.exponents[1]) == -np.inf
    assert np.isnan(found.errors[1]) and np.isfinite(found.errors[0]) and found.residual is None
    assert "-inf" in str(found).splitlines()[2]


def test_standard_errors():
    """Of an orbit of order four the rates cancel; of rates that follow one another the error is the long-range one."""
    orbit = np.tile([1.0, -2.0, 3.0, -2.5], 128)[:, None]
    assert jax.jit(standard_errors)(orbit)[0] < 1e-12
    noise = np.random.default_rng(1).normal(size=(200, 4096))
    rates = np.zeros_like(noise)
    for n in range(1, noise.shape[1]):
        rates[:, n] = 0.8 * rates[:, n - 1] + noise[:, n]
    found = jax.jit(standard_errors)(rates.T)
    exact = 1 / (1 - 0.8) / np.sqrt(noise.shape[1])  # of the mean of an autoregression
    assert np.std(np.mean(rates, axis=1)) == pytest.approx(exact, rel=0.15)
    assert 0.9 < np.mean(found) / exact < 1.5 and np.min(found) > 0.5 * exact


def test_mistakes():
    forced, free, y0 = STOPPED, nsjax.gallery.thesis("3.4"), Motion(0.1, 0.0)
    counts = dict(transient=0, span=2)
    for system, options, words in (
        (free, counts, "autonomous: argument `interval` must say"),
        (forced, counts | dict(interval=1.0), "leave out `interval=`"),
        (forced, counts | dict(exponents=3), "at most 2"),
        (forced, counts | dict(exponents=1, divergence=True), "all exponents"),
        (forced, counts | dict(span=0), "`span` must be a positive integer"),
        (forced, counts | dict(transient=-1), "`transient` must be"),
    ):
        with pytest.raises(ValueError, match=words):
            nsjax.lyapunov_spectrum(system, y0, **options)


def test_dimension():
    """Kaplan & Yorke."""

    def dimension(*rates, errors=0.0):
        rates = jnp.array(rates)
        one = jnp.ones(())
        return nsjax.maps.LyapunovSpectrum(
            rates, jnp.full(len(rates), errors), rates[None], one, None, rates, nsjax.RESULTS.successful
        ).dimension

    assert dimension(0.5, 0.0, -2.0) == pytest.approx(2.25)
    assert dimension(0.5, 1e-6, -np.inf, errors=1e-5) == 2
    assert dimension(-0.1, -0.2) == 0 and dimension(1.0, 0.5) == 2
    assert np.isnan(dimension(np.nan, 0.0))


def largest(system, starts, transient, span):
    """Of many solutions: the mean, and its standard error."""

    def lane(y0):
        kwargs = dict(transient=transient, span=span, exponents=1, throw=False)
        return nsjax.lyapunov_spectrum(system, y0, **kwargs).exponents[0]

    found = np.asarray(nsjax.sweep(lane, starts))
    assert np.isfinite(found).mean() > 0.98 and not np.isnan(found).any()
    return mean_of_finite(found)


@pytest.mark.slow
def test_chaos_in_stick_slip():
    """Against solutions in closed form between events: the same to three standard errors, which are below 2e-4."""
    x, v = np.random.default_rng(1).uniform([[-1], [-1]], [[1], [0.5]], (2, 128))
    mine, error = largest(Driven(), Motion(jnp.asarray(x), jnp.asarray(v)), 100, 250)
    theirs, other = largest_exponent(StickSlip(1.7, 2.1, 0.6, 3.0), 128, 100, 250, steps=64)
    assert max(error, other) < 2e-4 and mine > 0.05
    assert abs(mine - theirs) < 3 * np.hypot(error, other)


@pytest.mark.slow
def test_chaos_in_impacts():
    """The same of the impact oscillator, whose rates scatter ten times as much. (A few solutions come to rest on the wall
    some time, which forgets everything: minus infinity; they are left out on both sides.)"""
    x, v = np.random.default_rng(1).uniform([[-0.6], [0.0]], [[-0.4], [0.2]], (2, 2048))
    mine, error = largest(STOPPED, Motion(jnp.asarray(-x), jnp.asarray(-v)), 100, 1700)
    theirs, other = largest_exponent(ImpactOscillator(1.0, 2.825, 0.02, 0.8), 2048, 100, 1700, steps=24)
    assert max(error, other) < 2e-4 and mine > 0.1
    assert abs(mine - theirs) < 3 * np.hypot(error, other)


@pytest.mark.slow
def test_the_sum_of_exponents_in_chaos():
    """Müller (1995): the determinant of an impact is e²."""
    exact = diffrax.PIDController(rtol=1e-11, atol=1e-11)
    kwargs = dict(transient=20, span=200, divergence=True, stepsize_controller=exact)
    found = nsjax.lyapunov_spectrum(STOPPED, Motion(0.5, -0.1), **kwargs)
    assert abs(float(found.residual)) < 1e-7
    impacts = (float(found.divergence) + STOPPED.c) * 200 * float(found.interval) / np.log(0.8**2)
    assert impacts == pytest.approx(round(impacts), abs=1e-6) and impacts > 100


def beside_b():
    """The closed form, and the point."""
    point = branch_reference.POINTS["6.9 B"]
    return Corner(point.multipliers["stick"][0], point.multipliers["no stick"]).pieces(), point


def test_closed_form_beside_b():
    """Against the map itself, which knows nothing of pieces; and the sums have converged."""
    pieces, point = beside_b()
    corner = Corner(point.multipliers["stick"][0], point.multipliers["no stick"])
    stuck = corner.iterated(np.linspace(0.25, 0.3, 2000), np.zeros(2000), 1100)[100:]
    laps = [np.diff(np.flatnonzero(lane)) for lane in stuck.T]
    means = np.array([[np.log(pieces.growths[k // 2 - 1]).sum(), k.sum()] for k in laps])
    exponent = means[:, 0].sum() / means[:, 1].sum()
    error = np.std(means[:, 0] - exponent * means[:, 1]) / means[:, 1].mean() / 2000**0.5
    assert error < 2e-4 and abs(exponent - pieces.exponent) < 3 * error
    assert list(pieces.laps) == [2, 4, 6, 8, 10, 12] and pieces.exponent == pytest.approx(0.33087804815, abs=1e-11)
    assert corner.pieces(20).exponent == pytest.approx(pieces.exponent, abs=1e-13)


@pytest.mark.slow
def test_the_tent_at_b():
    """Section 6.9, ω -> ω_B from above: what the spectrum of the system itself finds to grow from one stick to the next
    tends to the slopes of the map at B, like √(ω - ω_B), and the exponent to the closed form to 1e-6 [1/s]."""
    pieces, point = beside_b()
    logs, order, lanes, span = dict(zip(pieces.laps, np.log(pieces.growths))), point.order, 64, 400

    def rates(omega, x):
        system, y0 = gallery.ForcedStickSlip(omega=omega), Motion(x, jnp.asarray(point.y0[1]))
        # By steps of 1e-13 one stretch between sticks in a thousand is not one that the map has at 1e-10 from B.
        options = dict(transient=20, span=span, max_events=8, stepsize_controller=pid(1e-14))
        return nsjax.lyapunov_spectrum(system, y0, **options, throw=False).rates

    rates, exponents = jax.jit(jax.vmap(rates, (None, 0))), []
    for distance in (1e-6, 1e-8, 1e-10):
        omega = point.at + distance
        found = rates(omega, point.y0[0] + distance * jnp.linspace(-2, 2, lanes)) * (2 * np.pi / omega)
        found = np.asarray(found).reshape(lanes, span // order, order, 2)
        assert not np.isnan(found).any() and np.isfinite(found[..., 0]).all()
        grown = found[..., 0].sum(axis=2)
        stuck = np.isinf(found[..., 1]).any(axis=2)  # sticking forgets: the other exponent says when
        ends = [np.flatnonzero(lane) for lane in stuck]
        laps = np.concatenate([np.diff(end) for end in ends])
        growth = np.concatenate([np.diff(np.cumsum(lane)[end]) for lane, end in zip(grown, ends)])
        # Others are possible a little away from B, and next to it by rounding.
        usual = np.isin(laps, pieces.laps)
        assert usual.mean() > 0.999
        laps, growth = laps[usual], growth[usual]
        off = growth - np.array([logs[k] for k in laps])
        assert np.abs(off).max() < 1.2 * distance**0.5
        # With the shares of the invariant measure: an average of the solutions themselves would need 1e11 periods.
        means = np.array([growth[laps == k].mean() for k in pieces.laps])
        exponents.append(pieces.shares @ means / (pieces.shares @ pieces.laps))
        # That the solutions have these shares, to three standard errors.
        shares = np.array([np.mean(laps == k) for k in pieces.laps])
        errors = np.sqrt(pieces.shares * (1 - pieces.shares) / len(laps))
        assert errors.max() < 0.01 and (np.abs(shares - pieces.shares) < 3 * errors).all()
        each = grown.mean(axis=1)
        assert abs(each.mean() - pieces.exponent) < 3 * each.std(ddof=1) / lanes**0.5 < 0.01
    far, near, next_to = np.array(exponents) - pieces.exponent
    assert far / near == pytest.approx(10, rel=0.1) and near / next_to == pytest.approx(10, rel=0.1)
    assert abs(next_to) / point.period < 1e-6
    assert abs(10 * next_to - near) / 9 < 3e-7
