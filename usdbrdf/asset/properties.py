"""What the stages hand over for an object, and what readers get back."""

from __future__ import annotations

import math
from dataclasses import dataclass

from usdbrdf.model.arrays import Float

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Aov:
    """One map of an object.

    name   a USD identifier: also the look that shows it
    file   path relative to the asset folder
    scale  factor from stored value to displayed value
    unit   of the stored values; "1" for pure numbers
    """

    name: str
    file: str
    scale: float = 1.0
    unit: str = "1"


@dataclass(frozen=True, kw_only=True)
class TexturedObject:
    """Result of the texturing stage for one object.

    corner_uv         (F, 3, 2) float32 in [0, 1], v up, per triangle corner of the object
    texel_size        metres
    resolution        width, height in texels
    seen_fraction     share of the texels that a photograph measured
    clipped_fraction  share of the texels that were clipped wherever they were seen
    seen              False where no texel was measured: the maps are filled in
    quantile          what the lit map stores of the observed radiances
    """

    prim_path: str
    identifier: str
    corner_uv: Float
    aovs: tuple[Aov, ...]
    texel_size: float
    seen_fraction: float
    clipped_fraction: float
    resolution: tuple[int, int]
    seen: bool
    quantile: float = 0.5


@dataclass(frozen=True, kw_only=True)
class ShadedObject:
    """Result of the shading stage for one object.

    aovs                     "albedo" for a reflector, "emission" for an emitter, and others
    radiance                 mean radiance of the emitting texels; zeros for a reflector
    radiance_status          "measured"; clipped in every photograph: "estimated" from the light
                             that it casts, or "lowerBound" where that does not tell either
    radiance_error           relative standard error of an estimated radiance, else NaN
    area_fraction            share of the surface that emits
    mean_albedo              area-weighted, linear; zeros for an emitter
    rays_per_texel           mean number of rays
    standard_error           of the irradiance before denoising, relative, median over the texels
    escaped_fraction         share of the rays that left the scene
    """

    prim_path: str
    identifier: str
    aovs: tuple[Aov, ...]
    emitter: bool
    radiance: Colour
    radiance_status: str
    radiance_error: float
    area_fraction: float
    mean_albedo: Colour
    rays_per_texel: float
    standard_error: float
    escaped_fraction: float

    @property
    def radiance_is_lower_bound(self) -> bool:
        return self.radiance_status == "lowerBound"


@dataclass(frozen=True, kw_only=True)
class FittedObject:
    """Result of the fitting stage for one object; NaN where a number is not known.

    phi, psi      the paper's roughness and specular parameters, 0 to 1
    phi_error, psi_error            standard deviations
    phi_confidence, psi_confidence  "high", "low" or "none"
    cost          loss at the minimum
    evidence      1 - loss(phi, psi) / loss(no specular lobe)
    status        "measured", "prior", "unseen" or "failed"
    target_frame  index from 0 of the photograph that was fitted, or of many the one that shows the
                  highlight best; -1 for none
    num_pixels    how many the fit used
    aovs          "diffuse", "refined_irradiance" and "base_color", if the fit refined them
    mean_color    area-weighted base colour, linear
    mapping       "measured" or "matched": what UsdPreviewSurface is told of phi and psi
    """

    prim_path: str
    identifier: str
    phi: float
    psi: float
    cost: float
    evidence: float
    status: str
    target_frame: int
    num_pixels: int
    method: str
    phi_error: float = math.nan
    psi_error: float = math.nan
    phi_confidence: str = "none"
    psi_confidence: str = "none"
    aovs: tuple[Aov, ...] = ()
    mean_color: Colour = (0.0, 0.0, 0.0)
    mapping: str = "measured"
