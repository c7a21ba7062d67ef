"""Photographed textures with the noise taken off and the contrast that pixels took restored.

Wiener's filter, texel by texel: y is the picture B x + n, x the surface, B the pixels' blur.
Where the detail d = y - B y is mostly noise it is taken off; where it stands well above the noise
it is given twice, which undoes the first order of the blur (P. van Cittert's step).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.texels import Texels
from usdbrdf.texturing.footprints import blurred

Float = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

# Standard deviation of a sample's blur in pixels: the camera's own, bilinear reading, the pixel. A
# little less than the fit of highlights takes: what was not blurred must not be sharpened.
SAMPLE_BLUR = 0.6
# What is detail and what is noise is decided over three blurs of this many pixels.
_NEIGHBOURHOOD = 2.0


def restored(
    texels: Texels, values: Float, measured: Bool, variance: Float, footprint: Float
) -> Float:
    """The surface's values, (T, 3), from what frames measured of them.

    values     (T, 3) float32, with a fill where nobody looked
    measured   (T,) bool
    variance   (T,) float32, of the values' errors
    footprint  (T, 3) float32, what a pixel covers: covariance xx, xy, yy in texels
    """
    kernel = SAMPLE_BLUR**2 * footprint
    smooth = blurred(texels, values, kernel)
    detail = values - smooth
    energy = np.stack([(detail**2).mean(axis=1), variance], axis=-1)
    energy = np.where(measured[:, None], energy, 0).astype(np.float32)
    for _ in range(3):
        energy = blurred(texels, energy, np.float32(_NEIGHBOURHOOD**2) * footprint)
    seen, noise = energy.T
    share = np.clip(1 - noise / np.maximum(seen, 1e-30), 0, 1)
    # At the rim of what was measured the fill would pass for detail, and the last samples before a
    # lamp hold some of its light.
    surrounded = blurred(texels, measured[:, None].astype(np.float32), kernel)[:, 0] > 1 - 1e-3
    return np.where(surrounded[:, None], smooth + 2 * share[:, None] * detail, values)
