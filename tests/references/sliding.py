"""A pendulum on a belt, and a mass on a belt with friction and a wall by scipy, from one change of mode to the next."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsjax
from nsjax.gallery import Motion


class Stribeck(nsjax.System):
    """A pendulum on a belt whose friction falls with |v_rel|, shaken."""

    mu: Array | float = 0.2898
    delta: Array | float = 1.8297
    v_b: Array | float = 0.09053
    F: Array | float = 1.0971
    omega: Array | float = 2.29

    def vector_field(self, t, y, s):
        friction = self.mu * s.belt / (1 + self.delta * jnp.abs(y.v - self.v_b))
        return Motion(y.v, -jnp.sin(y.x) + self.F * jnp.cos(self.omega * t) - friction)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_b


@dataclasses.dataclass
class SlidingMass:
    """x'' = force(t, x) - friction(|x' - belt|) s with s in Sgn(x' - belt), and impacts at x = wall.

    Pieces of the force begin and end at the `cuts`, the last of which is the end. Within a piece it must be smooth; it
    is not asked for at times outside of it, whatever rounding makes of its ends.
    """

    force: Callable[[Any, Any], Any]
    friction: Callable[[Any], Any]
    cuts: np.ndarray
    belt: float = 0.0
    wall: float = np.inf
    restitution: float = 0.6

    def run(self, x: float, v: float) -> tuple[float, np.ndarray, int]:
        """The end time, the state there, and the number of stops and impacts; it ends before an impact that may be one
        of infinitely many."""
        self.t, self.y, self.sense, events = 0.0, np.array([x, v]), np.sign(v - self.belt), 0
        for cut in self.cuts:
            self.piece = self.t + 1e-12, np.nextafter(np.nextafter(cut, 0), 0) - 1e-12
            if self.y[1] == self.belt:
                self.let_go()
            while self.t < cut:
                if self.sense == 0:
                    self.stick(cut)
                elif self.slide(cut):
                    events += 1
                    if events > 40 or not self.meet():
                        return self.t, self.y, events
        return self.t, self.y, events

    def load(self, t: Any, x: Any) -> Any:
        return self.force(np.clip(t, *self.piece), x)

    def let_go(self) -> None:
        load = self.load(self.t, self.y[0])
        self.sense = np.sign(load) if abs(load) > self.friction(0.0) else 0.0

    def stick(self, cut: float) -> None:
        begin, x = self.t, self.y[0]

        def left(t: Any) -> Any:
            return self.friction(0.0) - abs(self.load(t, x + self.belt * (t - begin)))

        ts = np.linspace(begin, cut, 400)
        fallen = [left(t) < 0 for t in ts]
        at = fallen.index(True) if any(fallen) else None
        self.t = cut if at is None else brentq(left, ts[at - 1], ts[at], xtol=1e-14) if at else begin
        self.y = np.array([x + self.belt * (self.t - begin), self.belt])
        if at is not None:
            self.sense = np.sign(self.load(ts[at], x + self.belt * (ts[at] - begin)))

    def slide(self, cut: float) -> bool:
        """Whether the belt's velocity or the wall is met before the end of the piece."""

        def field(t: float, y: np.ndarray, sense: float = self.sense) -> list[float]:
            return [y[1], self.load(t, y[0]) - self.friction(sense * (y[1] - self.belt)) * sense]

        # Of two zeros within a step, at whose end the sign is the old one again, `solve_ivp` knows nothing: the speed
        # is looked at where it is least, and the gap where the mass stops.
        falls: Any = (
            lambda t, y: (y[1] - self.belt) * self.sense,
            lambda t, y: 1.0 if self.wall == np.inf else self.wall - y[0],
            lambda t, y: -field(t, y)[1] * self.sense,
        )
        for fall, terminal in zip(falls, (True, True, False)):
            fall.terminal, fall.direction = terminal, -1
        out: Any = solve_ivp(
            field, (self.t, cut), self.y, rtol=1e-11, atol=1e-12, method="DOP853", events=falls, max_step=0.5,
            dense_output=True,
        )  # fmt: skip
        end, ended, self.at_wall = out.t[-1], out.status == 1, len(out.t_events[1]) > 0
        for fall, ends in ((falls[0], out.t_events[2]), (falls[1], [end])):
            for last in ends:
                if self.t < last <= end and fall(last, out.sol(last)) < -1e-12:
                    before = max(t for t in out.t if t < last)
                    end = brentq(lambda t, fall=fall: fall(t, out.sol(t)), before, last, xtol=1e-14)
                    ended, self.at_wall = True, fall is falls[1]
        self.y, self.t = out.sol(end), end
        return ended

    def meet(self) -> bool:
        """What follows a stop or an impact; False where impacts may accumulate."""
        if not self.at_wall:
            self.y[1] = self.belt
            self.let_go()
            return True
        if self.y[1] < 0.1:
            return False
        self.y = np.array([self.wall, -self.restitution * self.y[1]])
        self.sense = np.sign(self.y[1] - self.belt)
        return True
