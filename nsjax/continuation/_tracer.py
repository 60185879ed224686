"""Pseudo-arclength continuation, written once: a predictor along the tangent, a corrector, test functions, and the step
length. What the curve consists of is the problem that is given to it, a subclass of `AbstractTracer`."""

import abc
import dataclasses
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from ._step_length import FIRST, next_length, shortened, TURN, turn_between, TURNED


P = TypeVar("P", bound=Any)


class Zero(NamedTuple, Generic[P]):
    """The zero of a test function.

    - `s`: at which distance along the tangent at the point before.
    - `point`: the point of the curve there.
    - `others`: what else vanishes there.
    - `side`: on which side of its parameter the curve was before.
    - `marks`: whether it only marks a place, which is no point of the trace for its sake.
    - `special`: the special point that it is, if the problem finds this out at once.
    """

    s: float
    test: Any
    point: P
    others: tuple[Any, ...] = ()
    side: int = 0
    marks: bool = False
    special: Any = None


@dataclasses.dataclass(frozen=True)
class Trace(Generic[P]):
    """Points one after the other, up to one at which others may meet the curve, or where it ends. It is a value:
    `AbstractTracer.further` makes the next from it.

    - `points`: the points.
    - `begin`: a point at which it has been all round.
    - `before`: how many points of the branch came before these, of those that count for `max_points`.
    - `length`: of the next step.
    - `ahead`: points that the last step found, and that are to come: zeros, and where the step ends.
    - `at`: the zero at the last point, or the mark behind it.
    - `end`: the zero with which the trace ends.
    - `why`, `closed`: why there is no other point; whether because it has been all round.
    """

    points: tuple[P, ...]
    begin: P | None = None
    before: int = 0
    length: float = FIRST
    ahead: tuple[P | Zero[P], ...] = ()
    at: Zero[P] | None = None
    end: Zero[P] | None = None
    why: str = ""
    closed: bool = False

    @property
    def over(self) -> bool:
        return not self.ahead and bool(self.end or self.closed or self.why)

    @property
    def passed(self) -> bool:
        """Whether the curve goes on through that zero."""
        return self.at is not None and self.at is not self.end


@dataclasses.dataclass
class AbstractTracer(abc.ABC, Generic[P]):
    """Follows a curve, with steps no longer than `max_step`, relative to each unknown, up to `max_points` points.

    Its points have `u`, the unknowns, in units in which lengths along the curve are measured; `tangent`, of length one,
    in the direction in which it is followed; and `turned`, the same point for the other direction.
    """

    curve: Any
    max_step: float
    max_points: int

    aim: ClassVar[float] = TURN  # the angle between tangents
    lost: ClassVar[str] = "the last point that could be found"
    failures: ClassVar[tuple[type[Exception], ...]] = ()  # that mean that the step was too long

    @abc.abstractmethod
    def at(self, point: P, s: float) -> P | None:
        """The point at the distance `s` along the tangent of another; None if none was found."""

    @abc.abstractmethod
    def zeros(self, before: P, after: P, length: float, turned: bool) -> list[Zero[P]] | None:
        """The zeros of test functions between two points, in their order, up to the first that ends the trace; None if
        the step must be shorter for them to be told. `turned`: whether the tangents differ too much for a step."""

    @abc.abstractmethod
    def passes(self, zero: Zero[P]) -> bool:
        """Whether the curve goes on through this zero as it is."""

    @abc.abstractmethod
    def closes(self, begin: P, before: P, after: P, length: float) -> bool:
        """Whether the curve passes `begin` between two points, in the direction in which it set out there."""

    def select(self, point: P, zeros: list[Zero[P]], length: float) -> tuple[Zero[P], ...]:
        """What counts of the zeros in a step from a point, once the step is made."""
        return tuple(zeros)

    def dead_end(self, point: P) -> Zero[P] | None:
        """What the curve ends at where no step goes on; None if that is not known."""
        return None

    def further(self, trace: Trace[P]) -> Trace[P]:
        """The trace with one point more, or a mark passed, or the reason why there is none."""
        # A step may find several zeros. They come one by one, so that whoever interrupts has every point that is known.
        if not trace.ahead:
            trace = self.next_step(trace)
        if not trace.ahead:
            return trace
        here, *ahead = trace.ahead
        zero = here if isinstance(here, Zero) else None
        point = here.point if isinstance(here, Zero) else here
        points = trace.points if zero is not None and zero.marks else (*trace.points, point)
        return dataclasses.replace(trace, points=points, ahead=tuple(ahead), at=zero)

    def next_step(self, trace: Trace[P]) -> Trace[P]:
        """The next step along the tangent at the last point, as long as it can be."""
        point, count = trace.points[-1], trace.before + len(trace.points)
        if count >= self.max_points:
            return dataclasses.replace(trace, why=f"max_points = {self.max_points}")

        def attempt(length: float) -> tuple[P, float, list[Zero[P]]] | None:
            try:
                after = self.at(point, length)
                if after is None:
                    return None
                turn = float(turn_between(np.asarray(point.tangent), np.asarray(after.tangent)))
                zeros = self.zeros(point, after, length, not turn <= TURNED)
                return None if zeros is None else (after, turn, zeros)
            except self.failures:
                return None

        found = shortened(trace.length, attempt)
        if found is None:
            end = self.dead_end(point)
            return dataclasses.replace(trace, ahead=() if end is None else (end,), end=end, why=self.lost)
        length, (after, turn, between) = found
        # Only now: an attempt that was too long may have found zeros too, and to describe them is expensive.
        zeros = self.select(point, between, length)
        if zeros and not self.passes(zeros[-1]):
            return dataclasses.replace(trace, ahead=zeros, end=zeros[-1])
        # The first steps are beside the beginning anyway.
        if trace.begin is not None and count > 3 and self.closes(trace.begin, point, after, length):
            return dataclasses.replace(trace, ahead=(*zeros, trace.begin), closed=True)
        tangent, u = np.asarray(after.tangent), np.asarray(after.u)
        length = float(next_length(length, turn, tangent, u, self.max_step, self.aim))
        return dataclasses.replace(trace, ahead=(*zeros, after), length=length)
