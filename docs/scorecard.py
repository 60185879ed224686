"""The page docs/scorecard.md: `python docs/scorecard.py` computes it anew (three minutes on one core).

The table is that of `python -m nsjax scorecard`, `nsjax/_cli/_scorecard.py`. `tests/claims/test_scorecard.py` checks
the page.
"""

import pathlib

import jax

from nsjax import gallery
from nsjax._cli._scorecard import (
    AGREES,
    EQUILIBRIA,
    nearest,
    Number,
    NUMBERS,
    ORBITS,
    Point,
    POINTS,
    special_points as special_points,
    written,
)


HERE = pathlib.Path(__file__).parent
PAGE = HERE / "scorecard.md"
__all__ = ["AGREES", "EQUILIBRIA", "ORBITS"]


def number_row(row: Number, found: float) -> str:
    cells = row.where, row.what, row.thesis, written(found), f"{written(row.known)} ({row.by})", row.remark
    return f"| {' | '.join(cells)} |"


def point_row(row: Point, value: float, name: str) -> str:
    return f"| {' | '.join((row.where, row.thesis, name, written(value), written(row.known), row.remark))} |"


def system_row(entry: gallery.Entry) -> str:
    return f"| {entry.key} | {entry.title} | `{type(entry.system()).__name__}` |"


PROSE = """\
# Scorecard

What R. I. Leine's thesis (2000) states, what nsjax finds, and what is known independently of both.
`python -m nsjax scorecard` computes it anew. Made by `docs/scorecard.py`, checked by
`tests/claims/test_scorecard.py`. Not complete yet: numbers that can only be read off figures, and most of A.9, are left
out.

## Numbers

| where | what | thesis | nsjax | independently | |
|---|---|---|---|---|---|
{numbers}

## Bifurcations

Values are those of μ [-], of ω [rad/s], in section 6.7 of v_dr [m/s]. Those of chapter 6 were computed in 40-digit
arithmetic from exact arcs (section 6.9: Taylor series), those of chapter 5 are zero by construction, those of
Appendix A are closed forms or roots in 30 digits, of A.8 from an integration by scipy.

| where | thesis | nsjax | value by nsjax | independently | |
|---|---|---|---|---|---|
{points}

## Readings

Where the thesis can be read in several ways, or contradicts itself, these are the readings with which its orbits exist.

* Static friction (sections 3.4, 6.7, 6.8): sticking ends only when the force that is needed exceeds F_stick, although
  the force in slip is F_slip. With the convex hull of ±F_slip alone the orbits of 3.4 and 6.7 do not exist.
* Amplitudes in Figs. 6.12 to 6.21 are max |x| over a period.
* At ω_A of Fig. 6.12 the multipliers jump in angle only; Fig. 6.13 shows their modulus and so nothing there.
* (A.5) has no damping, but Appendix C.6 lists c_b. With F_bN = max(0, k_b (r - R_c) + c_b r') the figures of A.9 come
  out; that is the gallery's default.

## Systems

All that have a number in the thesis and stand in the gallery, with the values of Appendix C where it has any.

| number | system | class |
|---|---|---|
{systems}
"""


def page() -> str:
    return PROSE.format(
        numbers="\n".join(number_row(row, row.found()) for row in NUMBERS),
        points="\n".join(point_row(row, *nearest(row)) for row in POINTS),
        systems="\n".join(map(system_row, gallery.THESIS.values())),
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
