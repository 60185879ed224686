"""The cycles at a corner of a branch of periodic orbits, against exact arithmetic, simulation and known results."""

import itertools
from fractions import Fraction

import mpmath as mp
import numpy as np
import pytest

from nsjax.maps._corner_normal_form import corner_kind, CornerMap, find_cycles


MOEBIUS = {1: 1, 2: -1, 3: -1, 4: 0, 5: -1, 6: 1, 7: -1, 8: 0}
PRIMITIVE = {k: sum(MOEBIUS[k // d] * 2**d for d in range(1, k + 1) if k % d == 0) // k for k in range(1, 9)}


def tent(right, left, border=1.0):
    """x -> slope x + ν, with one slope for x >= 0 and one for x < 0."""
    return CornerMap(*map(np.array, ([[[right]]], [[1.0]], [[(left - right) / border]], [[border]], [0.0], [False])))


def random_map(rng, places, size, square=None, spread=1.0):
    shapes = [(places, size, size), (places, size), (places, size), (places, size), (places,)]
    a, b, e, n, c = (spread * rng.standard_normal(shape) for shape in shapes)
    return CornerMap(a, b, e, n, c, np.zeros(places, bool) if square is None else np.array(square))


def step(f, p, x, nu):
    """The exact map, from the definition."""
    g = f.n[p] @ x + f.c[p] * nu
    y = f.a[p] @ x + f.b[p] * nu
    if g < 0:
        y = y + f.e[p] * (np.sqrt(-g) if f.square[p] else g)
    return y


def lap(f, x, nu, laps=1):
    for _ in range(laps):
        for p in range(len(f.c)):
            x = step(f, p, x, nu)
    return x


def rotations(word, places):
    return [word[i:] + word[:i] for i in range(0, len(word), places)]


def by_composition(f, laps):
    """{(side, word): x} of the cycles of so many laps, from the affine maps composed, for every word there is."""
    places, size = f.b.shape
    found = {}
    for word in itertools.product((0, 1), repeat=places * laps):
        if word != min(rotations(word, places)) or len(set(rotations(word, places))) < laps:
            continue
        for nu in (-1, 1):
            m, v = np.eye(size), np.zeros(size)
            for i, event in enumerate(word):
                p = i % places
                a = f.a[p] + event * np.outer(f.e[p], f.n[p])
                m, v = a @ m, a @ v + nu * (f.b[p] + event * f.c[p] * f.e[p])
            x = start = np.linalg.solve(np.eye(size) - m, v)
            right = True
            for i, event in enumerate(word):
                p = i % places
                right &= (f.n[p] @ x + f.c[p] * nu < 0) == bool(event)
                x = step(f, p, x, nu)
            if right:
                found[nu, word] = start
    return found


def periodic_points(right, left, nu, laps):
    """How many fixed points the tent map's iterate has, by its pieces in rational numbers; None if that is unclear."""
    pieces = [(None, None, Fraction(1), Fraction(0))]  # from, to, slope, offset
    for _ in range(laps):
        new = []
        for lo, hi, slope, offset in pieces:
            cut = -offset / slope
            inside = (lo is None or lo < cut) and (hi is None or cut < hi)
            for start, end in [(lo, cut), (cut, hi)] if inside else [(lo, hi)]:
                middle = start + 1 if end is None else end - 1 if start is None else (start + end) / 2
                s = right if slope * middle + offset >= 0 else left
                new.append((start, end, s * slope, s * offset + nu))
        pieces = new
    count = 0
    for lo, hi, slope, offset in pieces:
        if slope == 1:
            return None
        x = offset / (1 - slope)
        if x in (lo, hi):
            return None
        count += (lo is None or lo < x) and (hi is None or x < hi)
    return count


def test_horseshoe():
    """Slopes 5 and -4: every word has its cycle."""
    result = find_cycles(tent(-4.0, 5.0), 8)
    assert result.words == len(result.cycles) == sum(PRIMITIVE.values()) and result.most == 8
    assert result.doubtful == result.singular == ()
    for k in range(1, 9):
        assert len(result.on(1, k)) == PRIMITIVE[k]
    for cycle in result.cycles:
        slopes = [5 if event else -4 for event in cycle.word]
        # x = Σ of products of slopes over 1 - the product of all
        top = sum((Fraction(int(np.prod(slopes[i + 1 :]))) for i in range(len(slopes))), Fraction(0))
        exact = float(top / (1 - Fraction(int(np.prod(slopes)))))
        assert cycle.points[0, 0] == pytest.approx(exact, rel=1e-13)
        assert cycle.multipliers[0] == pytest.approx(np.prod(slopes), rel=1e-13)
        assert not cycle.stable and cycle.unstable == 1
    assert [c.laps for c in result.cycles] == sorted(c.laps for c in result.cycles)
    kind = corner_kind(result)
    assert (kind.kind, kind.criticality, kind.below, kind.certain) == ("fold-flip", None, (), True)
    assert len(kind.above) == len(result.cycles)


def test_tents_in_rational_numbers():
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(60):
        right, left = (Fraction(int(x), 997) for x in rng.integers(-3000, 3000, 2))
        result = find_cycles(tent(float(right), float(left)), 8)
        for side in (-1, 1):
            for k in range(1, 9):
                points = periodic_points(right, left, side, k)
                if points is None:
                    continue
                mine = sum(d * len(result.on(side, d)) for d in range(1, k + 1) if k % d == 0)
                assert mine == points, (right, left, side, k)
                compared += points
        assert not result.doubtful and not result.singular
    assert compared > 2000


@pytest.mark.parametrize(
    "left, right, kind, criticality, below, above",
    [
        (0.5, -0.5, "none", None, (1,), (1,)),
        (0.5, 0.9, "none", None, (1,), (1,)),
        (3.0, 2.0, "none", None, (1,), (1,)),
        (0.5, -1.5, "flip", "supercritical", (1,), (1, 2)),
        (-0.5, -1.5, "flip", "supercritical", (1,), (1, 2)),
        (-0.5, -3.0, "flip", "subcritical", (1, 2), (1,)),
        (0.5, -2.5, "flip", None, (1,), (1, 2)),
        (0.5, -3.5, "flip", "supercritical", (1,), (1, 2, 3, 3)),  # to a stable cycle of three laps
        (1.5, 0.5, "fold", None, (), (1, 1)),
        (1.5, -0.9, "fold", None, (), (1, 1)),
        (0.5, 2.5, "fold", None, (1, 1), ()),
        (1.5, -1.2, "fold-flip", None, (), (1, 1, 2)),
    ],
)
def test_classes_of_tent_maps(left, right, kind, criticality, below, above):
    """The regions of Nusse & Yorke (1995)."""
    result = find_cycles(tent(right, left), 3)
    assert corner_kind(result) == (kind, criticality, below, above, True)
    # The border's normal may have any length and sign.
    mirrored = corner_kind(find_cycles(tent(left, right, -3.0), 3))
    assert mirrored == (kind, criticality, below, above, True)


def test_windows_of_the_tent_map():
    """With slopes 0 < a < 1 and b a stable cycle of k laps exists if b is between two bounds; Nusse & Yorke (1995)."""
    a = 0.4
    for k in (2, 3, 4, 5):
        low, high = -(a ** (1 - k)), -sum(a ** (i - k + 2) for i in range(k - 1))
        assert low < high
        for b, there in [(0.99 * low + 0.01 * high, True), (0.01 * low + 0.99 * high, True), (0.99 * high, False)]:
            result = find_cycles(tent(b, a), 6)
            expected = [k] if there else [1] if k == 2 else []
            assert [c.laps for c in result.cycles if c.stable and c.side == 1] == expected
        assert not any(c.stable for c in find_cycles(tent(1.01 * low, a), 6).on(1, k))


@pytest.mark.parametrize("places, size, most", [(1, 1, 7), (1, 2, 6), (1, 3, 5), (2, 2, 3), (3, 2, 2), (4, 3, 1)])
def test_random_maps_against_composition(places, size, most):
    rng = np.random.default_rng(places + 10 * size)
    count = 0
    for _ in range(25):
        f = random_map(rng, places, size)
        result = find_cycles(f, most)
        assert not result.doubtful and not result.singular and result.most == most
        mine = {(c.side, c.word): c for c in result.cycles}
        assert len(mine) == len(result.cycles)
        other = {}
        for k in range(1, most + 1):
            other |= by_composition(f, k)
        assert mine.keys() == other.keys()
        count += len(mine)
        for key, c in mine.items():
            np.testing.assert_allclose(c.points[0], other[key], rtol=1e-6, atol=1e-8 * np.abs(c.points).max())
            x, size_ = c.points[0], np.abs(c.points).max()
            derivative = np.eye(size)
            for i, event in enumerate(c.word):
                p = i % places
                np.testing.assert_allclose(x, c.points[i], atol=1e-6 * size_)
                g = f.n[p] @ c.points[i] + f.c[p] * c.side
                assert (g < 0) == bool(event) and g == pytest.approx(c.borders[i], rel=1e-9, abs=1e-9 * size_)
                # Of the exact map, by differences that stay on its side of the border.
                h = 0.1 * abs(g) / np.abs(f.n[p]).max()
                columns = [
                    (step(f, p, c.points[i] + d, c.side) - step(f, p, c.points[i] - d, c.side)) / (2 * h)
                    for d in h * np.eye(size)
                ]
                derivative = np.array(columns).T @ derivative
                x = step(f, p, c.points[i], c.side)
            np.testing.assert_allclose(x, c.points[0], atol=1e-6 * size_)
            trace = np.sum(c.multipliers)
            assert trace == pytest.approx(np.trace(derivative), rel=1e-5, abs=1e-6)
            assert np.prod(c.multipliers) == pytest.approx(np.linalg.det(derivative), rel=1e-4, abs=1e-5 * abs(trace))
            assert c.stable == (np.abs(np.linalg.eigvals(derivative)).max() < 1)
            assert not c.durations.any()
    assert count > 40


def test_against_simulation():
    """What attracts is among the stable cycles, and each of these attracts."""
    rng = np.random.default_rng(5)
    longer = 0
    for _ in range(40):
        f = random_map(rng, 1, 2, spread=0.8)
        result = find_cycles(f, 8)
        for side in (-1, 1):
            stable = [c for c in result.on(side) if c.stable and abs(c.multipliers[0]) < 0.9]
            for start in rng.standard_normal((5, 2)):
                x = lap(f, start, side, 500)
                if not np.abs(x).max() < 1e3:
                    continue
                orbit = [x]
                for _ in range(8):
                    orbit.append(lap(f, orbit[-1], side))
                k = next((k for k in range(1, 9) if np.allclose(orbit[k], x, rtol=0, atol=1e-9)), None)
                if k is None:
                    continue
                assert any(np.abs(c.points - x).max(axis=1).min() < 1e-6 for c in result.on(side, k) if c.stable)
                longer += k > 1
            for c in stable:
                near = 1e-3 * np.abs(c.borders).min() * rng.standard_normal(2)
                x = lap(f, c.points[0] + near, side, 300 * c.laps)
                np.testing.assert_allclose(x, c.points[0], atol=1e-8 * np.abs(c.points).max())
    assert longer > 10


def test_feigin():
    """Eigenvalues > 1 of both sides together: an odd number is a fold. Eigenvalues < -1: an odd number is a flip."""
    rng = np.random.default_rng(7)
    kinds = set()
    for trial in range(1000):
        f = random_map(rng, 1, 1 + trial % 4)
        both = [np.linalg.eigvals(f.a[0] + event * np.outer(f.e[0], f.n[0])) for event in (0, 1)]
        real = np.concatenate([np.real(x[np.imag(x) == 0]) for x in both])
        result = find_cycles(f, 2)
        numbers = [len(result.on(side, 1)) for side in (-1, 1)]
        assert sorted(numbers) == ([0, 2] if np.sum(real > 1) % 2 else [1, 1])
        assert len(result.on(-1, 2)) + len(result.on(1, 2)) == np.sum(real < -1) % 2
        expected = {(0, 0): "none", (0, 1): "flip", (1, 0): "fold", (1, 1): "fold-flip"}
        kind = corner_kind(result)
        assert kind.kind == expected[np.sum(real > 1) % 2, np.sum(real < -1) % 2]
        kinds.add((kind.kind, kind.criticality))
    assert len(kinds) >= 6


def test_three_cycles_without_a_flip():
    """In the plane cycles of three laps may be born together where there is no flip: Nusse & Yorke's normal form."""
    born, kept = 0, 0
    rng = np.random.default_rng(3)
    for _ in range(300):
        (t, d), (t2, d2) = rng.uniform((-1.9, 0.6), (0.2, 1.3), (2, 2))
        f = CornerMap(*map(np.array, ([[[t, 1], [-d, 0]]], [[1.0, 0]], [[t2 - t, d - d2]], [[1.0, 0]], [0.0], [False])))
        result = find_cycles(f, 3)
        kind = corner_kind(result)
        if kind.kind == "multiple crossing":
            assert (kind.below + kind.above).count(3) == 2 and 2 not in kind.below + kind.above
            born += (1,) in (kind.below, kind.above)
            kept += kind.below == kind.above == (1, 3)
            for c in result.on(-1, 3) + result.on(1, 3):
                np.testing.assert_allclose(lap(f, c.points[0], c.side, 3), c.points[0], atol=1e-9)
        else:
            assert kind.kind in ("none", "flip", "fold", "fold-flip")
    assert born > 10 and kept > 10


def test_maximal_cycles_of_the_square_root():
    """x -> λ x + ν, less a root beyond the border: one contact in k laps, for every k; Nordmark (1997)."""
    slope = 0.6
    f = CornerMap(*map(np.array, ([[[slope]]], [[1.0]], [[-1.0]], [[-1.0]], [0.0], [True])))
    result = find_cycles(f, 8)
    (low,) = result.on(-1)
    assert low.word == (0,) and low.stable and low.multipliers[0] == pytest.approx(slope)
    assert low.points[0, 0] == pytest.approx(-1 / (1 - slope))
    for k in range(1, 9):
        maximal = [c for c in result.on(1, k) if sum(c.word) == 1]
        (c,) = maximal
        assert c.word == (0,) * (k - 1) + (1,)
        assert c.durations[-1] == pytest.approx(1 + (slope ** (1 - k) - 1) / (1 - slope))
        assert not c.durations[:-1].any() and c.borders[-1] == 0 and (c.borders[:-1] > 0).all()
        assert c.points[-1, 0] == pytest.approx(0, abs=1e-12)
        assert c.multipliers[0] == -np.inf and not c.stable
    assert corner_kind(result).kind == "flip" and corner_kind(result).criticality is None
    # Turned about, the root pushes back.
    fold = find_cycles(f._replace(e=np.array([[1.0]])), 1)
    assert corner_kind(fold).kind == "fold" and {c.multipliers[0] for c in fold.on(-1)} == {slope + 0j, np.inf + 0j}


def exact_cycle(f, word, nu, x, s):
    """Newton's method on x_{i+1} = a x_i + b ν + e u_i, g_i = -s_i² at square roots; and the monodromy there."""
    places, size = f.b.shape
    length, unit = len(word), size + 1
    z = np.concatenate([x, s[:, None]], axis=1)
    for _ in range(40):
        r, m = np.zeros((length, unit)), np.zeros((length, unit, length, unit))
        for i, event in enumerate(word):
            p, after = i % places, (i + 1) % length
            xi, si = z[i, :size], z[i, size]
            g = f.n[p] @ xi + f.c[p] * nu
            r[i, :size] = z[after, :size] - f.a[p] @ xi - f.b[p] * nu
            m[i, :size, after, :size] += np.eye(size)
            m[i, :size, i, :size] -= f.a[p]
            if event and f.square[p]:
                r[i, :size] -= f.e[p] * si
                m[i, :size, i, size] -= f.e[p]
                r[i, size] = g + si**2
                m[i, size, i, :size], m[i, size, i, size] = f.n[p], 2 * si
            else:
                r[i, :size] -= event * f.e[p] * g
                m[i, :size, i, :size] -= event * np.outer(f.e[p], f.n[p])
                r[i, size], m[i, size, i, size] = si, 1.0
        change = np.linalg.solve(m.reshape(length * unit, -1), r.ravel()).reshape(length, unit)
        z = z - change
        if np.abs(change).max() < 1e-12 * np.abs(z).max():
            break
    else:
        return None
    monodromy = np.eye(size)
    for i, event in enumerate(word):
        p, xi, si = i % places, z[i, :size], z[i, size]
        g = f.n[p] @ xi + f.c[p] * nu
        root = event and f.square[p]
        if (root and si <= 0) or (not root and (g < 0) != bool(event)):
            return None
        rate = -1 / (2 * si) if root else event
        monodromy = (f.a[p] + rate * np.outer(f.e[p], f.n[p])) @ monodromy
    return z[:, :size], z[:, size], monodromy


@pytest.mark.parametrize(
    "square, size, most",
    [([True], 1, 5), ([True], 2, 5), ([True], 3, 4), ([True, False], 2, 2), ([True, True], 3, 2)],
)
def test_square_roots_against_newton(square, size, most):
    """At ν = ±1e-10 the exact map has these cycles, and of what starts at random Newton's method finds no others."""
    rng = np.random.default_rng(11 + size)
    places, nu, count, roots = len(square), 1e-10, 0, 0
    for _ in range(12):
        f = random_map(rng, places, size, square)
        result = find_cycles(f, most)
        assert not result.doubtful and not result.singular
        mine = {(c.side, c.word): c for c in result.cycles}
        other = {}
        for k in range(1, most + 1):
            for word in itertools.product((0, 1), repeat=places * k):
                if word != min(rotations(word, places)) or len(set(rotations(word, places))) < k:
                    continue
                for side in (-1, 1):
                    for _ in range(3):
                        start = nu * rng.standard_normal((places * k, size)), nu * rng.uniform(0, 2, places * k)
                        found = exact_cycle(f, word, side * nu, *start)
                        if found is not None and np.abs(found[0]).max() < 1e-5:  # not far from the corner
                            other[side, word] = found
                            break
        assert mine.keys() == other.keys()
        for key, (x, s, monodromy) in other.items():
            c = mine[key]
            scale = np.abs(c.points).max()
            np.testing.assert_allclose(x / nu, c.points, atol=1e-3 * scale)
            taken = np.tile(f.square, c.laps) & (np.array(c.word) == 1)
            np.testing.assert_allclose(s[taken] / nu, c.durations[taken], rtol=1e-2)
            assert (c.durations[taken] > 0).all() and not c.durations[~taken].any()
            exact = np.linalg.eigvals(monodromy)
            exact = exact[np.argsort(-np.abs(exact))]
            assert np.isinf(c.multipliers).sum() == taken.any()
            count += 1
            if taken.any():
                roots += 1
                assert np.isinf(c.multipliers[0]) and exact[0].imag == 0
                assert np.sign(exact[0].real) == np.sign(c.multipliers[0].real) and abs(exact[0]) > 1e3
                # The others by what does not cancel: the sums of the minors.
                others = c.multipliers[1:]
                second = (np.trace(monodromy) ** 2 - np.trace(monodromy @ monodromy)) / 2
                if taken.sum() == 1 and size > 1:
                    rest = second / np.trace(monodromy)
                    assert rest == pytest.approx(np.sum(others), rel=1e-2, abs=1e-2 * np.abs(others).max())
            else:
                np.testing.assert_allclose(np.abs(exact), np.abs(c.multipliers), rtol=1e-6, atol=1e-9)
    assert count > 25 and roots > 10


def test_finite_multipliers_beside_the_infinite_one():
    """Of the monodromy at ν = 1e-30, in 200 digits, with one root or several."""
    rng = np.random.default_rng(17)
    seen = set()
    for square in ([True], [True, True], [True, False, True]):
        for _ in range(4):
            f = random_map(rng, len(square), 3, square)
            for c in find_cycles(f, 3).cycles:
                with mp.workdps(200):
                    monodromy = mp.eye(3)
                    for i, event in enumerate(c.word):
                        p = i % len(square)
                        rate = mp.mpf(event)
                        if event and f.square[p]:
                            rate = -1 / (2 * mp.mpf("1e-30") * mp.mpf(c.durations[i]))
                        jump = rate * mp.matrix(f.e[p]) * mp.matrix(f.n[p]).T
                        monodromy = (mp.matrix(f.a[p]) + jump) * monodromy
                    values = sorted(mp.eig(monodromy, left=False, right=False), key=abs, reverse=True)
                    values = np.array([complex(x) for x in values])
                roots = int(np.sum(c.durations > 0))
                seen.add(roots)
                if roots:
                    order = np.log10(abs(values[0])) / 30
                    assert abs(order - roots) < 0.3 and values[0].real * c.multipliers[0].real == np.inf
                assert np.isinf(c.multipliers).sum() == bool(roots)
                finite = c.multipliers[bool(roots) :]
                for each in (np.sum, np.prod):
                    assert each(finite) == pytest.approx(each(values[bool(roots) :]), rel=1e-6, abs=1e-9)
    assert seen >= {0, 1, 2, 3}


def symmetric_map(rng, size, j, square=False):
    f = random_map(rng, 1, size, [square])
    pairs = ([x[0], image] for x, image in zip(f[:4], (j @ f.a[0] @ j, j @ f.b[0], j @ f.e[0], f.n[0] @ j)))
    return CornerMap(*map(np.array, pairs), np.repeat(f.c, 2), np.repeat(f.square, 2))


@pytest.mark.parametrize("square", [False, True])
def test_symmetry(square):
    rng = np.random.default_rng(2)
    kinds = {}
    for trial in range(400):
        size = 1 + trial % 3
        j = -np.eye(size) if trial % 2 or size == 1 else np.diag([-1.0, 1.0, -1.0][:size])
        f = symmetric_map(rng, size, j, square)
        result = find_cycles(f, 2, symmetry=j)
        for i, c in enumerate(result.cycles):
            assert c.image is not None
            other = result.cycles[c.image]
            assert (other.image, other.side, other.laps, other.stable) == (i, c.side, c.laps, c.stable)
            images = c.points @ j.T
            shifts = [np.abs(np.roll(images, s, axis=0) - other.points).max() for s in range(1, 2 * c.laps, 2)]
            assert min(shifts) < 1e-7 * np.abs(c.points).max()
        kind = corner_kind(result)
        kinds.setdefault(kind.kind, []).append(kind.criticality)
        if kind.kind == "symmetry breaking":
            side = 1 if kind.above.count(1) == 3 else -1
            assert [c.image == i for i, c in enumerate(result.cycles) if c.side == side and c.laps == 1].count(
                False
            ) == 2
            blind = corner_kind(find_cycles(f, 2))
            assert blind.kind == f"{kind.below.count(1)} to {kind.above.count(1)}" and blind.criticality is None
    assert {"none", "fold", "symmetry breaking"} <= kinds.keys()
    assert square or {"supercritical", "subcritical"} <= set(kinds["symmetry breaking"])


def test_supercritical_symmetry_breaking():
    """Half a lap is x -> -h(x), h as steep as to repel where the event happens, at both places alike."""
    # Next to x = 0 at ν > 0 both events happen: x -> -(1.5 x); far away -(0.5 x + ...): two orbits that are images.
    a, e = 0.5, 1.0
    f = CornerMap(
        np.full((2, 1, 1), a),
        np.array([[0.0], [0.0]]),
        np.array([[e], [-e]]),
        np.array([[1.0], [-1.0]]),
        np.array([-1.0, -1.0]),
        np.zeros(2, bool),
    )
    kind = corner_kind(find_cycles(f, 3, symmetry=-np.eye(1)))
    assert kind.kind == "symmetry breaking" and kind.criticality == "supercritical" and kind.certain


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    for square in (False, True):
        f = random_map(rng, 2, 3, [square, False])
        d, q, u = np.array([1e-9, 1.0, 1e7]), 1e-5, 1e4
        # x = d x', ν = q ν', and each border in units of its own
        g = CornerMap(f.a * d / d[:, None], f.b * q / d, f.e / d / u, f.n * d * u, f.c * q * u, f.square)
        if square:
            g = g._replace(e=np.array([f.e[0] / d, g.e[1]]), n=np.array([f.n[0] * d, g.n[1]]), c=g.c / [u, 1])
        first, second = find_cycles(f, 4), find_cycles(g, 4)
        assert second.doubtful == second.singular == ()
        assert [(c.side, c.word, c.stable) for c in first.cycles] == [(c.side, c.word, c.stable) for c in second.cycles]
        for c, other in zip(first.cycles, second.cycles):
            np.testing.assert_allclose(other.points * d / q, c.points, rtol=1e-8)


def test_strong_expansion():
    """A product of maps would have lost what contracts: multipliers of 1e24 and 1e-24."""
    f = CornerMap(*map(np.array, ([np.diag([1e3, 1e-3])], [[1.0, 1.0]], [[-3e3, 1.0]], [[1.0, 0.0]], [0.0], [False])))
    result = find_cycles(f, 8)
    assert len(result.cycles) > 60
    for c in result.cycles:
        for i in range(c.laps):
            x, y = c.points[i], c.points[(i + 1) % c.laps]
            np.testing.assert_allclose(step(f, 0, x, c.side), y, rtol=1e-12, atol=1e-12)


def test_degenerate():
    # A multiplier 1 without the event: a continuum, or nothing.
    result = find_cycles(tent(1.0, 0.5), 2)
    assert (0,) in result.singular and not corner_kind(result).certain
    # Within rounding of 1, as it comes from an integration.
    assert (0,) in find_cycles(tent(1.0 + 1e-11, 0.5), 2).singular
    assert find_cycles(tent(1.0 + 1e-11, 0.5), 2, rtol=1e-13).singular == ()
    # The border holds the orbit itself, whatever ν: g = x - ν at x = ν.
    f = CornerMap(*map(np.array, ([[[0.5]]], [[0.5]], [[-2.0]], [[1.0]], [-1.0], [False])))
    result = find_cycles(f, 3)
    assert result.cycles == () and {c.word for c in result.doubtful} >= {(0,), (1,), (0, 1)}
    assert all(c.side == 0 for c in result.doubtful) and not corner_kind(result).certain
    # The cycle of two laps has one point on the border: a slope of -1 at the other.
    result = find_cycles(tent(-1.0, 0.3), 2)
    (c,) = result.doubtful
    assert c.word == (0, 1) and c.side == 1 and abs(c.borders).min() < 1e-15
    # A root that moves along the border does nothing to the next, to leading order.
    a = np.array([[[0.5, 0.0], [0.2, 0.3]]])
    f = CornerMap(a, *map(np.array, ([[1.0, 0.0]], [[0.0, 1.0]], [[1.0, 0.0]], [0.0], [True])))
    result = find_cycles(f, 1)
    assert result.singular == ((1,),)
    # It is felt two laps later only: the multipliers are beyond the leading order.
    a = np.array([[[0.5, 0.4], [0.2, 0.3]]])
    f = CornerMap(a, *map(np.array, ([[1.0, 0.0]], [[0.0, 1.0]], [[1.0, 0.0]], [0.0], [True])))
    cycles = find_cycles(f, 1).cycles
    assert len(cycles) == 2
    for c in cycles:
        assert np.isnan(c.multipliers).all() == (c.word == (1,)) and (c.stable == (c.word == (0,)))


def test_limits():
    rng = np.random.default_rng(1)
    for places, most in [(1, 8), (2, 7), (3, 4), (4, 3)]:
        result = find_cycles(random_map(rng, places, 2), 8)
        assert result.most == most and result.words <= 4096
        letters = 2**places
        assert result.words == sum(
            sum(MOEBIUS[k // d] * letters**d for d in range(1, k + 1) if k % d == 0) // k for k in range(1, most + 1)
        )
    assert find_cycles(tent(0.5, 0.2), 0).cycles == ()


def test_errors():
    f = tent(-4.0, 5.0)
    with pytest.raises(ValueError, match="CornerMap"):
        find_cycles(f._replace(c=np.zeros(2)))
    with pytest.raises(ValueError, match="finite"):
        find_cycles(f._replace(c=np.array([np.nan])))
    with pytest.raises(ValueError, match="even number"):
        find_cycles(f, symmetry=-np.eye(1))
    with pytest.raises(ValueError, match="this symmetry"):
        find_cycles(random_map(np.random.default_rng(0), 2, 2), symmetry=-np.eye(2))
