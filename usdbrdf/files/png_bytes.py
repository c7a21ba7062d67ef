"""The colour space that a PNG states by numbers, which OpenImageIO does not hand on: it says
Rec.709, whatever primaries are in the file."""

from __future__ import annotations

import struct
from pathlib import Path

from usdbrdf.files.colour import space_of_primaries
from usdbrdf.files.tables import beginning_of

_MARK = b"\x89PNG\r\n\x1a\n"
_HEAD = 1 << 16  # bytes, in which all that is asked for stands before the pixels
# What comes before numbers (PNG, third edition, 4.3).
_STRONGER = frozenset((b"cICP", b"iCCP", b"sRGB"))
_SRGB_GAMMA, _LINEAR_GAMMA = 45455, 100000
_CURVED = {"lin_p3d65_scene": "srgb_p3d65_scene", "lin_adobergb_scene": "g22_adobergb_scene"}


def space_by_chunks(path: Path) -> str:
    """The name of the space by cHRM and gAMA, or what they say of one without a name; "" where they
    say nothing, or Rec.709's primaries, and of what is no PNG."""
    head = beginning_of(path, _HEAD)
    chunks = _chunks(head) if head.startswith(_MARK) else {}
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


def _chunks(head: bytes) -> dict[bytes, bytes]:
    """The chunks before the pixels, by their names."""
    found: dict[bytes, bytes] = {}
    at = len(_MARK)
    while at + 8 <= len(head):
        length, name = struct.unpack_from(">I4s", head, at)
        if name == b"IDAT":
            break
        found.setdefault(name, head[at + 8 : at + 8 + length])
        at += 12 + length
    return found
