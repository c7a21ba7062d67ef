"""The colour space that a PNG states by numbers, which OpenImageIO does not hand on: it says
Rec.709, whatever primaries are in the file."""

from __future__ import annotations

import os
import struct
from pathlib import Path

from usdbrdf.files.atomic import raise_shortage
from usdbrdf.files.colour import space_of_primaries

_MARK = b"\x89PNG\r\n\x1a\n"
# Bytes of chunks that are asked for, and chunks before the pixels: in no sound file are there more.
_LONGEST, _MOST_CHUNKS = 64, 10_000
# What comes before numbers (PNG, third edition, 4.3).
_STRONGER = frozenset((b"cICP", b"iCCP", b"sRGB"))
_SRGB_GAMMA, _LINEAR_GAMMA = 45455, 100000
_CURVED = {"lin_p3d65_scene": "srgb_p3d65_scene", "lin_adobergb_scene": "g22_adobergb_scene"}


def space_by_chunks(path: Path) -> str:
    """The name of the space by cHRM and gAMA, or what they say of one without a name; "" where they
    say nothing, or Rec.709's primaries, and of what is no PNG."""
    chunks = _chunks(path)
    stated = chunks.get(b"cHRM", b"")
    if len(stated) != 32 or _STRONGER & chunks.keys():
        return ""
    white_x, white_y, *places = (number / 1e5 for number in struct.unpack(">8I", stated))
    primaries = (*places, white_x, white_y)
    linear = space_of_primaries(primaries)
    if linear == "lin_rec709_scene":
        return ""
    gamma = chunks.get(b"gAMA", b"")
    power = struct.unpack(">I", gamma)[0] if len(gamma) == 4 else _SRGB_GAMMA
    if linear and power == _LINEAR_GAMMA:
        return linear
    if linear in _CURVED and power == _SRGB_GAMMA:
        return _CURVED[linear]
    shown = ", ".join(f"{place:.4g}" for place in primaries)
    return f"primaries and white {shown} with a gamma of {power / 1e5:.4g}"


def _chunks(path: Path) -> dict[bytes, bytes]:
    """The chunks of a PNG before its pixels, by their names, with the data of what is short: text
    and EXIF before them may be long. None of what is no PNG, or cannot be read."""
    found: dict[bytes, bytes] = {}
    try:
        with path.open("rb") as file:
            if file.read(len(_MARK)) != _MARK:
                return found
            for _ in range(_MOST_CHUNKS):
                head = file.read(8)
                if len(head) < 8 or head[4:] == b"IDAT":
                    break
                length, name = struct.unpack(">I4s", head)
                data = file.read(length) if length <= _LONGEST else b""
                found.setdefault(name, data)
                file.seek(length - len(data) + 4, os.SEEK_CUR)
    except OSError as error:
        raise_shortage(error)
        return {}
    return found
