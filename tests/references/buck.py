"""The orbit of one period of the buck converter (Hamill and Deane 1992) by matrix exponentials: off until the sawtooth
meets the control voltage, then on."""

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq


R, L, C, V_REF, GAIN, V_LOW, V_HIGH, T = 22.0, 20e-3, 47e-6, 11.3, 8.4, 3.8, 8.2, 400e-6
A = np.array([[-1 / (R * C), 1 / C], [-1 / L, 0.0]])


def off_then_on(tau, voltage):
    """The state at the start of the orbit that is off for a time tau of each period, and the state then."""
    drive = np.array([0.0, voltage / L])
    on = np.linalg.solve(A, (expm(A * (T - tau)) - np.eye(2)) @ drive)
    start = np.linalg.solve(np.eye(2) - expm(A * T), on)
    return start, expm(A * tau) @ start


def multipliers_of_the_buck_converter(voltage):
    """Of the orbit of one period."""

    def height(tau):
        _, there = off_then_on(tau, voltage)
        return GAIN * (there[0] - V_REF) - V_LOW - (V_HIGH - V_LOW) * tau / T

    tau = brentq(height, 0.0, T, xtol=1e-18, rtol=1e-15)
    _, there = off_then_on(tau, voltage)
    normal, drive = np.array([GAIN, 0.0]), np.array([0.0, voltage / L])
    rate = normal @ (A @ there) - (V_HIGH - V_LOW) / T
    saltation = np.eye(2) + np.outer(drive, normal) / rate
    return np.linalg.eigvals(expm(A * (T - tau)) @ saltation @ expm(A * tau))


def flip_of_the_buck_converter():
    """The voltage at which a multiplier is -1."""

    def flip(voltage):
        return np.prod(multipliers_of_the_buck_converter(voltage) + 1).real

    return brentq(flip, 24.3, 24.7, xtol=1e-13)
