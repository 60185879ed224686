"""Every system of Leine's thesis (2000), ready to run, and some beyond it.

`thesis("6.6")` is the system of section 6.6 with the values of Appendix C; `THESIS` lists them all. `APPLICATIONS` are
systems beyond the thesis, each with a number that is known of it: `BrakePad`, `Neuron`, ...
"""

from ._applications import (
    APPLICATIONS as APPLICATIONS,
    BlockChain as BlockChain,
    BrakePad as BrakePad,
    BuckConverter as BuckConverter,
    Charge as Charge,
    Clutch as Clutch,
    GearPair as GearPair,
    Neuron as Neuron,
    Pad as Pad,
    Potential as Potential,
    RelayServo as RelayServo,
)
from ._block import (
    FallingFrictionBlock as FallingFrictionBlock,
    Slip as Slip,
    SmoothBlock as SmoothBlock,
    StaticPointBlock as StaticPointBlock,
)
from ._catalogue import entry as entry, SYSTEMS as SYSTEMS, thesis as thesis
from ._drillstring import (
    DrillstringModel as DrillstringModel,
    DrillstringScene as DrillstringScene,
    EccentricDrillstringScene as EccentricDrillstringScene,
    FreeDrillstringScene as FreeDrillstringScene,
    TorsionModel as TorsionModel,
    Twist as Twist,
    TwistedWhirl as TwistedWhirl,
    Whirl as Whirl,
    WhirlModel as WhirlModel,
    WhirlScene as WhirlScene,
)
from ._entry import Entry as Entry, OrbitGuess as OrbitGuess
from ._examples import (
    AttractionSliding as AttractionSliding,
    Line as Line,
    Plane as Plane,
    RepellingPoint as RepellingPoint,
    RepulsionSliding as RepulsionSliding,
    SlidingPoint as SlidingPoint,
    StickingPoint as StickingPoint,
    TransversalIntersection as TransversalIntersection,
)
from ._fixed_points import (
    DiscontinuousHopf as DiscontinuousHopf,
    DiscontinuousPitchfork as DiscontinuousPitchfork,
    DiscontinuousSaddleNode as DiscontinuousSaddleNode,
    DiscontinuousTranscritical as DiscontinuousTranscritical,
    DoubleHopfCrossing as DoubleHopfCrossing,
    Hopf as Hopf,
    HopfPitchfork as HopfPitchfork,
    ImperfectPitchfork as ImperfectPitchfork,
    ImperfectTranscritical as ImperfectTranscritical,
    NoCrossing as NoCrossing,
    Pitchfork as Pitchfork,
    Polar as Polar,
    PolarHopf as PolarHopf,
    SaddleNode as SaddleNode,
    SmoothHopfPitchfork as SmoothHopfPitchfork,
    Space as Space,
    Transcritical as Transcritical,
)
from ._forced import ForcedFriction as ForcedFriction, ForcedStickSlip as ForcedStickSlip
from ._motion import Motion as Motion
from ._stick_slip import FallingStickSlip as FallingStickSlip, StickSlip as StickSlip
from ._support import DiscontinuousSupport as DiscontinuousSupport, Trilinear as Trilinear
from ._table11 import BouncingBall as BouncingBall, DryFriction as DryFriction, ElasticSupport as ElasticSupport
from ._thesis import THESIS as THESIS
