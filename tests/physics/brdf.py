"""Equations 3 to 6 of the paper written down once more, in plain NumPy, and their integrals."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Double = npt.NDArray[np.float64]


def f_nd(n: Double, w: Double, wo: Double, phi: float, psi: float) -> Double:
    """f_nd (...,) for unit vectors (..., 3), as printed; zero below the horizon."""
    nw, no = (n * w).sum(axis=-1), (n * wo).sum(axis=-1)
    h = w + wo
    h = h / np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-300)
    nh, wh = (n * h).sum(axis=-1), (w * h).sum(axis=-1)
    width = max(0.001, phi)
    y = (phi / 2 + 1 / 2) ** 2
    f0 = 0.08 * psi
    d = width**2 / (np.pi * (1 + (width**2 - 1) * nh**2) ** 2)
    fresnel = f0 + (1 - f0) * (1 - wh) ** 5
    above = (nw > 0) & (no > 0)
    g = _g1(np.where(above, nw, 1), y) * _g1(np.where(above, no, 1), y)
    return np.where(above, g * d * fresnel, 0)


def _g1(x: Double, y: float) -> Double:
    return 1 / (x + np.sqrt(x**2 + y**2 - x**2 * y**2))


def directional_albedo(
    theta: float, phi: float, psi: float, *, steps: int = 400, visible=None
) -> float:
    """Integral of f_nd n.w over the hemisphere for light going out at ``theta`` from the normal z.

    In the half vector's angles the peak is D itself: with h = h(t, azimuth), tan(t) = alpha s,
    dw = 4 (wo.h) dh. The product rule in (log s, azimuth) resolves any alpha.
    visible(w (..., 3)) restricts the hemisphere.
    """
    wo = np.array([np.sin(theta), 0.0, np.cos(theta)])
    alpha = max(0.001, phi)
    log_s = np.linspace(np.log(1e-4), np.log(1e6 / alpha), 4 * steps + 1)
    azimuth = (np.arange(steps) + 0.5) * 2 * np.pi / steps
    t = np.arctan(alpha * np.exp(log_s))[:, None]
    h = np.stack(
        [np.sin(t) * np.cos(azimuth), np.sin(t) * np.sin(azimuth), np.cos(t) + 0 * azimuth], axis=-1
    )
    woh = h @ wo
    w = 2 * woh[..., None] * h - wo
    z = np.array([0.0, 0.0, 1.0])
    value = f_nd(z, w, wo, phi, psi) * w[..., 2] * 4 * woh
    if visible is not None:
        value = value * visible(w)
    # dh = sin(t) dt dazimuth, dt = sin(t) cos(t) dlog s
    value = np.where(woh > 0, value, 0) * np.sin(t) ** 2 * np.cos(t)
    ring = value.mean(axis=1) * 2 * np.pi
    return float(((ring[1:] + ring[:-1]) / 2 * np.diff(log_s)).sum())
