"""Rendered radiance -> image files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.errors import UsageError
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.relighting.surfaces import Float

LINEAR = (".exr",)
DISPLAYED = (".png", ".jpg", ".jpeg")

# Automatic exposure: this percentile of the mean of red, green and blue comes out as this value.
_PERCENTILE, _SHOWN_AS = 90.0, 0.8


def check_picture_name(path: Path) -> None:
    """Raises UsageError for an extension that is not written."""
    if path.suffix.lower() not in (*LINEAR, *DISPLAYED):
        raise UsageError(
            f"{path}: pictures are written as {', '.join((*LINEAR, *DISPLAYED))}. Choose one of "
            "these extensions. [relight.format]"
        )


def automatic_exposure(pictures: list[Float]) -> float:
    """Stops that bring the 90th percentile of the mean of R, G and B over all pixels to 0.8."""
    means = np.concatenate([picture.mean(axis=2).ravel() for picture in pictures])
    level = float(np.percentile(means, _PERCENTILE))
    return float(np.log2(_SHOWN_AS / level)) if level > 0 else 0.0


def write_picture(path: Path, radiance: Float, stops: float) -> None:
    """Float radiance as EXR; as PNG or JPEG times 2^stops, clipped, in sRGB."""
    if path.suffix.lower() in LINEAR:
        write_exr(path, radiance, half=False)
    else:
        write_preview_png(path, to_display_srgb8(radiance, exposure_scale=2.0**stops))
