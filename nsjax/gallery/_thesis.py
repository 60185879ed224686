"""The systems of the thesis by the number of their section, equation or example."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType

from ._block import FallingFrictionBlock, Slip, SmoothBlock, StaticPointBlock
from ._drillstring import (
    DrillstringModel,
    DrillstringScene,
    TorsionModel,
    Twist,
    TwistedWhirl,
    Whirl,
    WhirlModel,
    WhirlScene,
)
from ._entry import Entry, OrbitGuess
from ._examples import (
    AttractionSliding,
    Line,
    Plane,
    RepellingPoint,
    RepulsionSliding,
    SlidingPoint,
    StickingPoint,
    TransversalIntersection,
)
from ._fixed_points import (
    DiscontinuousHopf,
    DiscontinuousPitchfork,
    DiscontinuousSaddleNode,
    DiscontinuousTranscritical,
    DoubleHopfCrossing,
    Hopf,
    HopfPitchfork,
    ImperfectPitchfork,
    ImperfectTranscritical,
    NoCrossing,
    Pitchfork,
    Polar,
    PolarHopf,
    SaddleNode,
    SmoothHopfPitchfork,
    Space,
    Transcritical,
)
from ._forced import ForcedFriction, ForcedStickSlip
from ._motion import Motion
from ._stick_slip import FallingStickSlip, StickSlip
from ._support import DiscontinuousSupport, Trilinear
from ._table11 import BouncingBall, DryFriction, ElasticSupport


# The guesses come from simulations outside this library (scipy, the mechanical reading of the friction laws), and are
# rounded: the tests bring them back to themselves.
_ORBITS = {
    "1.1(1)": OrbitGuess(Motion(0.7975, 0.0)),  # stable, but not attracting: there is no damping
    "1.1(2)": OrbitGuess(Motion(2.582, 0.2814)),
    "2.4": OrbitGuess(Motion(1.134, 0.0), period=12.0),  # the thesis starts its shooting at x = 1.1, T = 12
    "3.4": OrbitGuess(Motion(2.02, 0.0), period=13.54),
    "3.5": OrbitGuess(Motion(1.110, 1.338)),
    "figure 5.3": OrbitGuess(Space(0.8748, 0.8748, 0.9316), period=3.872),
    "(5.25)": OrbitGuess(Plane(1.0, 0.0), period=3.1416),
    "(5.29)": OrbitGuess(Plane(1.0, 0.0), period=6.2832),
    "5.7": OrbitGuess(Plane(1.546, 0.0), period=4.031),
    "(5.40)": OrbitGuess(Plane(1.546, 0.0), period=4.033),
    "6.6": OrbitGuess(Motion(-0.9007, 0.9438)),
    "6.7": OrbitGuess(Motion(2.0, 0.0), period=12.635),
    "6.8": OrbitGuess(Motion(4.013, 1.475)),
    "6.9": OrbitGuess(Motion(0.1992, 0.4542), order=2),
    "A.8": OrbitGuess(Twist(-2.1307, 0.4496), period=6.296),
    "A.9": OrbitGuess(TwistedWhirl(0.4416, -0.2358, 1.1212, -2.5320, 0.5731), period=5.0),
}

_ENTRIES = (
    Entry("1.1(1)", "Elastic support, non-smooth continuous (Table 1.1)", ElasticSupport, y0=Motion(0.5, 0.0), t1=60.0),
    Entry("1.1(2)", "Dry friction damper, of Filippov type (Table 1.1)", DryFriction, y0=Motion(0.5, 0.5), t1=60.0),
    Entry(
        "1.1(3)", "Bouncing ball, impulsive (Table 1.1)", BouncingBall, y0=Motion(1.0, 0.0), t1=5.0
    ),  # at rest at 9 √(2 / 9.81) s = 4.06 s
    Entry("(2.3)", "Attracting point of discontinuity", SlidingPoint, y0=Line(1.0), t1=2.0),
    Entry("example 2.1", "Transversal intersection", TransversalIntersection, y0=Plane(0.0, 2.0), t1=1.0),
    Entry("example 2.2", "Attraction sliding mode", AttractionSliding, y0=Plane(0.0, 2.0), t1=1.0),
    # These two start beside the surface: from a point on it solutions are not unique.
    Entry("example 2.3", "Repulsion sliding mode", RepulsionSliding, y0=Plane(0.0, 1.25), t1=1.0),
    Entry("example 2.4", "Repelling point of discontinuity", RepellingPoint, y0=Line(0.25), t1=1.0),
    Entry("example 2.5", "A set larger than the smallest convex one", StickingPoint, y0=Line(-1.0), t1=2.0),
    Entry("(2.26)", "Block on a floor, smooth friction law (a)", SmoothBlock, y0=Slip(-1.0), t1=2.0),
    Entry("(2.28)", "Block on a floor, set-valued friction law (b)", FallingFrictionBlock, y0=Slip(-1.0), t1=2.0),
    Entry("(2.29)", "Block on a floor, static friction point (c)", StaticPointBlock, y0=Slip(-1.0), t1=2.0),
    Entry("2.4", "Stick-slip system with falling friction", FallingStickSlip, y0=Motion(1.1, 0.0), t1=36.0),
    Entry("3.4", "Stick-slip system with static friction point, undamped", StickSlip, y0=Motion(2.5, 0.0), t1=40.0),
    Entry("3.5", "Discontinuous support", DiscontinuousSupport, y0=Motion(0.5, 0.0), t1=80.0),
    Entry("5.2", "Jump of the Jacobian without a crossing (ours)", NoCrossing, y0=Plane(-0.5, 0.0), t1=10.0),
    Entry(
        "figure 5.3",
        "Discontinuous bifurcation: one pair of eigenvalues crosses twice (ours)",
        DoubleHopfCrossing,
        y0=Space(1.0, 0.0, 0.0),
        t1=20.0,
    ),
    Entry("(5.7)", "Saddle-node bifurcation, smooth", SaddleNode, y0=Line(-0.5), t1=5.0),
    Entry("(5.8)", "Saddle-node bifurcation, discontinuous", DiscontinuousSaddleNode, y0=Line(-0.5), t1=8.0),
    Entry("(5.10)", "Transcritical bifurcation, smooth", Transcritical, y0=Line(0.1), t1=10.0),
    Entry("(5.11)", "Transcritical bifurcation, discontinuous", DiscontinuousTranscritical, y0=Line(0.1), t1=10.0),
    Entry(
        "(5.15)", "Transcritical bifurcation, smoothed without symmetry", ImperfectTranscritical, y0=Line(0.1), t1=10.0
    ),
    Entry("(5.17)", "Pitchfork bifurcation, smooth", Pitchfork, y0=Line(0.1), t1=8.0),
    Entry(
        "(5.18)", "Pitchfork bifurcation, discontinuous and supercritical", DiscontinuousPitchfork, y0=Line(0.1), t1=8.0
    ),
    Entry(
        "(5.22)",
        "Pitchfork bifurcation, discontinuous and subcritical",
        partial(DiscontinuousPitchfork, mu=-1.0, alpha=1.0),
        y0=Line(0.9),
        t1=8.0,
    ),
    Entry("(5.23)", "Pitchfork bifurcation, smoothed without symmetry", ImperfectPitchfork, y0=Line(-0.2), t1=8.0),
    Entry("(5.25)", "Hopf bifurcation, smooth", Hopf, y0=Plane(0.1, 0.0), t1=20.0),
    Entry("(5.29)", "Hopf bifurcation, discontinuous", DiscontinuousHopf, y0=Plane(0.1, 0.0), t1=20.0),
    Entry(
        "(5.30)",
        "Hopf bifurcation, discontinuous, in polar coordinates",
        PolarHopf,
        y0=Polar(0.1, 0.0),
        t1=8.0,
        also=("(5.31)",),
    ),
    Entry(
        "5.7",
        "Hopf-pitchfork bifurcation of a non-smooth continuous system",
        HopfPitchfork,
        y0=Plane(0.5, 0.0),
        t1=20.0,
        also=("(5.32)", "(5.38)"),
    ),
    Entry(
        "(5.40)", "Hopf-pitchfork bifurcation, smooth approximation", SmoothHopfPitchfork, y0=Plane(0.5, 0.0), t1=20.0
    ),
    Entry("6.6", "Trilinear system: discontinuous fold", Trilinear, y0=Motion(1.1, 0.0), t1=120.0),
    Entry(
        "6.7",
        "Stick-slip system with static friction point, damped: infinitely unstable orbits",
        partial(StickSlip, c=0.1),
        y0=Motion(2.5, 0.0),
        t1=40.0,
    ),
    Entry(
        "6.8",
        "Forced vibration with dry friction: discontinuous symmetry-breaking",
        ForcedFriction,
        y0=Motion(3.0, 1.0),
        t1=100.0,
    ),
    Entry("6.9", "Forced stick-slip system: discontinuous fold-flip", ForcedStickSlip, y0=Motion(1.0, 0.0), t1=80.0),
    Entry(
        "A.7",
        "Whirl of a rotor in its stator",
        WhirlModel,
        y0=Whirl(0.9, 0.3, 0.2),
        t1=60.0,
        also=("(A.15)", "(A.16)"),
        cartesian=WhirlScene,
    ),
    Entry("A.8", "Stick-slip of a drillstring", TorsionModel, y0=Twist(1.0, 0.0), t1=60.0, also=("(A.50)",)),
    Entry(
        "A.9",
        "Stick-slip and whirl of a drillstring",
        DrillstringModel,
        y0=TwistedWhirl(0.5, 0.0, 0.3, 0.0, 0.5),
        t1=60.0,
        also=("(A.51)",),
        cartesian=DrillstringScene,
    ),
)

THESIS: Mapping[str, Entry] = MappingProxyType(
    {entry.key: dataclasses.replace(entry, orbit=_ORBITS.get(entry.key)) for entry in _ENTRIES}
)
"""The entries by key, in the order of the thesis."""
