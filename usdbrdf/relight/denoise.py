"""Open Image Denoise over a rendered picture (extra ``denoise``)."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from usdbrdf.relight.render import Rendered
from usdbrdf.relight.surfaces import Float
from usdbrdf.shading.denoise import require_oidn

AUTO, NONE, OIDN = CHOICES = ("auto", "none", "oidn")


def chosen_filter(wanted: str) -> str:
    """ "none" or "oidn"; auto is oidn where it is installed. EnvironmentFailure where it is wanted
    and is not."""
    if wanted == AUTO:
        return OIDN if find_spec("pyoidn") else NONE
    if wanted == OIDN:
        require_oidn()
    return wanted


def denoised(rendered: Rendered) -> Float:
    """Radiance (H, W, 3), filtered along the edges of the first surfaces' albedo and normals, which
    tens of paths per pixel leave all but free of noise."""
    import pyoidn

    filtered = pyoidn.denoise(
        rendered.radiance, rendered.albedo, rendered.normal, hdr=True, clean_aux=True
    )
    return np.maximum(np.asarray(filtered, np.float32), 0)
