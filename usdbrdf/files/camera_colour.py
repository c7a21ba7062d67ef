"""The colour space that cameras write into EXIF data, where no ICC profile is in a photograph.

EXIF knows sRGB and "uncalibrated" (65535) alone. DCF 2.0, the cameras' own standard, calls Adobe
RGB uncalibrated with the interoperability index R03, which OpenImageIO does not hand on.
"""

from __future__ import annotations

from pathlib import Path

from usdbrdf.files.tables import beginning_of

UNCALIBRATED = 65535
ADOBE_RGB = "Adobe RGB (1998)"
UNKNOWN = "uncalibrated by EXIF"
# Entry of a directory of TIFF: tag 1, ASCII, four bytes, these; in either order of bytes.
_R03 = (b"\x01\x00\x02\x00\x04\x00\x00\x00R03\x00", b"\x00\x01\x00\x02\x00\x00\x00\x04R03\x00")
_LONGEST = 1 << 17  # bytes of EXIF data, and what may come before


def space_by_exif(path: Path, stated: object) -> str:
    """The name of the colour space that EXIF data ``stated`` as a number, "" for sRGB and none."""
    if stated != UNCALIBRATED:
        return ""
    head = beginning_of(path, _LONGEST)
    return ADOBE_RGB if any(entry in head for entry in _R03) else UNKNOWN
