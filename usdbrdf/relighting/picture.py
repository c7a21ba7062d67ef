"""Rendered radiance -> image files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.errors import OwnershipConflict, UsageError
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.model.arrays import Float

LINEAR = (".exr",)

DISPLAYED = (".png", ".jpg", ".jpeg")

# Automatic exposure: this percentile of the mean of red, green and blue comes out as this value.
_PERCENTILE, _SHOWN_AS = 90.0, 0.8

_LEVELS = 1 << 16  # pixels of a picture that the percentile is taken from


def check_picture_name(path: Path) -> None:
    """Raises UsageError for an extension that is not written."""
    if path.suffix.lower() not in (*LINEAR, *DISPLAYED):
        raise UsageError(
            f"{path}: pictures are written as {', '.join((*LINEAR, *DISPLAYED))}. Choose one of "
            "these extensions. [relight.format]"
        )


def refuse_taken(path: Path, *, folder: bool) -> None:
    """OwnershipConflict where a file or folder stands where the other kind is to be written."""
    if folder and path.exists() and not path.is_dir():
        raise OwnershipConflict(f"{path}: not a folder. Name another with -o. [relight.output]")
    if not folder and path.is_dir():
        raise OwnershipConflict(
            f"{path}: a folder of this name is in the place of the picture. Name another file "
            "with -o. [relight.output]"
        )
    above = next((parent for parent in path.absolute().parents if parent.exists()), None)
    if above is not None and not above.is_dir():
        raise OwnershipConflict(
            f"{path}: {above} is not a folder. Name another place with -o. [relight.output]"
        )


def exposure_levels(picture: Float) -> Float:
    """(N,) means of R, G and B at pixels all over the picture: what ``automatic_exposure`` needs
    of it, at most 65536."""
    means = picture.mean(axis=2).ravel()
    return np.ascontiguousarray(means[:: -(-means.size // _LEVELS)])


def automatic_exposure(levels: list[Float]) -> float:
    """Stops that bring the 90th percentile of the mean of R, G and B over all pictures to 0.8."""
    level = float(np.percentile(np.concatenate(levels), _PERCENTILE))
    return float(np.log2(_SHOWN_AS / level)) if level > 0 else 0.0


def write_picture(path: Path, radiance: Float, stops: float) -> None:
    """Float radiance as EXR; as PNG or JPEG times 2^stops, clipped, in sRGB."""
    if path.suffix.lower() in LINEAR:
        write_exr(path, radiance, half=False)
    else:
        write_preview_png(path, to_display_srgb8(radiance, exposure_scale=2.0**stops))
