"""Charts of attractors: every label against what is known, or against an independent simulation."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exponents import after, ImpactOscillator, largest_exponent
from models import Beats, CHEAP, Logistic, PeriodicHammer

import nsjax
from nsjax.gallery import Motion
from nsjax.maps._itinerary_class import ItineraryClasses
from nsjax.maps._settled import settled


START = Beats(0.3712, 0.25)
BEATS = dict(section="beat", max_time=3.0, max_iterates=512, **CHEAP)
OVER = {
    "a": np.array([2.8, 3.2, 3.5, 3.55, 3.566, 3.5691, 3.7, 3.832, 3.845, 3.9, 4.0]),
    "middle": np.array([0.6, 0.52]),
}


@pytest.fixture(scope="module")
def logistic():
    return nsjax.attractor_chart(Logistic(), OVER, START, **BEATS)


def logistic_map(a, transient=20_000, span=50_000):
    """The period (0: none up to 16), a period of points, and the exponent."""
    x, logs = 0.3712, []
    for _ in range(transient):
        x = a * x * (1 - x)
    points = []
    for _ in range(span):
        logs.append(np.log(abs(a * (1 - 2 * x))))
        x = a * x * (1 - x)
        points.append(x)
    points = np.array(points)
    period = next((k for k in range(1, 17) if np.abs(points[k:] - points[:-k]).max() < 1e-9), 0)
    return period, points[-period:] if period else points, np.mean(logs)


def test_every_label_of_the_logistic_map(logistic):
    """Period-doubling, the window of period three, chaos: each point against a long iteration, and with λ₁ = log 2 where
    a = 4. Its itinerary is the sequence of sides."""
    known = [logistic_map(a) for a in OVER["a"]]
    assert [period for period, *_ in known] == [1, 2, 4, 8, 16, 0, 0, 3, 6, 0, 0] and (logistic.result == 0).all()
    # (That of 32 at a = 3.5691 is longer than what is looked for, and not chaotic.)
    np.testing.assert_array_equal(logistic.periods, np.array([[p, p] for p, *_ in known]))
    chaos = np.array([3.7, 3.9, 4.0])
    np.testing.assert_array_equal(logistic.chaotic, np.isin(OVER["a"], chaos)[:, None] * [True, True])
    np.testing.assert_array_equal(logistic.undecided, (OVER["a"] == 3.5691)[:, None] * [True, True])
    for i, (period, points, rate) in enumerate(known):
        for j, middle in enumerate(OVER["middle"]):
            if period:
                assert logistic.exponents[i, j] == pytest.approx(rate, abs=2e-3)
                change = (points > middle) != (np.roll(points, 1) > middle)
                words = np.where(change, np.where(points > middle, "beat,side+", "beat,side-"), "beat")
                word = logistic.itineraries[logistic.classes[i, j]]
                mine = _expanded(word)
                assert any(mine == list(np.roll(words, k)) for k in range(period))
            elif logistic.chaotic[i, j]:
                assert abs(logistic.exponents[i, j] - rate) < 5 * logistic.errors[i, j] < 0.2
                assert logistic.classes[i, j] == -1
    assert logistic.exponents[-1, 0] == pytest.approx(np.log(2), abs=5 * logistic.errors[-1, 0])


def _expanded(words):
    """`(beat,side+ beat)×2 beat×2` as the words it stands for."""
    words = re.sub(r"\(([^)]*)\)×(\d+)", lambda m: " ".join([m[1]] * int(m[2])), words)
    return re.sub(r"(\S+)×(\d+)", lambda m: " ".join([m[1]] * int(m[2])), words).split()


def test_lanes_do_not_wait(logistic):
    """What has settled is not followed on; what has not is, to the end."""
    assert (logistic.iterates[:2] == 64).all() and (logistic.iterates[logistic.chaotic] == 512).all()
    assert np.isfinite(logistic.errors[logistic.chaotic]).all() and np.isnan(logistic.errors[0]).all()
    text = str(logistic)
    assert text.startswith("attractor chart over a = 2.8 to 4, middle = 0.52 to 0.6: 11 x 2 solutions")
    assert "6 chaos" in text and "2 undecided" in text


def test_it_goes_on_where_it_was(logistic, tmp_path, monkeypatch):
    """A folder of a shorter chart is gone on with; what is there is not computed again; another chart is refused."""
    short = nsjax.attractor_chart(Logistic(), OVER, START, path=tmp_path, **BEATS | dict(max_iterates=128))
    assert (short.iterates <= 128).all() and short.undecided.any() and len(list(tmp_path.iterdir())) == 2
    nsjax.attractor_chart(Logistic(), OVER, START, path=tmp_path, **BEATS)
    monkeypatch.setattr("nsjax.sweeps._piece.Piece.run", lambda *_: pytest.fail("computed once more"))
    again = nsjax.attractor_chart(Logistic(), OVER, START, path=tmp_path, **BEATS)
    for a, b in zip(jax.tree.leaves(logistic), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="holds another sweep"):
        nsjax.attractor_chart(Logistic(), {**OVER, "a": OVER["a"] + 0.1}, START, path=tmp_path, **BEATS)


def test_failures_say_so():
    """Where the next beat is later than `max_time`, nothing returns. (One program with the chart above.)"""
    found = nsjax.attractor_chart(Logistic(pause=5.0), OVER, START, **BEATS)
    assert found.failed.all() and (found.periods == -1).all() and not found.chaotic.any()
    assert (found.kinds() == "no_return").all() and np.isnan(found.ys.x).all() and "22 no_return" in str(found)


@pytest.mark.slow
def test_failures_harm_no_other_lane(logistic):
    over = {"a": OVER["a"], "pause": np.array([1.0, 5.0])}
    found = nsjax.attractor_chart(Logistic(), over, START, **BEATS)
    np.testing.assert_array_equal(found.periods[:, 0], logistic.periods[:, 0])
    assert found.failed[:, 1].all() and (found.periods[:, 1] == -1).all() and not found.chaotic[:, 1].any()
    assert (found.kinds()[:, 1] == "no_return").all() and np.isnan(found.ys.x[:, 1]).all()
    assert found.kinds()[2, 0] == "period 4" and "11 no_return" in str(found)


def test_what_has_settled():
    """Sequences in closed form; NumPy's and JAX's arrays alike."""
    n, wave = np.arange(64), np.array([0.3, -0.7, 0.2, 0.9])
    noise = np.random.default_rng(0).uniform(-1, 1, 64)
    cases = {
        "at rest": (np.full(64, 0.3), 1),
        "by a factor": (0.3 + 0.6**n, 1),
        "to and fro": (0.3 + (-0.6) ** n, 1),
        "that has far to go": (0.3 + 1e-5 * 0.999**n, 0),
        "away": (0.3 + 1e-9 * 1.01**n, 0),
        "algebraically": (0.3 + 1e-3 / (1 + n), 0),
        "two": (0.3 + 0.1 * (-1.0) ** n + 0.6**n, 2),
        "two that are one within the tolerance": (0.3 + 3e-6 * (-1.0) ** n, 1),
        "four": (wave[n % 4], 4),
        "sixteen": (noise[n % 16], 16),
        "seventeen": (noise[n % 17], 0),
        "noise": (noise, 0),
        "noise below the tolerance": (0.3 + 1e-6 * noise, 0),
        "not all components": (None, 3),
    }
    for name, (x, want) in cases.items():
        x = np.stack([wave[n % 1], wave[n % 3]], axis=-1) if x is None else x[:, None]
        assert settled(x, 1e-5) == want, name
    many = np.stack([x for x, _ in cases.values() if x is not None])[..., None]
    want = [want for x, want in cases.values() if x is not None]
    np.testing.assert_array_equal(settled(many, 1e-5), want)
    np.testing.assert_array_equal(jax.jit(settled, static_argnums=1)(jnp.asarray(many), 1e-5), want)


def test_classes_of_itineraries():
    """The same whichever event comes first; contacts, and what nothing happens in."""
    classes = ItineraryClasses(Logistic())
    rows = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1]], np.int8)
    both = np.stack([rows, np.roll(rows, 1, axis=0), rows[[1, 1, 1]], [[-1, 0, 1]] * 3, rows]).astype(np.int8)
    found = classes.of(both, np.array([3, 3, 1, 0, 4]))
    words = [classes.words[k] for k in found[1:4]]
    assert found[0] == found[1] and found[4] == -1 and len(classes.words) == 3
    assert words[1:] == ["beat", "no event: side+"]
    assert sorted(words[0].split()) == ["beat", "beat,side+", "beat,side-"]


def test_impacts_that_lead_to_rest():
    """Infinitely many, whatever number of them was made; others before them are no part of it."""
    classes = ItineraryClasses(PeriodicHammer())
    wall, rests, leaves = [0, 0], [0, 1], [0, 0]
    ways = [[wall] * n + [rests, leaves] for n in (3, 30)] + [[rests, leaves], [wall] * 3]
    rows = np.zeros((4, 32, 2), np.int8)
    for row, way in zip(rows, ways):
        row[: len(way)] = way
    found = classes.of(rows, np.array([len(way) for way in ways]))
    assert found[0] == found[1]
    words = [classes.words[k] for k in found]
    assert _cyclic("wall×∞ wall:rests wall:leaves", words[0]) and _cyclic("wall:rests wall:leaves", words[2])
    assert words[3] == "wall×3"


def _cyclic(wanted, words):
    wanted, words = wanted.split(), words.split()
    return any(words == wanted[k:] + wanted[:k] for k in range(len(wanted)))


def test_mistakes():
    for parameters, options, words in (
        ({"a": [1.0]}, {}, "dictionary of two names and their values"),
        (["a", "middle"], {}, "dictionary of two names"),
        ({"a": [1.0], "b": [1.0]}, {}, "must be one of a, middle, pause"),
        ({"a": [1.0], "middle": 0.5}, {}, "the shape of `middle` is"),
        ({"a": [1.0], "middle": [0.5]}, dict(section=None), "autonomous: give a `section`"),
        ({"a": [1.0], "middle": [0.5]}, dict(max_period=0), "`max_period` must be"),
        ({"a": [1.0], "middle": [0.5]}, dict(chunk=0), "`chunk` must be"),
        ({"a": [1.0], "middle": [0.5]}, dict(devices=2), "`devices` must be a number from 1 to 1, but is 2"),
    ):
        with pytest.raises((ValueError, TypeError), match=words):
            nsjax.attractor_chart(Logistic(), parameters, START, **BEATS | options)


@pytest.mark.slow
def test_a_linear_oscillator():
    """It has period one everywhere, -c / 2 as its exponent, and no event."""
    over = {"c": np.array([0.2, 0.4, 0.8]), "omega": np.array([0.7, 1.3])}
    found = nsjax.attractor_chart(PeriodicHammer(x_w=-1e3), over, Motion(0.5, 0.0))
    assert (found.periods == 1).all() and (found.classes == 0).all() and found.itineraries == ("no event",)
    np.testing.assert_allclose(found.exponents, np.repeat(-over["c"][:, None] / 2, 2, axis=1), rtol=0.06)
    amplitude = 1 / (1 - over["omega"] ** 2 + 1j * over["c"][:, None] * over["omega"])
    np.testing.assert_allclose(found.ys.x, amplitude.real, atol=1e-5)


@pytest.mark.slow
def test_an_autonomous_oscillator():
    """At the events of a switch: the orbit of section 3.4 sticks, which forgets everything."""
    over = {"v_dr": np.array([0.2, 0.5]), "F_stick": np.array([1.5, 2.0])}
    section = dict(section="belt", direction=0, max_time=100.0, max_iterates=64)
    found = nsjax.attractor_chart(nsjax.gallery.StickSlip(), over, Motion(2.5, -0.5), **section)
    assert (found.periods == 2).all() and set(found.itineraries) == {"belt0 belt-"}
    assert (found.exponents == -np.inf).all() and not found.chaotic.any()


@pytest.mark.slow
def test_every_label_of_an_impact_oscillator():
    """Against solutions in closed form between impacts, which are followed for 600 periods: the same period, as many
    impacts of it, or the same exponent. (Those that come to rest are not followed by it.)"""
    over = {"omega": np.array([2.5, 2.6, 2.7, 2.85]), "e": np.array([0.65, 0.8])}
    found = nsjax.attractor_chart(PeriodicHammer(c=0.1, x_w=0.0, f_0=-1.0), over, Motion(0.5, 0.0))
    assert not found.failed.any() and found.chaotic.any() and len(np.unique(found.periods)) > 2
    for i, omega in enumerate(over["omega"]):
        for j, e in enumerate(over["e"]):
            known = ImpactOscillator(1.0, omega, 0.1, e)
            x, v = after(known, [-0.5], [0.0], 600, steps=24)
            points = []
            for _ in range(32):
                points.append([x[0], v[0]])
                x, v = after(known, x, v, 1, steps=24)
            points = np.array(points)
            if not np.isfinite(points).all():
                words = found.itineraries[found.classes[i, j]].split()
                assert {"wall:rests", "wall:leaves"} < set(words) and found.exponents[i, j] == -np.inf
                continue
            gaps = [np.abs(points[k:] - points[:-k]).max() for k in range(1, 17)]
            period = next((k for k, gap in enumerate(gaps, 1) if gap < 1e-5), 0)
            assert found.periods[i, j] == period
            if period:
                here = -np.array([found.ys.x[i, j], found.ys.v[i, j]])
                assert np.abs(points[:period] - here).max(axis=1).min() < 1e-5
                words = found.itineraries[found.classes[i, j]]
                assert len(_expanded(words)) == _impacts(known, points[0], period)
            elif found.chaotic[i, j]:
                with np.errstate(all="ignore"):  # some solutions come to rest, and count for nothing
                    rate, error = largest_exponent(known, 32, 200, 400, steps=24)
                assert abs(found.exponents[i, j] - rate) < 4 * np.hypot(found.errors[i, j], error)


def _impacts(known, point, periods):
    """How often the solution from a point meets the wall."""
    met = []

    class Counted(ImpactOscillator):
        def jump(self, *args):
            met.extend(args[0])
            return super().jump(*args)

    after(Counted(known.a, known.omega, known.c, known.e), point[:1], point[1:], periods, steps=24)
    return len(met)
