"""What the header of a Radiance file (.hdr) says of its pixels: by what they have been multiplied,
and of which primaries they are. Its format is that of Radiance's "filefmts" reference, and GAMMA
that of Bruce Walter's rgbe.c, which many programs have."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from usdbrdf.errors import ImageRefused
from usdbrdf.files.tables import beginning_of
from usdbrdf.model.arrays import Double

_LONGEST = 1 << 16  # bytes of a header
_MARK = b"#?"  # and the name of the program, which may be any
_LINE = re.compile(rb"^(EXPOSURE|COLORCORR|PRIMARIES|GAMMA)=(.*)$", re.MULTILINE)
_LINEAR = 1e-3  # of a GAMMA that is 1


def factors_of_hdr(path: Path) -> Double:
    """(3,) what the pixels of a Radiance file are to be divided by to be radiance again, of R, G
    and B: the product of all that its header states; 1 for other files and where nothing is.
    ImageRefused where it states a GAMMA: what was raised to a power is no radiance."""
    factors = np.ones(3)
    for key, numbers in _stated(path):
        if key == b"GAMMA" and len(numbers) == 1 and not 0 < numbers[0] < np.inf:
            raise ImageRefused(
                f"{path}: its header states GAMMA={numbers[0]:g}, which nothing can be corrected "
                "by, so whether its pixels are radiance is not known. Save it linear, or take the "
                "line out if it is. [image.gamma]"
            )
        if key == b"GAMMA" and len(numbers) == 1 and abs(numbers[0] - 1) > _LINEAR:
            raise ImageRefused(
                f"{path}: its header states GAMMA={numbers[0]:g}, so its pixels are gamma "
                "corrected and no radiance. Save it linear, or take the line out if it is. "
                "[image.gamma]"
            )
        if key in (b"EXPOSURE", b"COLORCORR") and len(numbers) in (1, 3) and (numbers > 0).all():
            factors = factors * numbers
    return factors


def primaries_of_hdr(path: Path) -> tuple[float, ...]:
    """x, y of red, green, blue and white; () where they are not stated, as by Photoshop's zeros."""
    stated = [numbers for key, numbers in _stated(path) if key == b"PRIMARIES"]
    sound = stated and len(stated[-1]) == 8 and stated[-1].any()
    return tuple(float(number) for number in stated[-1]) if sound else ()


def _stated(path: Path) -> list[tuple[bytes, Double]]:
    """Lines of finite numbers, and of a GAMMA whatever it is, in their order."""
    # Every frame is asked, each time that it is read, and few are Radiance's.
    if beginning_of(path, len(_MARK)) != _MARK:
        return []
    head = beginning_of(path, _LONGEST)
    lines = _LINE.findall(head.replace(b"\r", b"").partition(b"\n\n")[0])
    found = []
    for key, said in lines:
        try:
            numbers = np.array(said.split(), np.float64)
        except ValueError:
            continue
        if np.isfinite(numbers).all() or key == b"GAMMA":
            found.append((key, numbers))
    return found
