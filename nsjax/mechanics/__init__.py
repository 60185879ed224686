"""Mechanical systems from a list of effects: `Scene` and what can act in it.

Geometry stands apart from law: along which distance a force acts (a coordinate, a combination, a function of q), and
which force it is.
"""

from ._contact import Contact as Contact, ContactLaw as ContactLaw, Rigid as Rigid, Viscoelastic as Viscoelastic
from ._direction import Velocity as Velocity
from ._effect import Effect as Effect, ForceElement as ForceElement, Stretch as Stretch
from ._forcing import (
    Constant as Constant,
    Forcing as Forcing,
    Harmonic as Harmonic,
    Relay as Relay,
    SquareWave as SquareWave,
)
from ._friction import Friction as Friction
from ._friction_law import (
    Characteristic as Characteristic,
    Coulomb as Coulomb,
    Cubic as Cubic,
    Falling as Falling,
    falling as falling,
    FrictionLaw as FrictionLaw,
    SmoothFalling as SmoothFalling,
    StaticPoint as StaticPoint,
    Stribeck as Stribeck,
)
from ._model import SceneModel as SceneModel
from ._rotor import FluidForce as FluidForce, stator_contact as stator_contact, TurningForce as TurningForce
from ._scene import Scene as Scene
from ._spring import (
    Backlash as Backlash,
    Damper as Damper,
    PolynomialSpring as PolynomialSpring,
    Spring as Spring,
    TrilinearSpring as TrilinearSpring,
)
from ._state import State as State
