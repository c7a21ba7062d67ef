"""The non-diffuse lobe f_nd of the paper (eq. 3-6), and how to sample it: the one place of its
equations.

    f_nd = G D F
    D = alpha^2 / (pi (1 + (alpha^2 - 1) (n.h)^2)^2),        alpha = max(0.001, phi)
    G = G1(n.w, y) G1(n.wo, y),                              y = (phi/2 + 1/2)^2
        G1(x, y) = 1 / (x + sqrt(x^2 + y^2 - x^2 y^2))
    F = F0 + (1 - F0) (1 - w.h)^5,                           F0 = 0.08 psi

G1 already contains the microfacet denominator: G = G_smith / (4 n.w n.wo). F is affine in psi, so
f_nd(phi, psi) = base(phi) + psi * slope(phi); psi = 0 still leaves the grazing part, ``base``.

Measured in practice are other surfaces than the paper's. DIELECTRIC is the lobe of renderers: the
same D, Smith's masking of the same alpha (y = alpha), and Fresnel's equations, made affine in psi
through F0 of 0.02 and 0.06; below, ``share_of_base`` takes it to nothing. BECKMANN is the same
with Beckmann's distribution of facets and their masking. CONDUCTOR has the masking of DIELECTRIC,
and the paper's F with F0 of each channel.

The formulas are plain operators: they take numbers, NumPy's arrays and Dr.Jit's, and may be called
from compiled functions, in whose precision they are computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba.extending import register_jitable

from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Double

PAPER, DIELECTRIC, CONDUCTOR, BECKMANN = 0, 1, 2, 3  # kinds of lobes
F0_OF_PSI = 0.08
MIN_ALPHA = 0.001
F = TypeVar("F", bound=Callable[..., Any])


def formula(function: F) -> F:
    """A function that stays one of Python, and that kernels may call as well."""
    same: F = register_jitable(function)
    return same


@formula
def stretched(a2: Any, b2: Any, k2: Any) -> Any:
    """a^2 + (k b)^2 from the squares. Of sine and cosine of an angle it is what D and G1 hold, in
    the form that keeps the digits of a mirror's D: 1 + (k^2 - 1) cos^2 would not."""
    return a2 + k2 * b2


@formula
def distribution(sin2_h: Any, alpha: Any) -> Any:
    """D from sin^2 of the angle between normal and half vector."""
    alpha2 = alpha * alpha
    below = stretched(sin2_h, 1.0 - sin2_h, alpha2)
    return alpha2 / (np.pi * below * below)


@formula
def masking_width(phi: Any) -> Any:
    """y = (phi/2 + 1/2)^2 of G1."""
    half = 0.5 * phi + 0.5
    return half * half


@formula
def masking(x: Any, y: Any, sqrt: Any = np.sqrt) -> Any:
    """G1(x, y), with the ``sqrt`` of the kind of numbers that x and y are."""
    x2 = x * x
    return 1.0 / (x + sqrt(stretched(x2, 1.0 - x2, y * y)))


_UPRIGHT = 1e-6


@formula
def beckmann_distribution(sin2_h: Any, alpha: Any, exp: Any = np.exp) -> Any:
    """D of facets whose slopes are normally distributed (P. Beckmann and A. Spizzichino, 1963),
    from sin^2 of the angle between normal and half vector."""
    # A facet may stand upright: then this is 0, not 0 / 0.
    cos2, alpha2 = 1.0 + _UPRIGHT - sin2_h, alpha * alpha
    return exp(-sin2_h / (cos2 * alpha2)) / (np.pi * alpha2 * cos2 * cos2)


# Where nothing is masked any more.
_UNMASKED = 1.6


@formula
def beckmann_masking(x: Any, alpha: Any, sqrt: Any = np.sqrt, minimum: Any = np.minimum) -> Any:
    """G1 of these facets over 2 x, as ``masking`` is, for a cosine x in (0, 1): the rational form
    of B. Walter et al., "Microfacet Models for Refraction through Rough Surfaces", 2007."""
    # Rounding may take x above 1.
    a = minimum(_UNMASKED, x / (alpha * sqrt(abs(1.0 - x * x) + _UPRIGHT**2)))
    return a * (3.535 + 2.181 * a) / (1.0 + a * (2.276 + 2.577 * a)) / (2.0 * x)


@formula
def is_dielectric(kind: int) -> bool:
    """Whether Fresnel's equations of a dielectric hold for a kind of lobe."""
    return kind in (DIELECTRIC, BECKMANN)


@formula
def grazing(cos_wh: Any) -> Any:
    """Schlick's (1 - w.h)^5 of a cosine in [0, 1]."""
    m = 1.0 - cos_wh
    return m * m * m * m * m


@formula
def dielectric_fresnel(ior: Any, cosine: Any, sqrt: Any = np.sqrt) -> Any:
    """Fresnel's reflectance of unpolarised light against air, for a cosine in [0, 1]."""
    g = sqrt(ior * ior - 1.0 + cosine * cosine)
    s, p = (g - cosine) / (g + cosine), cosine * (g + cosine) - 1.0
    ratio = p / (cosine * (g - cosine) + 1.0)
    return 0.5 * s * s * (1.0 + ratio * ratio)


_LOW_F0, _HIGH_F0 = 0.02, 0.06
_LOW_IOR, _HIGH_IOR = ((1 + f0**0.5) / (1 - f0**0.5) for f0 in (_LOW_F0, _HIGH_F0))


@formula
def reflectance(cos_wh: Any, kind: int, sqrt: Any = np.sqrt) -> Any:
    """(base, rise) of F = base + F0 rise at a cosine in [0, 1], by the kind of lobe."""
    if is_dielectric(kind):
        low = dielectric_fresnel(_LOW_IOR, cos_wh, sqrt)
        rise = (dielectric_fresnel(_HIGH_IOR, cos_wh, sqrt) - low) / (_HIGH_F0 - _LOW_F0)
        return low - _LOW_F0 * rise, rise
    x = grazing(cos_wh)
    return x, 1.0 - x


def share_of_base(f0: Any, kind: int, minimum: Any = np.minimum) -> Any:
    """By what ``base`` is to be multiplied where F0 is known, so that F vanishes with F0: a
    dielectric of the index of air reflects nothing at any angle. Fresnel's equations below the
    least F0 that F is made affine from, to .007 (root mean square over cosines)."""
    return minimum(1.0, f0 / _LOW_F0) ** (1 / 6) if is_dielectric(kind) else 1.0


@formula
def fresnel(f0: Any, cos_wh: Any) -> Any:
    """F of a cosine in [0, 1]."""
    return f0 + (1.0 - f0) * grazing(cos_wh)


@kernel
def alpha_of_phi(phi: float) -> float:
    """Width of the normal distribution: max(0.001, phi)."""
    return max(MIN_ALPHA, phi)


@kernel
def width_of_masking(phi: float, kind: int) -> float:
    """y of G1, by the kind of lobe."""
    if kind == PAPER:
        return float(masking_width(phi))
    return max(MIN_ALPHA, phi)


@kernel
def clamped(cosine: float) -> float:
    """Into [0, 1], beyond which rounding may have taken it."""
    return min(1.0, max(0.0, cosine))


@kernel
def lobe(n: Double, w: Double, wo: Double, phi: float) -> tuple[float, float]:
    """(base, slope) of f_nd = base + psi * slope for unit vectors n, w, wo; (0, 0) below the
    horizon of n."""
    nw = n[0] * w[0] + n[1] * w[1] + n[2] * w[2]
    no = n[0] * wo[0] + n[1] * wo[1] + n[2] * wo[2]
    if nw <= 0 or no <= 0:
        return 0.0, 0.0
    sin2_h, cos_wh = half_vector(n, w, wo)
    y = masking_width(phi)
    dg = distribution(sin2_h, alpha_of_phi(phi)) * masking(nw, y) * masking(no, y)
    x = grazing(clamped(cos_wh))
    return dg * x, F0_OF_PSI * dg * (1.0 - x)


@kernel
def half_vector(n: Double, w: Double, wo: Double) -> tuple[float, float]:
    """(sin^2 of the angle between n and h, cosine between w and h), h = (w + wo) / |w + wo|."""
    hx = w[0] + wo[0]
    hy = w[1] + wo[1]
    hz = w[2] + wo[2]
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    if length < 1e-12:
        return 1.0, 0.0
    hx, hy, hz = hx / length, hy / length, hz / length
    cx = n[1] * hz - n[2] * hy
    cy = n[2] * hx - n[0] * hz
    cz = n[0] * hy - n[1] * hx
    cos_wh = w[0] * hx + w[1] * hy + w[2] * hz
    return min(1.0, cx * cx + cy * cy + cz * cz), cos_wh


@kernel
def sample_half_vector(u1: float, u2: float, alpha: float) -> tuple[float, float, float]:
    """Half vector about +z with density D(h) cos: inverse of D's distribution function."""
    tan2 = alpha * alpha * u1 / max(1.0 - u1, 1e-12)
    cosine = 1.0 / np.sqrt(1.0 + tan2)
    sine = np.sqrt(max(0.0, 1.0 - cosine * cosine))
    angle = 2 * np.pi * u2
    return sine * np.cos(angle), sine * np.sin(angle), cosine


@kernel
def reflected_density(sin2_h: float, cos_wh: float, alpha: float) -> float:
    """Density over solid angle of w, reflected about a half vector of ``sample_half_vector``:
    D(h) (n.h) / (4 w.h)."""
    if cos_wh <= 0:
        return 0.0
    return float(distribution(sin2_h, alpha) * np.sqrt(max(0.0, 1.0 - sin2_h)) / (4.0 * cos_wh))
