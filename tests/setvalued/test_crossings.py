"""Set-valued eigenvalues: every crossing of the axis or circle, against closed forms of the thesis and dense sampling."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from nsjax.continuation.orbits.corners._corner import transverse
from nsjax.plot._eigenvalues import eigenvalue_path as draw
from nsjax.setvalued._eigenvalue_crossings import eigenvalue_crossings, eigenvalue_path


EXACT = dict(rtol=0, atol=1e-10)
TURN = np.array([[0.0, -2.0], [2.0, 0.0]])
EYE = np.eye(2)
MIX = np.random.default_rng(5).standard_normal((4, 4))


def direct_sum(*blocks):
    n = sum(len(b) for b in map(np.atleast_2d, blocks))
    out, k = np.zeros((n, n)), 0
    for b in map(np.atleast_2d, blocks):
        out[k : k + len(b), k : k + len(b)] = b
        k += len(b)
    return out


def mixed(j):
    """In other coordinates, so that nothing is zero by construction."""
    return MIX @ j @ np.linalg.inv(MIX)


def rows(crossings):
    return [(c.kind, c.multiplicity, c.direction, c.unstable) for c in crossings]


def vertices(j):
    return [[np.atleast_2d(j(a, b)) for b in (0.0, 1.0)] for a in (0.0, 1.0)]


# Closed forms of chapter 5.


def test_saddle_node():
    (c,) = eigenvalue_crossings([[1.0]], [[-1.0]])  # (5.9)
    np.testing.assert_allclose(c.q, 1 / 2, **EXACT)
    assert c == (c.q, 0, 1, -1, (1, 0), c.q) and c.kind == "zero"


def test_transcritical_and_pitchfork_where_two_surfaces_meet():
    # det J̃ = 0 is 1 - 2 q1 = 0 in (5.12), 2 (q2 - q1) = 1 in (5.19); [J̃ | f,μ] loses rank on q1 + q2 = 1, (5.14), (5.21).
    for j, point, ends in (
        (lambda a, b: 1 - 2 * a, (1 / 2, 1 / 2), [(1 / 2, 0), (1 / 2, 1)]),
        (lambda a, b: 2 * (b - a) - 1, (1 / 4, 3 / 4), [(0, 1 / 2), (1 / 2, 1)]),
    ):
        found = eigenvalue_crossings(vertices(j))
        (c,) = found.diagonals[1]
        np.testing.assert_allclose(c.q, point, **EXACT)
        np.testing.assert_allclose(sorted(c.q for c in found.edges), ends, **EXACT)
        (curve,) = found.curves
        assert curve.kind == "zero" and not found.stays
        np.testing.assert_allclose([j(*q) for q in curve.q], 0, **EXACT)
        np.testing.assert_allclose(sorted(map(tuple, curve.q[[0, -1]])), ends, **EXACT)
        (c,) = eigenvalue_crossings(vertices(j), along=((0, 0.625), (1, 0.625)))
        np.testing.assert_allclose(j(*c.q), 0, **EXACT)
        assert "curve, zero" in str(found)


def test_hopf():
    omega = 1.7  # (5.29): the pair is -1 + 2 (2 q - 1) ± iω
    (c,) = eigenvalue_crossings([[-3.0, -omega], [omega, -3.0]], [[1.0, -omega], [omega, 1.0]])
    np.testing.assert_allclose([c.q, c.eigenvalue], [3 / 4, 1j * omega], **EXACT)
    assert c[2:5] == (1, 1, (0, 2)) and c.kind == "pair"


def test_hopf_pitchfork():
    minus, plus = jnp.array([[0.0, 1.0], [-3.0, 1.0]]), jnp.array([[0.0, 1.0], [1.0, -3.0]])
    hopf, pitchfork = eigenvalue_crossings(minus, plus)
    np.testing.assert_allclose([hopf.q, hopf.eigenvalue], [1 / 4, 1j * np.sqrt(2)], **EXACT)
    np.testing.assert_allclose([pitchfork.q, pitchfork.eigenvalue], [3 / 4, 0], **EXACT)
    assert rows([hopf, pitchfork]) == [("pair", 1, -1, (2, 0)), ("zero", 1, 1, (0, 1))]
    path = eigenvalue_path(minus, plus)
    ends = [np.sort_complex(path.eigenvalues[k]) for k in (0, -1)]
    np.testing.assert_allclose(ends[0], [0.5 - 0.5j * np.sqrt(11), 0.5 + 0.5j * np.sqrt(11)], **EXACT)  # (5.33)
    np.testing.assert_allclose(ends[1], [-1.5 - 0.5 * np.sqrt(13), -1.5 + 0.5 * np.sqrt(13)], **EXACT)  # (5.34)
    path = eigenvalue_path(plus, [[0.0, 1.0], [-1.0, -3.0]])
    np.testing.assert_allclose(np.sort(path.eigenvalues[-1].real), -1.5 + np.sqrt(5) * np.array([-0.5, 0.5]), **EXACT)
    assert str(hopf) == "q = 0.25: eigenvalue ±1.414213562i, unstable 2 -> 0"


def test_hopf_pitchfork_over_two_surfaces():
    # (5.32) with the surfaces of x1 and of x2 apart: stiffness and damping jump each on its own.
    found = eigenvalue_crossings(vertices(lambda a, b: np.array([[0, 1], [-3 + 4 * a, 1 - 4 * b]])), lines=17)
    assert {c.kind for c in found.curves} == {"zero", "pair"}
    for curve in found.curves:
        straight = curve.q[:, 0] - 3 / 4 if curve.kind == "zero" else curve.q[:, 1] - 1 / 4
        np.testing.assert_allclose(straight, 0, **EXACT)
        if curve.kind == "pair":
            np.testing.assert_allclose(curve.eigenvalues, 1j * np.sqrt(3 - 4 * curve.q[:, 0]), **EXACT)
            np.testing.assert_allclose(sorted(curve.q[[0, -1], 0]), [0, 3 / 4], atol=1 / 16)
    both = found.diagonals[0]
    np.testing.assert_allclose([c.q for c in both], [(1 / 4, 1 / 4), (3 / 4, 3 / 4)], **EXACT)
    (double,) = found.diagonals[1]  # where the curves meet: a double zero
    assert double.multiplicity == 2 and np.allclose(double.q, (3 / 4, 1 / 4), **EXACT)


# What dense sampling finds is in the list, and what is in the list is on the axis.


def random_pair(rng, n, multipliers):
    a, b = rng.standard_normal((2, n, n))
    kind = rng.integers(4)
    if kind == 1:  # one surface: a jump of rank one
        b = a + 3 * np.outer(*rng.standard_normal((2, n)))
    elif kind == 2:  # units
        d = 10 ** rng.uniform(-8, 8, n)
        a, b = a * d / d[:, None], b * d / d[:, None]
    elif kind == 3:  # rows of different size
        a, b = a * 10 ** rng.uniform(-4, 4, (n, 1)), b * 10 ** rng.uniform(-4, 4, (n, 1))
    if multipliers:
        size = 1.5 * np.exp(rng.uniform(-0.5, 0.5)) / np.abs(np.linalg.eigvals(a)).max()
        a, b = a * size, b * size
    return a, b


def check(a, b, multipliers, points=401):
    found = eigenvalue_crossings(a, b, multipliers=multipliers)
    grid = np.linspace(0, 1, points)
    sampled = a + grid[:, None, None] * (b - a)
    values = np.linalg.eigvals(sampled)
    unstable = np.sum(np.abs(values) > 1 if multipliers else values.real > 0, axis=1)
    steps = np.zeros(points - 1, int)
    flips = {"zero": np.zeros(points - 1, int), "+1": np.zeros(points - 1, int), "-1": np.zeros(points - 1, int)}
    for c in found:
        assert 0 <= c.q <= 1 and c.until == c.q
        at = np.linalg.eigvals(a + c.q * (b - a))
        assert np.abs(at - c.eigenvalue).min() <= 1e-9 * max(1, np.abs(at).max())
        k = min(max(int(np.searchsorted(grid, c.q)) - 1, 0), points - 2)
        steps[k] += c.unstable[1] - c.unstable[0]
        if c.kind != "pair":
            flips[c.kind][k] += c.multiplicity
    np.testing.assert_array_equal(steps, np.diff(unstable))
    for kind, shift in {"+1": 1, "-1": -1}.items() if multipliers else [("zero", 0)]:
        sign = np.linalg.slogdet(sampled - shift * np.eye(len(a)))[0]
        np.testing.assert_array_equal(flips[kind] % 2, sign[1:] != sign[:-1])
    return len(found)


@pytest.mark.parametrize("multipliers", [False, True])
@pytest.mark.parametrize("pairs", [200, pytest.param(10_000, marks=pytest.mark.slow)])
def test_nothing_that_sampling_finds_is_missing(pairs, multipliers):
    rng = np.random.default_rng(pairs)
    number = sum(check(*random_pair(rng, int(rng.integers(2, 7)), multipliers), multipliers) for _ in range(pairs))
    assert number > pairs


def test_backwards_transposed_and_in_other_coordinates():
    rng = np.random.default_rng(4)
    a, b = 2 * rng.standard_normal((2, 4, 4))
    there = eigenvalue_crossings(a, b)
    assert there
    for other in (eigenvalue_crossings(a.T, b.T), eigenvalue_crossings(mixed(a), mixed(b))):
        assert rows(other) == rows(there)
        np.testing.assert_allclose([c.q for c in other], [c.q for c in there], atol=1e-11)
    back = eigenvalue_crossings(b, a)
    np.testing.assert_allclose([1 - c.q for c in back[::-1]], [c.q for c in there], atol=1e-11)
    assert [c.direction for c in back[::-1]] == [-c.direction for c in there]


def test_curves_are_exact():
    rng = np.random.default_rng(0)
    j0, j1, j2 = rng.standard_normal((3, 4, 4))

    def j(a, b):
        return j0 + 3 * a * j1 + 3 * b * j2

    found = eigenvalue_crossings(vertices(j), lines=12)
    assert {c.kind for c in found.curves} == {"zero", "pair"}
    for curve in found.curves:
        assert np.abs(np.diff(curve.q, axis=0)).max() < 0.1
        for q, value in zip(curve.q, curve.eigenvalues):
            assert np.abs(np.linalg.eigvals(j(*q)) - value).min() < 1e-11
    found = eigenvalue_crossings(vertices(j), multipliers=True, lines=8)
    for curve in found.curves:
        np.testing.assert_allclose(np.abs(curve.eigenvalues), 1, atol=1e-13)
        for q, value in zip(curve.q, curve.eigenvalues):
            assert np.abs(np.linalg.eigvals(j(*q)) - value).min() < 1e-11


# Degenerate cases.


def degenerate():
    def cubic(q):
        return np.array([[-1, q - 0.3, 0], [0, -2, q - 0.3], [q - 0.3, 0, 0]])

    def touch(q):
        return np.array([[-1, q - 0.5], [0.5 - q, 0]])

    def pairs(a, b):
        return lambda q: direct_sum(a[0] * TURN + a[1] * (q - 0.5) * EYE, b[0] * TURN + b[1] * (q - 0.5) * EYE)

    def coupled(q):
        j = pairs((1, 1), (1, 1))(q)
        j[:2, 2:] = EYE
        return j

    half = 0.5
    yield "touches at zero", lambda q: direct_sum(touch(q), [[-2]], [[0.7]]), [(half, ("zero", 1, 0, (1, 1)))]
    yield "inflection at zero", lambda q: direct_sum(cubic(q), [[-2]]), [(0.3, ("zero", 1, 1, (0, 1)))]
    yield (
        "pair touches",
        lambda q: np.kron(touch(q), EYE) + np.kron(EYE, TURN),
        [(half, ("pair", 1, 0, (0, 0)))],
    )
    yield (
        "two pairs, opposite ways",
        pairs((1, 1), (1.5, -1)),
        [(half, ("pair", 1, 1, (2, 2))), (half, ("pair", 1, -1, (2, 2)))],
    )
    yield "one pair twice", pairs((1, 1), (1, 1)), [(half, ("pair", 2, 1, (0, 4)))]
    yield "one pair twice, defective", coupled, [(half, ("pair", 2, 1, (0, 4)))]
    yield (
        "zero and pair",
        lambda q: direct_sum(TURN + (q - 0.5) * EYE, [[0.5 - q]], [[-1]]),
        [(half, ("zero", 1, -1, (1, 2))), (half, ("pair", 1, 1, (1, 2)))],
    )
    yield (
        "zeros both ways",
        lambda q: np.diag([q - 0.5, 0.5 - q, 1, -1]),
        [(half, ("zero", 2, 0, (2, 2)))],
    )
    yield (
        "double zero, defective",
        lambda q: direct_sum([[q - 0.5, 1], [0, q - 0.5]], [[1]], [[-1]]),
        [(half, ("zero", 2, 1, (1, 3)))],
    )
    yield "starts on the axis", lambda q: direct_sum(TURN + q * EYE, -EYE), [(0.0, ("pair", 1, 1, (0, 2)))]
    yield "ends on the axis", lambda q: direct_sum(TURN + (q - 1) * EYE, -EYE), [(1.0, ("pair", 1, 1, (0, 2)))]
    yield "real pair ±a is none", lambda q: np.diag([q, -0.5, 1, 2]) + np.eye(4), []


@pytest.mark.parametrize("change", [lambda j: j, mixed], ids=["plain", "mixed"])
@pytest.mark.parametrize("name, j, expected", list(degenerate()), ids=[case[0] for case in degenerate()])
def test_degenerate(name, j, expected, change):
    found = eigenvalue_crossings(change(j(0.0)), change(j(1.0)))
    assert sorted(rows(found)) == sorted(row for _, row in expected)
    np.testing.assert_allclose(
        [c.q for c in found], [q for q, _ in expected], atol=1e-5 if "inflection" in name else 1e-10
    )


@pytest.mark.parametrize("change", [lambda j: j, mixed], ids=["plain", "mixed"])
def test_eigenvalues_that_stay_on_the_axis(change):
    def found(j, **options):
        return [
            (c.kind, c.multiplicity, c.direction, pytest.approx(c.q, abs=1e-8), pytest.approx(c.until, abs=1e-8))
            for c in eigenvalue_crossings(change(j(0.0)), change(j(1.0)), **options)
        ]

    # A free body, and a zero that crosses beside its two.
    free = found(lambda q: direct_sum([[0, 1], [0, 0]], [[q - 0.5]], [[-1]]))
    assert free == [("zero", 2, 0, 0, 1), ("zero", 3, 1, 0.5, 0.5)]
    # An undamped oscillator loses its stiffness at q = 1/4.
    soft = found(lambda q: direct_sum([[0, 1], [q - 0.25, 0]], -EYE))
    assert soft == [("pair", 1, 1, 0, 0.25), ("zero", 2, 1, 0.25, 0.25)]

    # Two undamped pairs meet and leave the axis (flutter) where the coupling p has |p| = 1/2.
    def flutter(q):
        p = 2 * q - 1
        return np.block([[np.zeros((2, 2)), EYE], [-np.array([[2, p], [-p, 1]]), np.zeros((2, 2))]])

    pairs = found(flutter)
    assert sorted(pairs, key=lambda c: (c[3].expected, c[1])) == [
        ("pair", 1, 0, 0.25, 0.75),
        ("pair", 1, 0, 0.25, 0.75),
        ("pair", 2, -1, 0.25, 0.25),
        ("pair", 2, 1, 0.75, 0.75),
    ]
    # The trivial multiplier of an autonomous system and one that vanishes, with a flip.
    trivial = found(lambda q: np.diag([1, 0, 0.5 - 2 * q, -0.2]), multipliers=True)
    assert trivial == [("+1", 1, 0, 0, 1), ("-1", 1, 1, 0.75, 0.75)]
    assert [row[:3] for row in found(lambda q: direct_sum(TURN / 2, 0.5 * EYE), multipliers=True)] == [("pair", 1, 0)]


def test_a_crossing_beside_a_defective_zero():
    """The last digits of the entries move roots by the square root of rounding where two zeros that
    stay are defective. They are one crossing with that of the third, not several."""
    rng, eps = np.random.default_rng(0), np.finfo(float).eps

    def jacobian(q):
        j = mixed(direct_sum([[0, 1], [0, 0]], [[q - 0.5]], [[-1]]))
        return j * (1 + eps * rng.integers(-2, 3, j.shape))

    for _ in range(300):
        stays, crosses = eigenvalue_crossings(jacobian(0.0), jacobian(1.0))
        assert (stays.kind, stays.multiplicity, stays.q, stays.until) == ("zero", 2, 0, 1)
        assert (crosses.kind, crosses.multiplicity, crosses.direction) == ("zero", 3, 1)
        np.testing.assert_allclose(crosses.q, 0.5, atol=1e-12)


def test_no_jump_and_one_dimension():
    assert eigenvalue_crossings([[1.0]], [[1.0]]) == []
    (c,) = eigenvalue_crossings([[0.0]], [[0.0]])
    assert (c.q, c.until, c.eigenvalue) == (0, 1, 0)
    assert "q = 0 to 1" in str(c)
    assert [c.kind for c in eigenvalue_crossings([[-2.0]], [[2.0]], multipliers=True)] == ["-1", "+1"]
    found = eigenvalue_crossings(vertices(lambda a, b: np.zeros((1, 1))), lines=4)
    assert found.curves == [] and len(found.stays) == 4


@pytest.mark.parametrize("size", [1e-8, 1e8])
def test_scales(size):
    a, b = np.array([[0.0, 1.0], [-3.0, 1.0]]), np.array([[0.0, 1.0], [1.0, -3.0]])
    d = np.array([1.0, size])
    for one, other in ((size * a, size * b), (a * d / d[:, None], b * d / d[:, None])):
        np.testing.assert_allclose([c.q for c in eigenvalue_crossings(one, other)], [1 / 4, 3 / 4], **EXACT)
    # A side much stiffer than the other: tr and det of (1 - q) a + q size b are zero.
    trace, det = 1 / (1 + 3 * size), 3 / (3 + size)
    found = {c.kind: c for c in eigenvalue_crossings(a, size * b)}
    np.testing.assert_allclose(found["pair"].q, trace, rtol=1e-12)
    np.testing.assert_allclose(found["zero"].q, det, rtol=1e-12)


def test_multipliers_of_a_rotation():
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    (c,) = eigenvalue_crossings(0.5 * turn, 1.5 * turn, multipliers=True)
    np.testing.assert_allclose([c.q, c.eigenvalue], [0.5, np.exp(0.7j)], **EXACT)
    assert c[2:5] == (1, 1, (0, 2))


def test_single_precision_is_taken_as_it_is():
    a, b = jnp.array([[0, 1], [-3, 1]], jnp.float32), jnp.array([[0, 1], [1, -3]], jnp.float32)
    np.testing.assert_allclose([c.q for c in eigenvalue_crossings(a, b)], [1 / 4, 3 / 4], **EXACT)
    third = jnp.asarray(1 / 3, jnp.float32)
    corners = [
        [jnp.full((1, 1), -third), jnp.full((1, 1), third)],
        [jnp.full((1, 1), 2 * third), jnp.full((1, 1), 4 * third)],
    ]
    assert len(eigenvalue_crossings(corners, lines=4).curves) == 1


def test_what_is_no_pair_of_matrices_is_refused():
    with pytest.raises(ValueError, match="`j_minus` must be a square matrix"):
        eigenvalue_crossings(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="`j_plus` must have the shape"):
        eigenvalue_crossings(np.eye(2), np.eye(3))
    with pytest.raises(ValueError, match="`j_plus` must be finite"):
        eigenvalue_crossings(np.eye(1), [[np.inf]])
    with pytest.raises(ValueError, match="four square matrices"):
        eigenvalue_crossings(np.eye(2))
    with pytest.raises(ValueError, match=r"\(4.20\)"):
        eigenvalue_crossings(vertices(lambda a, b: a * b))
    with pytest.raises(ValueError, match="`along` is for two surfaces"):
        eigenvalue_crossings(np.eye(2), np.eye(2), along=((0, 0), (1, 1)))
    with pytest.raises(ValueError, match="`along` must be two points"):
        eigenvalue_crossings(vertices(lambda a, b: a - b), along=((0, 0), (2, 1)))
    with pytest.raises(ValueError, match="`lines`"):
        eigenvalue_crossings(vertices(lambda a, b: a - b), lines=1)
    with pytest.raises(ValueError, match="`points`"):
        eigenvalue_path(np.eye(2), np.eye(2), points=1)
    with pytest.raises(jax.errors.TracerArrayConversionError):
        jax.jit(lambda j: eigenvalue_crossings(j, j)[0].q)(jnp.eye(2))


# Paths.


@pytest.mark.parametrize("multipliers", [False, True])
def test_branches_of_a_path_are_continuous(multipliers):
    rng = np.random.default_rng(1)
    for n in (1, 2, 4, 6):
        a, b = rng.standard_normal((2, n, n))
        path = eigenvalue_path(a, b, multipliers=multipliers)
        assert path.q[0] == 0 and path.q[-1] == 1 and np.all(np.diff(path.q) > 0)
        assert {c.q for c in path.crossings} <= set(path.q)
        for q, values in zip(path.q, path.eigenvalues):
            exact = np.linalg.eigvals(a + q * (b - a))
            assert max(np.abs(exact - v).min() for v in values) < 1e-6  # beside a collision
            assert abs(np.sum(values) - np.trace(a + q * (b - a))) < 1e-10
        size = np.abs(path.eigenvalues).max()
        assert np.abs(np.diff(path.eigenvalues, axis=0)).max() < 0.2 * size


def test_branches_pass_through_each_other():
    path = eigenvalue_path(mixed(np.diag([-1.0, 1.0, 3.0, 0.2])), mixed(np.diag([1.0, -1.0, -3.0, 0.2])))
    ends = path.eigenvalues[[0, -1]].T.real
    np.testing.assert_allclose(sorted(map(tuple, ends)), [(-1, 1), (0.2, 0.2), (1, -1), (3, -3)], atol=1e-9)


def test_pictures():
    path = eigenvalue_path([[0.0, 1.0], [-3.0, 1.0]], [[0.0, 1.0], [1.0, -3.0]])
    ax = draw(path, labels={"Re": "Re λ [1/s]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Re λ [1/s]", "Im λ")
    assert sorted(t.get_text() for t in ax.texts) == ["q = 0.25", "q = 0.25", "q = 0.75"]
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["q = 0", "q = 1", "crosses"]
    drawn = [line.get_xydata() for line in ax.get_lines()]
    for branch in path.eigenvalues.T:
        assert any(np.array_equal(xy, np.stack([branch.real, branch.imag], 1)) for xy in drawn)
    ax = draw(eigenvalue_path([[0.5]], [[-2.0]], multipliers=True), ax=plt.subplots()[1])
    circle = ax.get_lines()[0].get_xydata()
    np.testing.assert_allclose(np.hypot(*circle.T), 1)
    assert [t.get_text() for t in ax.texts] == ["q = 0.6"] and ax.get_xlabel() == "Re λ [-]"
    ax = draw(eigenvalue_path([[0.0]], [[0.0]]))  # stays: drawn, but no crossing
    assert not ax.texts
    plt.close("all")


@pytest.mark.parametrize("n", [3, 5])
def test_without_the_direction_along_an_orbit(n):
    """Monodromy matrices of an autonomous orbit on both sides of a corner share the flow's direction, not its row: what is
    between them has the same multipliers without it."""
    rng = np.random.default_rng(n)
    flow = rng.normal(size=n)
    ends = []
    for _ in range(2):
        matrix = rng.normal(size=(n, n))
        ends.append(matrix + np.outer(flow - matrix @ flow, flow) / (flow @ flow))
    first, second = transverse(*ends)
    for q in np.linspace(0, 1, 7):
        whole = np.linalg.eigvals(ends[0] + q * (ends[1] - ends[0]))
        rest = np.linalg.eigvals(first + q * (second - first))
        np.testing.assert_allclose(np.sort_complex([*rest, 1.0]), np.sort_complex(whole), atol=1e-9)
