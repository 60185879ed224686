"""One crossing of the imaginary axis, or of the unit circle, by an eigenvalue of a set-valued matrix."""

from typing import Any, NamedTuple

from .._numerics._text import shown


@shown
class EigenvalueCrossing(NamedTuple):
    """A place at which an eigenvalue meets the imaginary axis, or a multiplier the unit circle.

    - `q`: where: a number in [0, 1], or `(q1, q2)` where two surfaces meet.
    - `eigenvalue`: exactly on the axis or circle. Of a complex pair, which counts as one crossing, that with the
        positive imaginary part.
    - `multiplicity`: algebraic, of this eigenvalue at `q`.
    - `direction`: +1 if there are more unstable eigenvalues after `q` than before, -1 if fewer, 0 if as many: the path
        touches the axis, or one crosses each way.
    - `unstable`: how many eigenvalues (both of a pair) lie right of the axis, or outside the circle, before and after.
    - `until`: `q` itself; or, for an eigenvalue that stays on the axis (a free motion, an undamped oscillation, the
        trivial multiplier 1), where that ends. Then `eigenvalue` is one on the way, and `direction` and `unstable` tell
        what happens where it arrives on the axis and where it leaves.
    """

    q: Any
    eigenvalue: complex
    multiplicity: int
    direction: int
    unstable: tuple[int, int]
    until: Any

    @property
    def kind(self) -> str:
        """ "zero" or "pair", of multipliers "+1", "-1" or "pair"."""
        names: dict[complex, str] = {0j: "zero", 1 + 0j: "+1", -1 + 0j: "-1"}
        return names.get(self.eigenvalue, "pair")

    def __str__(self) -> str:
        def place(q: Any) -> str:
            return f"({q[0]:.10g}, {q[1]:.10g})" if isinstance(q, tuple) else f"{q:.10g}"

        where = place(self.q) + (f" to {place(self.until)}" if self.until != self.q else "")
        z, pair = self.eigenvalue, self.kind == "pair"
        value = f"{'' if z.real == 0 else f'{z.real:.10g} '}±{'' if z.real == 0 else ' '}{z.imag:.10g}i"
        times = f" ({self.multiplicity} times)" if self.multiplicity > 1 else ""
        value = value if pair else f"{z.real:.10g}"
        return f"q = {where}: eigenvalue {value}{times}, unstable {self.unstable[0]} -> {self.unstable[1]}"
