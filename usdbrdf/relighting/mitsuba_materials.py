"""Materials -> BSDFs of Mitsuba 3.

UsdPreviewSurface fixes neither masking nor the diffuse term. The measured materials were fitted
with the lobe of ``lobe_plugin``, so everything is rendered with it: then roughness and ior of the
stage mean what they meant when they were measured, and an artist's small change has a small effect.
Without LLVM there are no BSDFs in Python; Lambert plus Mitsuba's own GGX lobe, scaled to the same
directional albedo, stands in.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from usdbrdf.relighting import lobe_plugin
from usdbrdf.relighting.matched_lobe import matching_factor
from usdbrdf.relighting.surfaces import Float, Surface

# Share of the samples that go to the lobe where Mitsuba mixes two BSDFs.
_GLOSSY_SHARE = 0.3


def bsdf(mi: Any, surface: Surface, *, native: bool | None = None) -> dict[str, Any]:
    """The plugin of a surface's material; ``native`` without Python, as scalar variants need."""
    if native is None:
        native = mi.variant().startswith("scalar")
    plugin = _native(mi, surface) if native else _lobe(mi, surface)
    return {"type": "twosided", "bsdf": plugin} if surface.two_sided else plugin


def radiance_texture(mi: Any, image: Float, wrap: str = "clamp") -> dict[str, Any]:
    """A map of radiance for an emitter."""
    if image.shape[:2] == (1, 1):
        return {"type": "rgb", "value": [float(v) for v in image[0, 0]]}
    return colour_texture(mi, image, wrap)


def colour_texture(mi: Any, image: Float, wrap: str = "clamp") -> dict[str, Any]:
    """A map of 1 or 3 channels as a texture; texels at pixel centres, bilinear."""
    # Mitsuba refuses a constant reflectance above 1; as a map it may have any value.
    if image.shape[:2] == (1, 1) and image.max() <= 1:
        return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(image[0, 0], 3)]}
    return {
        "type": "bitmap",
        # Mitsuba's v points down the rows of a picture.
        "bitmap": mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32)),
        "raw": True,
        "wrap_mode": wrap,
    }


def _diffuse(mi: Any, surface: Surface, factor: float = 1.0) -> dict[str, Any]:
    if surface.corner_colour is not None:
        return {"type": "mesh_attribute", "name": "vertex_colour", "scale": factor}
    return colour_texture(mi, surface.material.diffuse * np.float32(factor), surface.material.wrap)


def _f0(mi: Any, surface: Surface, factor: float = 1.0) -> dict[str, Any]:
    if surface.corner_f0 is not None:
        return {"type": "mesh_attribute", "name": "vertex_f0", "scale": factor}
    return colour_texture(mi, surface.material.f0 * np.float32(factor), surface.material.wrap)


def _lobe(mi: Any, surface: Surface) -> dict[str, Any]:
    lobe_plugin.register(mi)
    material = surface.material
    return {
        "type": lobe_plugin.NAME,
        "diffuse": _diffuse(mi, surface),
        "f0": _f0(mi, surface),
        "phi": _grey_texture(mi, material.roughness**2, material.wrap),
    }


def _grey_texture(mi: Any, image: Float, wrap: str) -> dict[str, Any]:
    if image.shape[:2] == (1, 1):
        return {"type": "uniform", "value": float(image[0, 0, 0])}
    return colour_texture(mi, image, wrap)


def _native(mi: Any, surface: Surface) -> dict[str, Any]:
    """(1 - s) * Lambert / (1 - s) + s * GGX / s: the sum of both, sampled by the share s."""
    material = surface.material
    diffuse = {"type": "diffuse", "reflectance": _diffuse(mi, surface, 1 / (1 - _GLOSSY_SHARE))}
    roughness = float(material.roughness.mean())
    f0 = material.f0.reshape(-1, 3).mean(axis=0)
    grey = float(np.clip(f0.mean(), 1e-6, 0.98))
    eta = (1 + math.sqrt(grey)) / (1 - math.sqrt(grey))
    factor = matching_factor(roughness**2, grey)
    conductor = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": _grey_texture(mi, np.maximum(material.roughness**2, 1e-3), material.wrap),
        "eta": {"type": "rgb", "value": eta},
        "k": {"type": "rgb", "value": 0.0},
        "specular_reflectance": _f0(mi, surface, factor / grey / _GLOSSY_SHARE),
    }
    return {"type": "blendbsdf", "weight": _GLOSSY_SHARE, "matte": diffuse, "glossy": conductor}
