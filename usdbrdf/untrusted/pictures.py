"""Single pictures of unknown origin: light from outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.images import image_size, read_exr, read_radiance
from usdbrdf.files.radiance_header import factors_of_hdr
from usdbrdf.model.arrays import Float
from usdbrdf.untrusted.bounds import read_in_child, refuse_large

# What a child of this process has read whole may be read here: decoding the same bytes again
# does the same again.
_sound: set[str] = set()


def picture_from_file(path: Path) -> Float:
    """(H, W, 3) float32 in the primaries that are stored, divided by what a Radiance header states;
    NaN outside the data window; one channel becomes three.

    ImageRefused where it cannot be read whole.
    """
    refuse_large("picture", path)
    digest = sha256_of(path)
    if digest in _sound:
        return read_here(path)
    pixels = read_in_child("picture", f"{__name__}:read_here", path, np.ndarray)
    _sound.add(digest)
    return pixels


def read_here(path: Path) -> Float:
    grey = len(image_size(path)[2]) == 1
    stored = np.repeat(read_exr(path), 3, axis=2) if grey else read_radiance(path)
    stored /= factors_of_hdr(path).astype(np.float32)
    return stored
