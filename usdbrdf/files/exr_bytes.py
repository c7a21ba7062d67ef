"""An EXR's own list of where its chunks of pixels lie, which is written last.

Writers ignore it where that fails, on a disk that becomes full or that fails, and readers make up
for a list that is missing: the pixels tell nothing. Others take such a file for an unfinished one.
"""

from __future__ import annotations

import struct
from pathlib import Path

_MAGIC = b"\x76\x2f\x31\x01"
_OFFSET = struct.Struct("<Q")
_HEAD = 1 << 20  # bytes; the list of the most pixels that we write, in tiles of 64, is shorter


def lists_its_chunks(path: Path) -> bool:
    """Whether each entry of the list leads into the file, behind the list; true of what is no EXR.
    Of a file with one part, as this program writes them."""
    with path.open("rb") as file:
        content = file.read(_HEAD)
    if not content.startswith(_MAGIC):
        return True
    place, first = _end_of_header(content), (size := path.stat().st_size)
    while place < first:  # the first chunk begins where the list ends
        if place + _OFFSET.size > len(content):
            return False
        (chunk,) = _OFFSET.unpack_from(content, place)
        place += _OFFSET.size
        if not place <= chunk < size:
            return False
        first = min(first, chunk)
    return True


def _end_of_header(content: bytes) -> int:
    """Where the list begins: behind the attributes, which are a name, a type, a length and a value
    each, and an empty name."""
    place = len(_MAGIC) + 4
    while content[place : place + 1] not in (b"\0", b""):
        after_type = content.index(b"\0", content.index(b"\0", place) + 1) + 1
        (length,) = struct.unpack_from("<i", content, after_type)
        place = after_type + 4 + length
    return place + 1
