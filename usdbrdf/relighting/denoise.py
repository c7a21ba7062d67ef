"""Open Image Denoise over a rendered picture (extra ``denoise``)."""

from __future__ import annotations

import numpy as np

from usdbrdf.relighting.render import Rendered
from usdbrdf.relighting.surfaces import Float
from usdbrdf.shading.denoise import AUTO, CHOICES, OIDN, chosen_filter

__all__ = ["AUTO", "CHOICES", "OIDN", "chosen_filter", "denoised"]


def denoised(rendered: Rendered) -> Float:
    """Radiance (H, W, 3), filtered along the edges of the first surfaces' albedo and normals, which
    tens of paths per pixel leave all but free of noise."""
    import pyoidn

    filtered = pyoidn.denoise(
        rendered.radiance, rendered.albedo, rendered.normal, hdr=True, clean_aux=True
    )
    return np.maximum(np.asarray(filtered, np.float32), 0)
