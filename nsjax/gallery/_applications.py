"""Systems beyond the thesis, each with a number that is known of it: what to compare with, and what to start from."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..mechanics import Backlash, Constant, Damper, Falling, Friction, Harmonic, Scene, SceneModel, Spring
from ..mechanics._state import coordinates_type, State
from ..system._clock import clock
from ..system._impact import impact
from ..system._relay import relay
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._entry import Entry, OrbitGuess
from ._motion import Motion


class BlockChain(SceneModel):
    """A chain of n blocks on a moving belt, the model of Burridge and Knopoff (1967) with static friction points.

        m x_i'' = -k x_i + k_c (x_{i-1} - 2 x_i + x_{i+1}) - F_slip s_i,    s_i in Sgn(x_i' - v_dr)

    (The first and the last block have one neighbour.) It shows what many switches cost. Blocks that start alike move
    alike, as the system of section 3.4 does, with its period 10 + π + 2 arctan(1/5).
    """

    n: int = 3  # number of blocks
    m: float = 1.0  # mass of a block [kg]
    k: float = 1.0  # stiffness to the ground [N/m]
    k_c: float = 0.5  # stiffness between neighbours [N/m]
    v_dr: float = 0.2  # belt velocity [m/s]
    F_slip: float = 1.0  # friction force in slip [N]
    F_stick: float = 2.0  # maximum static friction force [N]

    @property
    def scene(self) -> Scene:
        names = [f"x{i}" for i in range(1, self.n + 1)]
        ground = {f"ground{i}": Spring(name, k=self.k) for i, name in enumerate(names, 1)}
        pairs = enumerate(zip(names, names[1:]), 1)
        between = {f"spring{i}": Spring({a: 1, b: -1}, k=self.k_c) for i, (a, b) in pairs}
        belts = {
            f"belt{i}": Friction(name, v=self.v_dr, slip=self.F_slip, stick=self.F_stick)
            for i, name in enumerate(names, 1)
        }
        masses, units = dict.fromkeys(names, self.m), dict.fromkeys(names, "m")
        return Scene(masses, units=units, **ground, **between, **belts)


class Pad(NamedTuple):
    """State of a brake pad."""

    x: Number  # displacement along the disc [m]
    y: Number  # displacement towards the disc [m]
    v: Number  # velocity along the disc [m/s]
    w: Number  # velocity towards the disc [m/s]


class BrakePad(System):
    """Brake squeal by mode coupling: a pad on a disc whose friction force grows as it is pressed on; after Hoffmann,
    Fischer, Allgaier and Gaul (2002), with their stiffnesses.

        m x'' + c x' + k_xx x + k_xy y = -μ (N_0 + k_n y) s,    s in Sgn(x' - v_dr)
        m y'' + c y' + k_xy x + k_yy y = 0

    It shows that friction which does not fall with the velocity can excite: steady sliding loses its stability in a
    Hopf bifurcation at μ = (k_xy + c² (k_xx + k_yy) / (2 m k_xy)) / k_n for k_xx = k_yy, at the angular frequency
    √((k_xx + k_yy) / (2 m)). (The pad is taken to stay on the disc: N_0 + k_n y > 0.)
    """

    m: float = 1.0  # mass [kg]
    c: float = 0.1  # damping [N s/m]
    k_xx: float = 2.0  # stiffness [N/m]
    k_xy: float = 1.0  # stiffness [N/m]
    k_yy: float = 2.0  # stiffness [N/m], that of the contact included
    k_n: float = 4 / 3  # stiffness of the contact [N/m]
    N_0: float = 10.0  # force by which the pad is pressed on [N]
    mu: float = 0.8  # friction coefficient
    v_dr: float = 1.0  # velocity of the disc [m/s]

    def vector_field(self, t: Scalar, y: Pad, s: SwitchValues) -> Pad:
        friction = -self.mu * (self.N_0 + self.k_n * y.y) * s.disc
        along = friction - self.c * y.v - self.k_xx * y.x - self.k_xy * y.y
        across = -self.c * y.w - self.k_xy * y.x - self.k_yy * y.y
        return Pad(y.v, y.w, along / self.m, across / self.m)

    @sgn
    def disc(self, t: Scalar, y: Pad) -> Number:
        return y.v - self.v_dr


class GearPair(SceneModel):
    """Gear rattle: two gears with play between their teeth, driven by a mean load and the error of transmission.

        m d'' + c d' + mesh(d) = F_m + F_a cos(ω t),    mesh(d) = k (d - b) for d > b, k (d + b) for d < -b, else 0

    It shows when teeth part: with r = ω √(m/k), the response to a small F_a is that of the closed mesh until
    F_a = F_m √((1 - r²)² + (c ω / k)²), where its amplitude is the static deflection F_m / k. Below it gears that
    rattle already go on doing so, down to a fold.
    """

    m: float = 1.0  # reduced mass [kg]
    c: float = 0.1  # damping [N s/m]
    k: float = 1.0  # stiffness of the mesh [N/m]
    b: float = 1.0  # half of the play [m]
    F_m: float = 0.25  # mean force on the teeth [N]
    F_a: float = 0.2  # amplitude of the force [N]
    omega: float = 0.7  # angular frequency of the mesh [rad/s]

    @property
    def scene(self) -> Scene:
        return Scene(
            {"d": self.m},
            units={"d": "m"},
            mesh=Backlash("d", k_f=self.k, x_c=self.b),
            damper=Damper("d", c=self.c),
            load=Constant("d", self.F_m),
            error=Harmonic("d", f_0=self.F_a, omega=self.omega),
        )


class Clutch(SceneModel):
    """Clutch judder: a disc on a shaft that is pressed against a flywheel; the friction torque falls with the velocity.

        J θ'' + c θ' + k θ = -T_0 s / (1 + δ |w|),    w = θ' - ω,    s in Sgn(w)

    It shows how falling friction excites, and when it does not: steady slip is stable above the slip velocity
    ω = (√(T_0 δ / c) - 1) / δ, a Hopf point with the angular frequency √(k/J).
    """

    J: float = 1.0  # moment of inertia [kg m²]
    k: float = 1.0  # torsional stiffness of the shaft [N m/rad]
    c: float = 0.1  # damping [N m s/rad]
    T_0: float = 1.0  # friction torque at rest [N m]
    delta: float = 3.0  # fall of the friction torque with the velocity [s/rad]
    omega: float = 1.0  # angular velocity of the flywheel [rad/s]

    @property
    def scene(self) -> Scene:
        return Scene(
            {"theta": self.J},
            units={"theta": "rad"},
            shaft=Spring("theta", k=self.k),
            damper=Damper("theta", c=self.c),
            disc=Friction("theta", Falling(self.T_0, self.delta), v=self.omega),
        )


class Charge(NamedTuple):
    """State of a converter."""

    v: Number  # voltage of the capacitor [V]
    i: Number  # current of the inductor [A]


class BuckConverter(System):
    """A voltage-controlled DC-DC buck converter, with the values of Hamill and Deane (1992): its transistor conducts
    while the control voltage lies below a sawtooth.

        C v' = i - v / R,    L i' = u V_in - v,    u = (1 - s)/2,    s in Sgn(a (v - V_ref) - sawtooth(t))

    It shows switches of time: a `clock` tells when the sawtooth falls. Its orbit of one period flips at
    V_in = 24.5166 V on its way to chaos.
    """

    R: float = 22.0  # load [Ω]
    L: float = 20e-3  # inductance [H]
    C: float = 47e-6  # capacity [F]
    V_in: float = 22.0  # voltage of the source [V]
    V_ref: float = 11.3  # reference [V]
    gain: float = 8.4  # a, of the controller
    V_low: float = 3.8  # where the sawtooth begins [V]
    V_high: float = 8.2  # where it ends [V]
    T: float = 400e-6  # its period [s]

    def vector_field(self, t: Scalar, y: Charge, s: SwitchValues) -> Charge:
        conducts = 0.5 * (1 - s.comparator)
        return Charge((y.i - y.v / self.R) / self.C, (self.V_in * conducts - y.v) / self.L)

    @clock
    def carrier(self) -> Number:
        return self.T

    @sgn
    def comparator(self, t: Scalar, y: Charge) -> Number:
        sawtooth = self.V_low + (self.V_high - self.V_low) * (t / self.T % 1.0)
        return self.gain * (y.v - self.V_ref) - sawtooth

    @property
    def period(self) -> Float[Array, ""] | float:
        return self.T


class RelayServo(System):
    """A motor that a relay with hysteresis reverses.

        x' = v,    τ v' = -v + (2 u - 1) K,    u goes to 1 where x falls below -h, to 0 where x rises above h

    It shows memory: the limit cycle is symmetric, and its half period p is the root of p - 2 τ tanh(p / (2 τ)) = 2 h/K.
    """

    tau: float = 1.0  # time constant of the motor [s]
    K: float = 1.0  # its velocity at full voltage [rad/s]
    h: float = 0.1  # half of the hysteresis [rad]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        return Motion(y.v, ((2 * s.motor - 1) * self.K - y.v) / self.tau)

    @relay
    def motor(self, t: Scalar, y: Motion) -> Number:
        return -self.h - y.x

    @motor.off
    def motor(self, t: Scalar, y: Motion) -> Number:
        return y.x - self.h


class Potential(NamedTuple):
    """State of a neuron."""

    V: Number  # membrane potential, as a part of the threshold


class Neuron(System):
    """A leaky integrate-and-fire neuron, whose potential is reset when it reaches the threshold (Lapicque 1907).

        τ V' = I - V,    V -> V_r at V = V_th

    It shows a `reset` of one's own. For I > V_th it fires periodically, each τ ln((I - V_r)/(I - V_th)).
    """

    tau: float = 1.0  # time constant of the membrane [s]
    I: float = 1.5  # current times the resistance of the membrane, in thresholds
    V_th: float = 1.0  # threshold
    V_r: float = 0.0  # potential after a spike

    def vector_field(self, t: Scalar, y: Potential, s: SwitchValues) -> Potential:
        return Potential((self.I - y.V) / self.tau)

    @impact
    def spike(self, t: Scalar, y: Potential) -> Number:
        return self.V_th - y.V

    @spike.reset
    def spike(self, t: Scalar, y: Potential) -> Potential:
        return Potential(jnp.zeros_like(y.V) + self.V_r)


def _at(**q: float) -> State:
    """At rest, by the coordinates of a scene. (A scene has its masses checked by JAX, which then begins to compute, and
    importing nsjax leaves it to the user to say on what devices.)"""
    kind = coordinates_type(tuple(q))
    return State(kind(**q), kind(*[0.0] * len(q)))


_ENTRIES = (
    Entry(
        "block chain",
        "Chain of blocks on a belt",
        BlockChain,
        y0=_at(x1=2.0, x2=1.5, x3=1.0),
        t1=60.0,
    ),
    Entry("brake squeal", "Pad of a brake, by mode coupling", BrakePad, y0=Pad(4.0, -2.0, 0.0, 0.0), t1=200.0),
    Entry("gear rattle", "Pair of gears with play", GearPair, y0=_at(d=1.25), t1=120.0),
    Entry("clutch judder", "Disc of a clutch", Clutch, y0=_at(theta=0.1), t1=120.0),
    Entry(
        "buck converter",
        "DC-DC converter with a clocked comparator",
        BuckConverter,
        y0=Charge(12.0, 0.55),
        t1=0.02,
        orbit=OrbitGuess(Charge(12.0, 0.6)),
    ),
    Entry(
        "relay servo",
        "Motor that a relay with hysteresis reverses",
        RelayServo,
        y0=Motion(0.0, 0.4),
        t1=20.0,
        orbit=OrbitGuess(Motion(0.0, 0.5), period=3.3),
    ),
    Entry(
        "neuron",
        "Leaky integrate-and-fire neuron",
        Neuron,
        y0=Potential(0.0),
        t1=8.0,
        orbit=OrbitGuess(Potential(0.3), period=1.1),
    ),
)

APPLICATIONS: Mapping[str, Entry] = MappingProxyType({entry.key: entry for entry in _ENTRIES})
"""Systems beyond the thesis by name."""
