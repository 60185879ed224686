"""Periodic orbits a second with AUTO-07p: the trilinear system of section 6.6, continued in ω over (1.15, 1.25).

    python benchmarks/peers_auto.py

AUTO knows no events. Its user writes the orbit as a boundary value problem in as many pieces as it has segments, each
scaled to [0, 1]: the unknowns are the states of all pieces beside each other, their durations and the time of the first
event; the conditions are that pieces join, that each ends on its surface, and that the durations add up to the period.

What its user must know:

- Which segments there are, in which order, and an orbit to start from: AUTO finds neither, and a branch on which a
  segment appears or disappears (a grazing) ends there unnoticed, with a contact that pulls or a duration below 0.
- The orbits of this branch are odd: x(t + π/ω) = -x(t). Who knows that halves the problem (`pieces` = 2).
- A forced problem is a state more, the scaled time: the right-hand side is not told where on the mesh it is.
- `IPS = 4` gives no Floquet multipliers.
- fort.7 and fort.8 hold eleven digits; the routine for output (PVLS) is left to write the others.
- The first point is the initial guess as it was handed over, not corrected.
- The error named below is that at the ends of the pieces, where collocation is of order 2 NCOL; between the points of
  the mesh it is of order NCOL + 1 and larger by orders of magnitude.
"""

import argparse
import math
import os
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


M, C, K, X_C, K_F, C_F, F_0 = 1.0, 0.05, 1.0, 1.0, 4.0, 0.5, 0.2
GUESS = (1.12861, 0.950751, 2.03004)  # at ω = 1.2: v where contact with x > 0 begins, how long it lasts, phase ω t
OMEGA = (1.15, 1.25)

EQUATIONS = f"""
! Pieces: contact with x > x_c, free, contact with x < -x_c, free. Half the orbit: the first two of them.
! U: (x, v) of each piece, the scaled time. PAR: omega, durations of the pieces, time at which the first one begins.

module model
  implicit none
  double precision, parameter :: m = {M}d0, c = {C}d0, k = {K}d0, x_c = {X_C}d0
  double precision, parameter :: k_f = {K_F}d0, c_f = {C_F}d0, f_0 = {F_0}d0, pi = 3.141592653589793238462643d0
contains
  pure double precision function side(i)  ! of the support: 1, 0, -1, 0
    integer, intent(in) :: i
    side = merge(dble(2 - i), 0d0, mod(i, 2) == 1)
  end function
end module

subroutine FUNC(NDIM, U, ICP, PAR, IJAC, F, DFDU, DFDP)
  use model
  implicit none
  integer, intent(in) :: NDIM, ICP(*), IJAC
  double precision, intent(in) :: U(NDIM), PAR(*)
  double precision, intent(out) :: F(NDIM)
  double precision, intent(inout) :: DFDU(NDIM, NDIM), DFDP(NDIM, *)
  double precision omega, t, duration, x, v, stiffness, damping, slope
  integer i, n, a, b
  n = (NDIM - 1) / 2
  omega = PAR(1)
  if (IJAC /= 0) DFDU = 0d0
  if (IJAC == 2) DFDP(:, :n + 2) = 0d0
  do i = 1, n
    a = 2 * i - 1
    b = 2 * i
    x = U(a)
    v = U(b)
    duration = PAR(1 + i)
    t = PAR(n + 2) + sum(PAR(2:i)) + duration * U(NDIM)
    stiffness = k + k_f * abs(side(i))
    damping = c + c_f * abs(side(i))
    F(a) = duration * v
    F(b) = duration * (f_0 * sin(omega * t) - damping * v - stiffness * x + k_f * x_c * side(i)) / m
    if (IJAC == 0) cycle
    slope = duration * f_0 * cos(omega * t) / m
    DFDU(a, b) = duration
    DFDU(b, a) = -duration * stiffness / m
    DFDU(b, b) = -duration * damping / m
    DFDU(b, NDIM) = slope * omega * duration
    if (IJAC == 1) cycle
    DFDP(b, 1) = slope * t
    DFDP(b, 2:i) = slope * omega
    DFDP(a, 1 + i) = v
    DFDP(b, 1 + i) = F(b) / duration + slope * omega * U(NDIM)
    DFDP(b, n + 2) = slope * omega
  end do
  F(NDIM) = 1d0
end subroutine

subroutine BCND(NDIM, PAR, ICP, NBC, U0, U1, FB, IJAC, DBC)
  use model
  implicit none
  integer, intent(in) :: NDIM, ICP(*), NBC, IJAC
  double precision, intent(in) :: PAR(*), U0(NDIM), U1(NDIM)
  double precision, intent(out) :: FB(NBC)
  double precision, intent(inout) :: DBC(NBC, *)
  double precision after
  integer i, n, a, e
  n = (NDIM - 1) / 2
  if (IJAC /= 0) DBC(:, :2 * NDIM + n + 2) = 0d0
  do i = 1, n
    ! A piece joins the next; the last one joins the first, which is the other half's mirror image if there are two.
    a = 2 * i - 1
    e = merge(1, a + 2, i == n)
    after = merge(-1d0, 1d0, i == n .and. n == 2)
    FB(a:a + 1) = U1(a:a + 1) - after * U0(e:e + 1)
    if (IJAC == 0) cycle
    DBC(a, NDIM + a) = 1d0
    DBC(a + 1, NDIM + a + 1) = 1d0
    DBC(a, e) = -after
    DBC(a + 1, e + 1) = -after
  end do
  do i = 1, n, 2
    ! A contact begins at the support and ends where its force vanishes.
    a = 2 * i - 1
    e = 2 * n + i
    FB(e) = U0(a) - side(i) * x_c
    FB(e + 1) = k_f * (U1(a) - side(i) * x_c) + c_f * U1(a + 1)
    if (IJAC == 0) cycle
    DBC(e, a) = 1d0
    DBC(e + 1, NDIM + a) = k_f
    DBC(e + 1, NDIM + a + 1) = c_f
  end do
  FB(NBC - 1) = sum(PAR(2:n + 1)) - pi * n / (2 * PAR(1))
  FB(NBC) = U0(NDIM)
  if (IJAC == 0) return
  DBC(NBC - 1, 2 * NDIM + 2:2 * NDIM + n + 1) = 1d0
  DBC(NBC - 1, 2 * NDIM + 1) = pi * n / (2 * PAR(1)**2)
  DBC(NBC, NDIM) = 1d0
end subroutine

subroutine STPNT(NDIM, U, PAR, T)
  implicit none
  integer, intent(in) :: NDIM
  double precision, intent(inout) :: U(NDIM), PAR(*)
  double precision, intent(in) :: T
  open (31, file='start.par')
  read (31, *) PAR(1:(NDIM - 1) / 2 + 2)
  close (31)
end subroutine

subroutine PVLS(NDIM, U, PAR)
  implicit none
  integer, intent(in) :: NDIM
  double precision, intent(in) :: U(NDIM)
  double precision, intent(inout) :: PAR(*)
  double precision, external :: GETP
  logical, save :: first = .true.
  integer i
  if (first) open (32, file='points.bin', access='stream', form='unformatted', status='replace')
  first = .false.
  write (32) PAR(1:(NDIM - 1) / 2 + 2), (GETP('BV0', i, U), i = 1, NDIM - 1)
end subroutine

subroutine ICND
end subroutine

subroutine FOPT
end subroutine
"""


class Result(NamedTuple):
    points: int  # of the long run
    per_second: float  # points a second of processor time, compilation and start apart
    error: float  # largest of all orbits, in the states at all events, the time of the first and the durations
    omega: tuple[float, float]  # the interval it came through


# ω of shape (n,) -> (n, 3): v where contact with x > 0 begins, how long it lasts, the time t at which it begins.
Reference = Callable[[np.ndarray], np.ndarray]


def directory() -> Path | None:
    """Where AUTO-07p is installed, or None; None also without gfortran, which it needs for every problem."""
    # Debian's /usr/bin/auto-07p only starts Python: its objects are elsewhere.
    tools = [shutil.which(name) for name in ("auto-07p", "auto")]
    beside = [str(Path(tool).resolve().parents[1]) for tool in tools if tool]
    for place in (os.environ.get("AUTO_DIR"), "/usr/lib/auto-07p" if any(tools) else None, *beside):
        if place and (Path(place) / "lib" / "main.o").exists() and shutil.which("gfortran"):
            return Path(place)
    return None


def piece(omega: np.ndarray, contact: bool) -> np.ndarray:
    """Matrices of the linear equations of (x, v, sin ωt, cos ωt, 1) in free flight or in contact with x > x_c."""
    a = np.zeros((*omega.shape, 5, 5))
    a[..., 0, 1] = 1.0
    a[..., 1, :] = np.array([-K - contact * K_F, -C - contact * C_F, F_0, 0.0, contact * K_F * X_C]) / M
    a[..., 2, 3], a[..., 3, 2] = omega, -omega
    return a


def solve_half(omega: np.ndarray) -> np.ndarray:
    """Newton's method on half of the orbit from `GUESS`, flows by matrix exponentials: (n, 3), v, duration, phase."""
    contact, free = piece(omega, True), piece(omega, False)
    half = np.pi / omega
    z = np.broadcast_to(GUESS, (*omega.shape, 3)).copy()
    last = np.inf
    for _ in range(50):
        v, duration, phase = z.T
        one, zero = np.ones_like(v), np.zeros_like(v)
        y = np.stack([X_C * one, v, np.sin(phase), np.cos(phase), one], -1)[..., None]
        by_phase = np.stack([zero, zero, np.cos(phase), -np.sin(phase), zero], -1)[..., None]
        by_v = np.broadcast_to(np.eye(5)[1][:, None], y.shape)
        first = expm(contact * duration[:, None, None])
        second = expm(free * (half - duration)[:, None, None])
        middle = first @ y
        end = second @ middle
        d_middle = np.concatenate([first @ by_v, contact @ middle, first @ by_phase], -1)
        d_end = second @ d_middle
        d_end[..., 1] -= (free @ end)[..., 0]
        force = K_F * (middle[:, 0] - X_C) + C_F * middle[:, 1]
        residual = np.concatenate([force, end[:, :2, 0] + y[:, :2, 0]], -1)
        jacobian = np.stack([K_F * d_middle[:, 0] + C_F * d_middle[:, 1], d_end[:, 0], d_end[:, 1]], 1)
        jacobian[:, 2, 0] += 1.0
        step = np.linalg.solve(jacobian, residual[..., None])[..., 0]
        size = np.max(np.abs(step))
        if size >= last and size < 1e-12:  # rounding errors are left
            break
        z, last = z - step, size
    else:
        raise ArithmeticError("no reference: Newton's method did not converge")
    return z


def exact(omega: np.ndarray) -> np.ndarray:
    """The `Reference` by `scipy.linalg.expm`: 4e-14 at most from one in 40 digits at ω = 1.15, 1.17, 1.2 and 1.25."""
    z = solve_half(omega)
    return np.stack([z[:, 0], z[:, 1], z[:, 2] / omega], -1)


def pieces_of(omega: np.ndarray, z: np.ndarray, pieces: int) -> np.ndarray:
    """Rows as PVLS writes them: ω, durations, time of the first event, states where the pieces begin."""
    v, duration, t = z.T
    free = np.pi / omega - duration
    start = np.stack([X_C * np.ones_like(v), v, np.sin(omega * t), np.cos(omega * t), np.ones_like(v)], -1)
    middle = expm(piece(omega, True) * duration[:, None, None]) @ start[..., None]
    half = np.concatenate([start[:, :2], middle[:, :2, 0]], -1)
    states = half if pieces == 2 else np.concatenate([half, -half], -1)
    durations = np.stack([duration, free] * (pieces // 2), -1)
    return np.concatenate([omega[:, None], durations, t[:, None], states], -1)


def profile(omega: float, z: np.ndarray, pieces: int, points: int = 201) -> np.ndarray:
    """The orbit to start from, as in a user's *.dat file: scaled time, (x, v) of each piece, scaled time."""
    v, duration, t = z
    y = np.array([X_C, v, math.sin(omega * t), math.cos(omega * t), 1.0])
    tau = np.linspace(0.0, 1.0, points)
    columns = []
    for contact, length in ((True, duration), (False, math.pi / omega - duration)):
        flow = expm(piece(np.array(omega), contact) * (tau * length)[:, None, None]) @ y
        columns.append(flow[:, :2])
        y = flow[-1]
    half = np.concatenate(columns, -1)
    states = half if pieces == 2 else np.concatenate([half, -half], -1)
    return np.concatenate([tau[:, None], states, tau[:, None]], -1)


def constants(pieces: int, points: int, ds: float, *, ntst: int, ncol: int, eps: float, adapt: int) -> str:
    """The constants file. Steps are in ω alone (other weights are 0) and of one size: the points are known, to 1e-8."""
    free = pieces + 2
    # Derivatives are the user's (JAC); no search for folds or bifurcations, no output but the ends (NPR, IID).
    return f"""
dat='orbit', NDIM={2 * pieces + 1}, IPS=4, IRS=0, ILP=0, ICP={list(range(1, free + 1))}
NTST={ntst}, NCOL={ncol}, IAD={adapt}, ISP=0, ISW=1, IPLT=0, NBC={3 * pieces + 2}, NINT=0
NMX={points}, NPR=0, MXBF=0, IID=0, ITMX=8, ITNW=9, NWTN=3, JAC=1, NPAR={free}
EPSL={eps:.1e}, EPSU={eps:.1e}, EPSS=1e-4
DS={ds!r}, DSMIN={abs(ds) / 2!r}, DSMAX={abs(ds)!r}, IADS=0
THL={{{", ".join(f"{i}: {float(i == 1)}" for i in range(1, free + 1))}}}
THU={{{", ".join(f"{i}: 0.0" for i in range(1, 2 * pieces + 2))}}}
"""


def compile_equations(folder: Path) -> Path:
    """The executable of `EQUATIONS`, linked with AUTO's objects by the flags of its own makefile that matter."""
    where = directory()
    if where is None:
        raise RuntimeError("AUTO-07p or gfortran is not installed")
    (folder / "trilinear.f90").write_text(EQUATIONS)
    objects = sorted(str(path) for path in (where / "lib").glob("*.o"))
    command = ["gfortran", "-O2", "-std=legacy", "-fopenmp", "trilinear.f90", "-o", "trilinear.exe", *objects]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "trilinear.exe"


def execute(exe: Path, text: str, columns: int) -> tuple[float, np.ndarray]:
    """Runs AUTO in the folder of its executable: seconds of processor time, a row for each point."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    one = os.environ | {"OMP_NUM_THREADS": "1"}  # AUTO would take all threads
    done = subprocess.run([exe], cwd=exe.parent, input=text, env=one, check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (exe.parent / "log").write_text(done.stdout)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    rows = np.fromfile(exe.parent / "points.bin").reshape(-1, columns)
    return seconds, rows[::2]  # AUTO calls PVLS twice for each point


def measure(
    *,
    ntst: int = 10,
    ncol: int = 4,
    points: int = 2000,
    pieces: int = 4,
    eps: float = 1e-10,
    adapt: int = 3,
    few: int = 50,
    omega: tuple[float, float] = OMEGA,
    repeats: int = 3,
    reference: Reference = exact,
) -> Result:
    """Continues `points` orbits over the interval `omega`, steps equal, and compares them with `reference`.

    Seconds are the least of `repeats` runs, less those of a run of `few` points with the same steps.
    """
    columns = 3 * pieces + 2
    ds = (omega[1] - omega[0]) / (points - 1)
    how = dict(ntst=ntst, ncol=ncol, eps=eps, adapt=adapt)
    with tempfile.TemporaryDirectory() as name:
        exe = compile_equations(Path(name))
        z = reference(np.array(omega[:1]))
        start = pieces_of(np.array(omega[:1]), z, pieces)[0, : pieces + 2]  # ω, durations, time of the first event
        (exe.parent / "start.par").write_text(" ".join(f"{p:.17g}" for p in start))
        np.savetxt(exe.parent / "orbit.dat", profile(omega[0], z[0], pieces), fmt="%.16e")

        def least(n: int) -> tuple[float, np.ndarray]:
            runs = [execute(exe, constants(pieces, n, ds, **how), columns) for _ in range(repeats)]
            return min(seconds for seconds, _ in runs), runs[0][1]

        short, first = least(few)
        long, rows = least(points)
    wanted = pieces_of(rows[1:, 0], reference(rows[1:, 0]), pieces)  # the first point is the guess
    error = float(np.max(np.abs(rows[1:] - wanted)))
    through = float(rows[0, 0]), float(rows[-1, 0])
    return Result(len(rows), (len(rows) - len(first)) / (long - short), error, through)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--pieces", type=int, nargs="+", default=[4, 2], choices=[2, 4])
    parser.add_argument("--ntst", type=int, nargs="+", default=[5, 10, 20, 40])
    parser.add_argument("--ncol", type=int, nargs="+", default=[4, 5, 6, 7])
    parser.add_argument("--eps", type=float, default=1e-10)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    if directory() is None:
        print("AUTO-07p is not installed")
        return
    print("| pieces | NTST | NCOL | points | orbits/s | error |\n|---|---|---|---|---|---|")
    for pieces in args.pieces:
        for ntst in args.ntst:
            for ncol in args.ncol:
                how = dict(ntst=ntst, ncol=ncol, eps=args.eps, repeats=args.repeats)
                r = measure(pieces=pieces, points=args.points, **how)
                print(f"| {pieces} | {ntst} | {ncol} | {r.points} | {r.per_second:.0f} | {r.error:.1e} |", flush=True)


if __name__ == "__main__":
    main()
