"""Irradiance in closed form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Double = npt.NDArray[np.float64]


def polygon_irradiance(
    point: npt.ArrayLike, normal: npt.ArrayLike, polygon: npt.ArrayLike
) -> float:
    """Irradiance from a planar polygon (K, 3) of unit radiance (Lambert 1760).

    E = 1/2 sum_i theta_i n . unit(r_i x r_i+1), with r_i the unit vectors to the corners and
    theta_i the angle between r_i and r_i+1, for the part of the polygon above the receiver's
    horizon.
    """
    n = np.asarray(normal, np.float64)
    corners = _above_horizon(np.asarray(polygon, np.float64) - np.asarray(point), n)
    if len(corners) < 3:
        return 0.0
    r = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    after = np.roll(r, -1, axis=0)
    across = np.cross(r, after)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, (r * after).sum(axis=1))
    side = sine > 1e-14
    return float(abs(angle[side] @ (across[side] / sine[side, None] @ n)) / 2)


def _above_horizon(corners: Double, n: Double) -> Double:
    """Sutherland and Hodgman's clipping by the plane through the receiver."""
    height = corners @ n
    kept = []
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        if height[i] >= 0:
            kept.append(corners[i])
        if (height[i] >= 0) != (height[j] >= 0):
            t = height[i] / (height[i] - height[j])
            kept.append(corners[i] + t * (corners[j] - corners[i]))
    return np.array(kept).reshape(-1, 3)


def coaxial_discs(r1: float, r2: float, distance: float) -> float:
    """Form factor F12 between parallel coaxial discs (E. M. Sparrow and R. D. Cess, "Radiation Heat
    Transfer", configuration 23): X = 1 + (1 + R2^2) / R1^2 with R = r / distance,
    F12 = (X - sqrt(X^2 - 4 (R2 / R1)^2)) / 2."""
    a, b = r1 / distance, r2 / distance
    x = 1 + (1 + b * b) / (a * a)
    return float((x - np.sqrt(x * x - 4 * (b / a) ** 2)) / 2)
