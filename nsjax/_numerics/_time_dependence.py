"""How a function depends on time alone, read off its program: where it jumps or has kinks, and its frequencies.

The jaxpr is evaluated on descriptions in place of numbers. What is affine in time, a sawtooth (`t % T`), a sine of an
affine phase, or the absolute value of one of these is described by arrays, so that the times at which it passes a
threshold are arrays too, with derivatives by the parameters they depend on.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from ._evaluation import applied, called, Evaluation, has_programs, within
from ._jaxpr import MOVING
from ._select import select


class Sawtooth(NamedTuple):
    """(t - start) modulo a period."""

    start: Any
    period: Any
    modulus: Any = None  # of t % T the description of T


class Sine(NamedTuple):
    """sin(phase + rate t)."""

    phase: Any
    rate: Any


class Absolute(NamedTuple):
    """The absolute value of another form."""

    form: "Form"


class Form(NamedTuple):
    """offset + gain * base, where the base is the time (None) or one of the above."""

    offset: Any
    gain: Any
    base: Sawtooth | Sine | Absolute | None = None


class Wave(NamedTuple):
    """sin or cos, or if it `grows` an exponential or hyperbolic function, of a phase that is affine in time."""

    rate: Any  # of the phase
    grows: bool


class Constant(NamedTuple):
    """A value that depends neither on time nor on the state."""

    value: Any


class Timed(NamedTuple):
    """A value that depends on time alone. Between the times at which it jumps it is a polynomial in time plus `waves`;
    of `degree` None it may be any smooth function."""

    degree: int | None
    waves: tuple[Wave, ...] = ()
    form: Form | None = None

    @property
    def still(self) -> bool:
        """Whether it is constant between the times at which it jumps."""
        return self.degree == 0 and not self.waves


class _State:
    """A value that depends on the state, and perhaps on time too."""


STATE = _State()
_STILL = Timed(0)
_SMOOTH = Timed(None)


class Cycle(NamedTuple):
    """Times start + n period, and these plus offsets."""

    start: Any
    period: Any
    offsets: tuple[Any, ...]  # arrays; what does not lie between zero and the period is no offset
    modulus: Any = None  # of t % T the description of T


class TimeDependence(NamedTuple):
    """Where a program jumps or has kinks in time, and what its results are between these times."""

    times: tuple[Any, ...]  # arrays of single times; those that are not finite stand for none
    cycles: tuple[Cycle, ...]
    unknown: tuple[str, ...]  # operations that jump in time, but at times which are not known
    results: tuple[Any, ...]

    @property
    def jumps(self) -> bool:
        """Whether there are any such times."""
        return bool(self.times or self.cycles)


_COMPARISONS = frozenset("lt le gt ge lt_to le_to".split())
_EQUALITIES = frozenset("eq ne is_finite".split())
_ROUNDING = {"floor": 0.0, "ceil": 0.0, "round": 0.5, "convert_element_type": 0.0}
_ORDERING = frozenset("argmax argmin sort top_k reduce_max reduce_min cummax cummin rem".split())
_UNMOVED = frozenset("copy copy_p convert_element_type stop_gradient".split())
_LINEAR = _UNMOVED | frozenset(MOVING) | frozenset("add sub add_any neg real cumsum".split())
_JUMPING = _COMPARISONS | _ORDERING | frozenset("floor ceil round sign".split())


def time_dependence(fn: Callable[..., Any], t: Any, *args: Any, state: int = 0) -> TimeDependence:
    """How `fn(t, *args)` depends on the time `t`.

    The last `state` of the other arguments count as the state: what depends on them is left aside. The arrays of the
    answer are functions of the arguments before those.
    """
    closed = jax.make_jaxpr(fn)(t, *args)
    leaves, count = jax.tree.leaves(args), len(jax.tree.leaves(args[len(args) - state :]))
    known: list[Any] = [Constant(x) for x in leaves[: len(leaves) - count]] + [STATE] * count
    reader = _Reader(Timed(1, (), Form(jnp.zeros_like(t), jnp.ones_like(t))))
    results = reader.program(closed, [reader.time, *known])
    cycles = tuple(Cycle(base.start, base.period, tuple(at), base.modulus) for base, at in reader.cycles.values())
    return TimeDependence(tuple(reader.times), cycles, tuple(reader.unknown), tuple(results))


class Forcing(NamedTuple):
    """A function of time b of which the third derivative is -ω² times the first, for one ω: a polynomial of degree up
    to two, or a wave plus a constant."""

    rate: Any  # of the wave; None for polynomials
    grows: bool
    constant: bool  # whether it is, between the times at which it jumps

    @property
    def squared(self) -> Any:
        """ω², negative for a wave that grows."""
        return 0.0 if self.rate is None else (-1 if self.grows else 1) * self.rate**2


def forcing(results: tuple[Any, ...]) -> Forcing | None:
    """What functions of time are together, or None if they are nothing of that kind.

    All waves must have one rate that is the same number of the program: of two rates that happen to be equal the
    derivatives may differ.
    """
    timed = [v for v in results if isinstance(v, Timed)]
    if any(v is STATE for v in results) or any(v.degree is None for v in timed):
        return None
    waves = [wave for v in timed for wave in v.waves]
    if not waves:
        return Forcing(None, False, all(v.still for v in timed))
    (rate, grows), *others = waves
    alike = all(other.rate is rate and other.grows == grows for other in others)
    if not alike or jnp.ndim(rate) > 0 or any(v.degree for v in timed):
        return None
    return Forcing(rate, grows, False)


class _Reader:
    """One evaluation of a program on descriptions."""

    def __init__(self, time: Timed) -> None:
        self.time = time
        self.times: list[Any] = []
        self.cycles: dict[int, tuple[Sawtooth, list[Any]]] = {}
        self.unknown: list[str] = []
        # Equal operations on equal operands have one result, and so one sawtooth and one rate.
        self.memory: dict[Any, Any] = {}

    def program(self, closed: Any, values: list[Any]) -> list[Any]:
        program = Evaluation(closed, values, self._constant)
        for e, x in program:
            program.put(e, self.equation(e, x))
        return program.results

    def _constant(self, x: Any, aval: Any) -> Constant:
        x = x if isinstance(x, jax.Array) else np.asarray(x, aval.dtype)
        small = isinstance(x, np.ndarray) and x.size <= 16
        key = ("number", x.dtype.str, x.shape, x.tobytes()) if small else ("array", id(x))
        return self.memory.setdefault(key, Constant(x))

    def equation(self, e: Any, x: list[Any]) -> list[Any]:
        """The descriptions of the results of one operation."""
        params = id(e) if has_programs(e) else str(e.params)
        key = (e.primitive.name, params, *map(id, x))
        if key not in self.memory:
            self.memory[key] = self._described(e, x), x, e  # these are kept, so that no other object has their `id`
        return self.memory[key][0]

    def _described(self, e: Any, x: list[Any]) -> list[Any]:
        name, count = e.primitive.name, len(e.outvars)
        if all(isinstance(v, Constant) for v in x):
            return [Constant(v) for v in applied(e, [v.value for v in x])]
        inner = called(e)
        if inner is not None:
            return self._call(e, inner, x)
        if name == "cond":
            return self._branches(e, x)
        if has_programs(e):
            return self._loop(e, x)
        if any(v is STATE for v in x):
            return [STATE] * count
        return self._of_time(e, x)

    # Programs within the program.

    def _call(self, e: Any, inner: jex.ClosedJaxpr, x: list[Any]) -> list[Any]:
        name = inner.jaxpr.debug_info.func_name
        if len(x) == 2 and not any(v is STATE for v in x):
            whole = name in ("remainder", "floor_divide") and _is_real(e.invars[0].aval)
            if whole and isinstance(x[1], Constant):
                wrapped = self._wrapped(x[0], x[1])
                if wrapped is not None:
                    return [wrapped if name == "remainder" else _STILL]
            if name == "searchsorted" and isinstance(x[0], Constant) and isinstance(x[1], Timed):
                knots = jnp.asarray(x[0].value)
                self._levels(x[1], knots.reshape(knots.shape + (1,) * len(e.invars[1].aval.shape)), name)
                return [_STILL]
        return self.program(inner, x)

    def _branches(self, e: Any, x: list[Any]) -> list[Any]:
        index, operands = x[0], x[1:]
        rows = [self.program(branch, operands) for branch in e.params["branches"]]
        return [STATE if index is STATE else _either(list(column)) for column in zip(*rows)]

    def _loop(self, e: Any, x: list[Any]) -> list[Any]:
        moves = [isinstance(v, Timed) and not v.still and _is_real(a.aval) for v, a in zip(x, e.invars)]
        if any(moves) and within(e, _may_jump):
            self.unknown.append(e.primitive.name)
        if any(v is STATE for v in x):
            return [STATE] * len(e.outvars)
        return [_SMOOTH if any(moves) else _STILL] * len(e.outvars)

    # Operations on functions of time alone.

    def _of_time(self, e: Any, x: list[Any]) -> list[Any]:
        name, count = e.primitive.name, len(e.outvars)
        timed = [v for v in x if isinstance(v, Timed)]
        if name in _EQUALITIES or all(v.still for v in timed):
            return [_STILL] * count
        if name in _COMPARISONS:
            self._levels(_difference(*x), 0.0, name)
            return [_STILL]
        if name in _ROUNDING and not (name == "convert_element_type" and _is_real(e.outvars[0].aval)):
            self._steps(timed[0], _ROUNDING[name], name)
            return [_STILL]
        if name == "sign":
            self._levels(timed[0], 0.0, name)
            return [_STILL]
        if name == "abs":
            self._levels(timed[0], 0.0, name, kink=True)
            form = timed[0].form
            folded = None if form is None else Form(jnp.zeros_like(form.gain), jnp.ones_like(form.gain), Absolute(form))
            return [timed[0]._replace(form=folded)]
        if name in ("max", "min"):
            self._levels(_difference(*x), 0.0, name, kink=True)
            return [_either(x)]
        if name == "clamp":
            for bound in (x[0], x[2]):
                self._levels(_difference(x[1], bound), 0.0, name, kink=True)
            return [_either(x)]
        if name in _ORDERING:
            self.unknown.append(name)
            return [_SMOOTH] * count
        if name in _LINEAR:
            kind = _either(x)
            return [kind._replace(form=form) for form in _moved(e, x)]
        if name == "select_n":
            return [_either(x[1:])]
        return [_elementary(e, x)] * count

    # Where they jump, or have a kink.

    def _levels(self, value: Timed, levels: Any, name: str, kink: bool = False) -> None:
        """Where a value passes some levels."""
        if value.still:
            return
        if value.form is not None:
            self._passes(value.form, levels)
        elif not kink:  # a kink at an unknown time costs steps, but the control of their error sees it
            self.unknown.append(name)

    def _passes(self, form: Form, levels: Any) -> None:
        share = _quotient(levels - form.offset, form.gain)
        if form.base is None:
            self.times.append(jnp.ravel(share))
        elif isinstance(form.base, Sawtooth):
            self._offsets(form.base).append(jnp.ravel(share))
        elif isinstance(form.base, Absolute):
            for sign in (1.0, -1.0):
                self._passes(form.base.form, select(share > 0, sign * share, jnp.inf))
        else:
            inside, (phase, rate) = jnp.abs(share) < 1, form.base
            angle = jnp.arcsin(select(inside, share, 0))
            for where in (angle, np.pi - angle):
                start = select(inside, _quotient(where - phase, rate), jnp.inf)
                self._repeats(start, jnp.abs(_quotient(2 * np.pi, rate)))

    def _steps(self, value: Timed, shift: float, name: str) -> None:
        """Where a value passes the integers, or these plus `shift`."""
        if value.form is None or value.form.base is not None:
            self.unknown.append(name)
        else:
            gain = value.form.gain
            self._repeats(_quotient(shift - value.form.offset, gain), jnp.abs(_quotient(1.0, gain)))

    def _repeats(self, starts: Any, periods: Any) -> None:
        for start, period in zip(*map(jnp.ravel, jnp.broadcast_arrays(starts, periods))):
            self._offsets(Sawtooth(start, period))

    def _offsets(self, base: Sawtooth) -> list[Any]:
        return self.cycles.setdefault(id(base), (base, []))[1]

    def _wrapped(self, x: Any, y: Constant) -> Timed | None:
        """x modulo y, of one number x that is affine in time."""
        if not isinstance(x, Timed) or x.form is None or x.form.base is not None or jnp.ndim(x.form.gain):
            return None
        size, gain = jnp.asarray(y.value, x.form.gain.dtype), x.form.gain
        if size.ndim:
            return None
        key = ("wrapped", id(x), id(y))
        if key not in self.memory:
            start, period = _quotient(-x.form.offset, gain), jnp.abs(_quotient(size, gain))
            self.memory[key] = Sawtooth(start, period, y if x is self.time else None), x, y
        base = self.memory[key][0]
        self._offsets(base)
        # Where x falls and y is above zero it falls from y to zero.
        return Timed(1, (), Form(select(gain * size < 0, size, jnp.zeros_like(size)), gain, base))


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _may_jump(e: Any) -> bool:
    """Whether an operation compares or rounds real numbers."""
    return e.primitive.name in _JUMPING and any(_is_real(v.aval) for v in e.invars)


def _quotient(a: Any, b: Any) -> Any:
    """a / b, or infinity for b = 0, with finite derivatives."""
    b = jnp.asarray(b)
    return select(b == 0, jnp.inf, a / select(b == 0, 1, b))


def _either(values: list[Any]) -> Any:
    """What may be any of these, or their sum."""
    if any(v is STATE for v in values):
        return STATE
    timed = [v if isinstance(v, Timed) else _STILL for v in values]
    degrees = [v.degree for v in timed]
    degree = None if None in degrees else max((d for d in degrees if d is not None), default=0)
    return Timed(degree, tuple(wave for v in timed for wave in v.waves))


def _form(v: Any) -> Form | None:
    return v.form if isinstance(v, Timed) else Form(jnp.asarray(v.value), 0.0)


def _combined(a: Any, b: Any, sign: float) -> Form | None:
    """The form of a ± b."""
    left, right = _form(a), _form(b)
    if left is None or right is None:
        return None
    if not isinstance(b, Timed):  # the same gain, and not one that is equal
        return Form(left.offset + sign * right.offset, left.gain, left.base)
    if isinstance(a, Timed) and left.base is not right.base:
        return None
    gain = right.gain if not isinstance(a, Timed) and sign == 1 else left.gain + sign * right.gain
    return Form(left.offset + sign * right.offset, gain, right.base)


def _difference(a: Any, b: Any) -> Timed:
    return _either([a, b])._replace(form=_combined(a, b, -1.0))


def _shaped(form: Form | None, e: Any) -> Form | None:
    """With arrays of the shape of the operation's result."""
    shape = e.outvars[0].aval.shape

    def filled(a: Any) -> Any:
        return a if jnp.shape(a) == shape else jnp.broadcast_to(a, shape)

    return None if form is None else form._replace(offset=filled(form.offset), gain=filled(form.gain))


def _moved(e: Any, x: list[Any]) -> list[Form | None]:
    """The forms of a sum, or of entries that are moved or repeated."""
    name = e.primitive.name
    none: list[Form | None] = [None] * len(e.outvars)
    if name in ("add", "add_any", "sub"):
        return [_shaped(_combined(x[0], x[1], -1.0 if name == "sub" else 1.0), e)]
    forms = [form for form in map(_form, x) if form is not None]
    if len(forms) < len(x):
        return none
    first = forms[0]
    if name == "neg":
        return [first._replace(offset=-first.offset, gain=-first.gain)]
    if name in _UNMOVED:
        return [first]
    # A base may have entries of its own, which do not move along.
    whole = all(jnp.ndim(a) == 0 for form in forms for a in jax.tree.leaves(form.base))
    alike = len(forms) == 1 or not any(form.base for form in forms)
    if not (whole and alike) or name not in MOVING or name in ("pad", "reduce_sum"):
        return none
    shapes = [v.aval.shape for v in e.invars]

    def moved(part: str) -> list[Any]:
        return applied(e, [jnp.broadcast_to(getattr(f, part), s) for f, s in zip(forms, shapes)])

    if name in ("broadcast_in_dim", "reshape", "squeeze") and shapes[0] == e.outvars[0].aval.shape:
        return [first]  # the same arrays, and not some that are equal
    return [Form(offset, gain, first.base) for offset, gain in zip(moved("offset"), moved("gain"))]


def _elementary(e: Any, x: list[Any]) -> Timed:
    """A product or an elementary function."""
    name, first = e.primitive.name, x[0]
    still = [isinstance(v, Constant) or v.still for v in x]
    if name == "mul" and any(still) or name == "div" and still[1]:
        factor, other = (x[1], x[0]) if still[1] else (x[0], x[1])
        form = other.form
        if isinstance(factor, Constant) and form is not None:
            by = 1 / jnp.asarray(factor.value) if name == "div" else factor.value
            form = _shaped(form._replace(offset=form.offset * by, gain=form.gain * by), e)
        else:
            form = None
        return other._replace(form=form)
    if name in ("dot_general", "dynamic_slice", "gather") and sum(still) >= len(x) - 1:
        return _either(x)
    square = name == "mul" or name == "square" or (name == "integer_pow" and e.params["y"] == 2)
    if square and all(isinstance(v, Timed) and v.degree == 1 and not v.waves for v in x):
        return Timed(2)
    form = first.form if isinstance(first, Timed) and first.degree == 1 and not first.waves else None
    if form is None or isinstance(form.base, Absolute):
        return _SMOOTH
    if name in ("sin", "cos"):
        phase = form.offset + (np.pi / 2 if name == "cos" else 0.0)
        one = jnp.ones_like(form.gain)
        sine = None if form.base else Form(jnp.zeros_like(one), one, Sine(phase, form.gain))
        return Timed(0, (Wave(form.gain, False),), sine)
    return Timed(0, (Wave(form.gain, True),)) if name in ("exp", "sinh", "cosh") else _SMOOTH
