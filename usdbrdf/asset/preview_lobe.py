"""What UsdPreviewSurface is told of a fitted lobe, and the lobe that it was told."""

from __future__ import annotations

import math
from typing import NamedTuple

from usdbrdf.transport.brdf import F0_OF_PSI, alpha_of_phi
from usdbrdf.transport.renderer_match import (
    kept_beside_microfacets,
    measured_lobe,
    shown_lobe,
    shown_share_of_metal,
)

MICROFACET, BECKMANN_FACETS = "microfacet", "beckmann"


# Of glass that was not measured: as clear and smooth as panes are.
_CLEAR = 1.5


class PreviewLobe(NamedTuple):
    """Inputs of UsdPreviewSurface, and the factor that its diffuse colour has been given."""

    roughness: float
    ior: float
    diffuse: float


# Without a fitted lobe there is none: index of refraction 1 reflects nothing, and shading is
# purely diffuse. Written out, because applications differ in what they assume.
NO_LOBE = PreviewLobe(roughness=1.0, ior=1.0, diffuse=1.0)


CLEAR_GLASS = PreviewLobe(roughness=0.0, ior=_CLEAR, diffuse=0.0)


def preview_surface_from_fit(phi: float, psi: float, mapping: str = "measured") -> PreviewLobe:
    """UsdPreviewSurface's inputs for the paper's parameters.

    alpha = max(0.001, phi) and USD squares its roughness: roughness = sqrt(alpha).
    measured  F0 = 0.08 psi
    matched   F0 and the diffuse colour as renderers need them to show that (``renderer_match``)
    microfacet  F0 = 0.08 psi, for the lobe is the renderers' own; the diffuse colour as they need
              it, who take from it what the lobe reflects
    F0 = ((ior - 1) / (ior + 1))^2: ior = (1 + sqrt(F0)) / (1 - sqrt(F0)).
    """
    f0, diffuse = F0_OF_PSI * psi, 1.0
    if mapping == "matched":
        f0, diffuse = (float(value) for value in shown_lobe(phi, psi))
    elif mapping == MICROFACET:
        diffuse = kept_beside_microfacets(phi, f0)
    sqrt_f0 = math.sqrt(f0)
    return PreviewLobe(math.sqrt(alpha_of_phi(phi)), (1 + sqrt_f0) / (1 - sqrt_f0), diffuse)


def shown_metal(
    phi: float, f0: tuple[float, float, float], mapping: str = "measured"
) -> tuple[float, float, float]:
    """diffuseColor of a metal, ``metallic`` being 1, for its F0 (3,) under a mapping; at most 1."""
    share = shown_share_of_metal(phi) if mapping == "matched" else 1.0
    red, green, blue = (min(share * value, 1.0) for value in f0)
    return red, green, blue


def fit_from_preview_surface(roughness: float, ior: float, mapping: str = "matched") -> PreviewLobe:
    """The inverse of "matched" or "microfacet", for whoever renders with the fitted lobe: the
    roughness, the ior that has the F0 of the fit, and the factor that the diffuse colour was given.
    Whatever was written over our values is understood as what renderers show of it; so an opinion
    counts, and what nobody touched comes back as it was fitted."""
    shown = ((ior - 1) / (ior + 1)) ** 2
    if mapping == MICROFACET:
        return PreviewLobe(roughness, ior, kept_beside_microfacets(roughness**2, shown))
    psi, diffuse = measured_lobe(roughness**2, shown)
    sqrt_f0 = math.sqrt(F0_OF_PSI * psi)
    return PreviewLobe(roughness, (1 + sqrt_f0) / (1 - sqrt_f0), diffuse)
