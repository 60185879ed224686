"""Every result prints itself in a few lines, in lists and notebooks too, batched or not, and never fails."""

import html

import jax
import numpy as np
import pytest
from branches import branch_of, special_at

import nsjax
from nsjax import gallery, RESULTS
from nsjax._work_precision import Row
from nsjax.continuation.equilibria._bifurcation import Bifurcation, HalfBranch
from nsjax.gallery import Motion
from nsjax.orbits.segments._arcs import Arcs, Path


def array(x, dtype=None):
    """A JAX array made without a program: this file makes its results while tests are collected."""
    return jax.device_put(np.asarray(x, dtype))


GOOD, BAD = RESULTS.successful, RESULTS.max_events_reached
BELT = gallery.StickSlip()
STATE = Motion(array(1.5), array(-0.25))
ARCS = Arcs(
    array([0.0, 1.0, 2.0]),
    array([1.0, 2.0, 2.0]),
    array(np.zeros((3, 1), int)),
    Motion(*map(array, np.ones((2, 3, 4)))),
)
ROWS = Motion(np.array([1.0, 2.0, np.nan]), np.array([-1.0, 0.0, np.nan]))  # the last is none


def several(*results):
    return jax.tree.map(lambda *x: array(np.stack(x)), *results)


def orbit(result=GOOD, multipliers=(1, 0.5)):
    events = nsjax.flow.Events(
        t=array([1.0, np.inf]), switch=array([0, -1]), mode_before=array([[-1], [0]]),
        mode_after=array(np.zeros((2, 1), int)), y_before=Motion(array(np.ones(2)), array(np.zeros(2))),
        y_after=Motion(array(np.ones(2)), array(np.zeros(2))), transversality=array(np.ones(2)), num=array(1), names=("belt",),
    )  # fmt: skip
    return nsjax.Orbit(
        system=BELT, t0=array(0.0), y0=STATE, mode=array([-1]), period=array(13.5), events=events,
        monodromy=array(np.eye(2)), multipliers=array(multipliers, complex), structural_zeros=array(0),
        stable=array(True), residual=array(1e-15), admissible=array(True),
        violation=array(0.0), violation_t=array(0.0), arcs=ARCS, result=result, integrator=None,
    )  # fmt: skip


def equilibrium(result=GOOD):
    return nsjax.Equilibrium(
        system=BELT, y=STATE, mode=array([0]), multipliers=array([0.5]), jacobian=array(np.eye(2)),
        eigenvalues=array([-1 + 1j, np.nan]), held=array(1), stable=array(True),
        admissible=array(True), boundary=array(False), isolated=array(False),
        residual=array(0.0), result=result,
    )  # fmt: skip


def sensitivity(defined):
    itinerary = nsjax.flow.Itinerary(
        array([-1]), array([0, -1]), array(np.zeros((2, 1), int)), array(1), ("belt",)
    )  # fmt: skip
    return nsjax.derivatives.Sensitivity(STATE, Motion(array(0.3), array(np.ones(3))), itinerary, array(defined), GOOD)


CROSSING = nsjax.setvalued.EigenvalueCrossing(0.25, 2j, 1, -1, (2, 0), 0.25)
CURVE = nsjax.setvalued.EigenvalueCurve("zero", np.array([[0.0, 0.5], [1.0, 0.5]]), np.zeros(2, complex))
PATH = Path(array([[0.0, 1.0], [2.0, 2.0]]), Motion(array(np.eye(2)), array(np.eye(2))), array(np.zeros((2, 1), int)))
HALF = HalfBranch(-1, np.array([1, 0]), (STATE, 1.0), np.array([-1 + 0j, np.nan]), 0, True, 1)
HOPF = Bifurcation(
    kind="Hopf", discontinuous=True, criticality="supercritical", evidence="crossing", by_count="none",
    by_crossing=("Hopf",), parameter="mu", value=0.5, y=STATE, count=(1, 1), surfaces=("belt",), crossings=[CROSSING],
    places=[{"belt": 0.25}], halves=[HALF], period=np.pi, orbits=(0, 1),
)  # fmt: skip
BRANCH = nsjax.Branch(
    system=BELT, parameter="mu", values=np.array([0.0, 1.0]), ys=Motion(np.ones(2), np.ones(2)),
    modes=np.zeros((2, 1), int), multipliers=np.zeros((2, 1)), eigenvalues=np.ones((2, 2), complex),
    unstable=np.array([0, 1]), stable=np.array([True, False]), special=(HOPF,), indices=(1,), ends=("mu = 0", "mu = 1"),
)  # fmt: skip
CORNER = special_at("fold", 1.5, (0.8, 0.0), (2.0, 0.1), surfaces=("friction",))
ORBITS = branch_of(gallery.ForcedFriction(), "omega", [1.0, 1.5], [1.0, 2.0], [(0.5, 0), (0.8, 0)], [CORNER], [1])
CUSP = nsjax.continuation.CodimensionTwo("cusp", np.array([0.3, 1.25]), 6.0, np.ones(2), 0.0, STATE)
LOCUS = nsjax.continuation.BifurcationCurve(
    system=BELT, kind="grazing", surfaces=("belt",), parameters=("a", "b"), values=np.eye(2), periods=np.ones(2),
    multipliers=np.ones((2, 2)), ts=np.ones(2), ys=ROWS, special=(CUSP,), indices=(1,), ends=("a = 0", "a = 1"),
)  # fmt: skip
LANES = nsjax.continuation.OrbitBranches(
    systems=BELT, parameter="mu", values=np.ones((1, 3)), periods=np.ones((1, 3)), ts=np.ones((1, 3)), ys=ROWS,
    orders=np.ones(1, int), low=ROWS, high=ROWS, multipliers=np.ones((1, 3, 2)), stable=np.ones((1, 3), bool),
    kinds=np.array([["", "fold", ""]]), start=np.zeros(1, int), num=np.array([2]), ends=np.array([["lost", "lost"]]),
)  # fmt: skip
JACOBIAN = nsjax.setvalued.GeneralizedJacobian(("left",), array([np.eye(2), -np.eye(2)]), None)
DIAGRAM = nsjax.maps.BruteForce(
    "omega", array(np.linspace(1.0, 2.0, 4)), array(np.ones((4, 2, 5))), Motion(*map(array, np.ones((2, 4, 2, 5)))),
    several(*[several(GOOD, BAD)] * 4),
)  # fmt: skip
SPECTRUM = nsjax.maps.LyapunovSpectrum(
    array([0.06, -np.inf]), array([1e-3, np.nan]), array(np.ones((9, 2))), array(3.0), None, STATE, GOOD
)
BASINS = nsjax.maps.Basins(
    np.array([0, 0, -1]), (Motion(*map(array, np.ones((2, 1)))),), np.ones(3, int), ROWS, np.zeros(3, int)
)
CHART = nsjax.maps.AttractorChart(
    ("omega", "e"), (np.array([1.0, 2.0]), np.array([0.5])), np.array([[2], [0]]), np.array([[0], [-1]]),
    ("wall×2",), np.array([[False], [True]]), np.ones((2, 1)), np.ones((2, 1)), np.ones((2, 1), int), ROWS,
    np.zeros((2, 1), int),
)  # fmt: skip
ITERATE = nsjax.maps.Iterate(array(6.25), STATE, array([-1, 1]), GOOD)
REDUCED = nsjax.maps.ReducedIterate(array(0.7), STATE, GOOD)
TABLE = nsjax.WorkPrecision((Row("Tsit5", 1e-6, 0.1, 1e-7, 2.0, None, ""),), 0.0)

# Result, how many lines at most, and what the text begins with and holds.
CASES = {
    "basins": (BASINS, 3, "basins of 1 attractors, 3 starts", "undecided: 33.33%"),
    "a chart": (CHART, 4, "attractor chart over omega = 1 to 2, e = 0.5: 2 x 1", "1 chaos, 1 period 2"),
    "Lyapunov exponents": (SPECTRUM, 3, "Lyapunov exponents over 9 intervals of 3: successful", "0.06 ± 0.001"),
    "an orbit": (orbit(), 6, "stable periodic orbit of StickSlip", "multipliers  1+0j, 0.5+0j"),
    "no orbit": (orbit(RESULTS.orbit_not_found), 6, "failed search (orbit_not_found) for a periodic orbit", "residual"),
    "orbits": (several(orbit(), orbit(RESULTS.orbit_not_found)), 2, "2 searches for periodic orbits", "1 found"),
    "an orbit of many dimensions": (orbit(multipliers=[0.5] * 99), 6, "stable", "0.5+0j, ..."),
    "an equilibrium": (equilibrium(), 6, "stable, not isolated equilibrium of StickSlip", "eigenvalues  -1+1j"),
    "no equilibrium": (equilibrium(RESULTS.equilibrium_not_found), 6, "failed search (equilibrium_not_found)", ""),
    "equilibria": (several(equilibrium(), equilibrium()), 1, "2 searches for equilibria", "2 found"),
    "events": (orbit().events, 1, "t = 1 ", "belt: belt -1 -> +0   y = (1, 0)"),
    "an event": (orbit().events[0], 1, "t = 1 ", "belt: belt -1 -> +0   y = (1, 0)"),
    "an itinerary": (orbit().itinerary, 1, "belt -1 -> belt +0", ""),
    "arcs": (ARCS, 1, "arcs of an orbit: 2, t = 0 to 2", ""),
    "a path": (PATH, 2, "path of an orbit, t = 0 to 2: arcs 1, times on each 2", "states  x = 0 to 1"),
    "a branch": (BRANCH, 9, "1 branch of StickSlip", "supercritical at mu = 0.5"),
    "a bifurcation": (HOPF, 6, "discontinuous Hopf bifurcation", "periodic orbits 0 -> 1"),
    "a half-branch": (HALF, 1, "stable half-branch below: mode (1, 0)", "eigenvalues -1+0j"),
    "a branch of orbits": (ORBITS, 8, "1 branch of periodic orbits of ForcedFriction", "fold bifurcation at omega"),
    "a bifurcation of orbits": (CORNER, 5, "discontinuous fold bifurcation at omega = 1.5", "surfaces     friction"),
    "half of it": (
        nsjax.continuation.OrbitHalfBranch(1, 2, np.array([0.5, 0.1]), False, "belt -1 -> belt +0 " * 20),
        1, "unstable half-branch above, period 2: belt -1 -> belt +0", " ...; multipliers 0.5, 0.1",
    ),
    "lanes": (LANES, 3, "1 branches of periodic orbits of StickSlip: 2 points", "1 times: fold"),
    "a curve of bifurcations": (LOCUS, 4, "curve of periodic orbits of StickSlip: grazing of belt", "cusp at a = 0.3"),
    "a point of codimension two": (CUSP, 1, "cusp at (0.3, 1.25), period 6", ""),
    "a crossing": (CROSSING, 1, "q = 0.25: eigenvalue ±2i, unstable 2 -> 0", ""),
    "a curve of eigenvalues": (CURVE, 1, "curve, zero: (0, 0.5) to (1, 0.5), 2 points", ""),
    "curves": (nsjax.setvalued.EigenvalueCurves([CURVE], [CROSSING], ([], []), []), 2, "curve, zero", "edge: q = 0.25"),
    "no curves": (nsjax.setvalued.EigenvalueCurves([], [], ([], []), []), 1, "no eigenvalue crosses", ""),
    "a path of eigenvalues": (
        nsjax.setvalued.EigenvaluePath(np.linspace(0, 1, 9), np.ones((9, 2), complex), [CROSSING], False),
        2, "path of 2 eigenvalues, q = 0 to 1: 9 points", "q = 0.25",
    ),
    "a generalized Jacobian": (JACOBIAN, 3, "generalized Jacobian on left", "left < 0: [1 0; 0 1]"),
    "a large one": (
        nsjax.setvalued.GeneralizedJacobian((), array(np.eye(50)), None), 2, "generalized Jacobian on no surface", "50 rows, entries 0 to 1",
    ),
    "a diagram": (DIAGRAM, 4, "brute-force diagram over omega = 1 to 2", "4 max_events_reached, 4 successful"),
    "diagrams": (several(DIAGRAM, DIAGRAM), 4, "2 brute-force diagrams over omega", "values 4, starts 2"),
    "an iterate": (ITERATE, 1, "iterate at t = 6.25: x = 1.5, v = -0.25; mode (-1, 1); successful", ""),
    "iterates": (several(ITERATE, ITERATE._replace(result=BAD)), 3, "2 iterates from t = 6.25", "1 max_events_reached"),
    "an iterate of a reduced map": (REDUCED, 4, "iterate of a reduced map\n  values  0.7\n", "from    x = 1.5, v = -0.25"),
    "many": (several(*[REDUCED] * 64), 4, "64 iterates of a reduced map\n  values  0.7\n", "64 successful"),
    "none": (jax.tree.map(lambda x: array(np.asarray(x)[None][:0]), ITERATE), 3, "0 iterates from t = none", "result  none"),
    "a sensitivity": (sensitivity(True), 5, "sensitivity\n", "derivative  x = 0.3, v[0] = 1, v[1] = 1, v[2] = 1"),
    "none at a grazing": (sensitivity(False), 5, "sensitivity that is not defined\n", "belt -1 -> belt +0"),
    "sensitivities": (several(sensitivity(True), sensitivity(False)), 5, "2 sensitivities, 1 of them defined", "x = 0.3,"),
    "how far a sweep is": (
        nsjax.sweeps.Status(1000, 450, 10, 4, 1, 50.0, 11.0),
        1, "450 of 1,000 lanes (45.0 %), 4 of 10 blocks, 1 running", "50 lanes/s, 11 s left",
    ),
    "a table": (TABLE, 3, "| method | tolerance |", "| Tsit5 | 1e-06 | 1.0e-07 | 0.1 | 2.0 |"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_printed(name):
    result, most, begins, holds = CASES[name]
    text = str(result)
    assert repr(result) == text and text.startswith(begins) and holds in text
    lines = text.split("\n")
    assert len(lines) <= most and max(map(len, lines)) <= 120 and all(line.strip() for line in lines)
    assert result._repr_html_() == f"<pre>{html.escape(text)}</pre>"
    assert text in repr([result, result])


@pytest.mark.parametrize("name", CASES)
def test_without_numbers(name):
    """Traced, and of other leaves, as shapes or axes."""
    result = CASES[name][0]
    numbers, rest = jax.tree.flatten(result)
    texts = []

    @jax.jit
    def trace(numbers):
        texts.append(repr(jax.tree.unflatten(rest, numbers)))

    if all(isinstance(x, (jax.Array, np.ndarray, float, int)) for x in numbers):
        trace(numbers)
        assert not numbers or type(result).__name__ in texts[0]
    for leaf in (None, "text", jax.ShapeDtypeStruct((), float)):
        assert repr(jax.tree.map(lambda _: leaf, result)) == str(jax.tree.map(lambda _: leaf, result))


def test_all_public_results_are_in_the_table():
    """`Solution` is in `test_mistakes`, continuations are in `test_orbit_growth` and `test_equilibrium_growth`, `Sweep` is
    in `test_long_sweep`."""
    others = {
        "Method",
        "Segment",
        "Solution",
        "EquilibriumContinuation",
        "OrbitContinuation",
        "System",
        "Sweep",
        "Affine",
        "Exponential",
        "Taylor",
        "RESULTS",
        "SolveError",
    }
    public = {name for name, x in vars(nsjax).items() if isinstance(x, type)}
    seen = {type(result).__name__ for result, *_ in CASES.values()}
    assert public - seen == others | {"sgn", "relay", "impact", "clock", "LevelSwitch"}
