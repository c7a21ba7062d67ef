"""What a JPEG is made of, byte by byte: segments, one after the other, before the first scan."""

from __future__ import annotations

from collections.abc import Iterator

JPEG_SUFFIXES = frozenset((".jpg", ".jpeg"))
END = b"\xff\xd9"


def jpeg_without_metadata(content: bytes) -> bytes:
    """A JPEG without applications' segments, EXIF and XMP among them, without comments and without
    what follows its end; what says how its numbers are colours stays."""
    kept, position = content[:2], 2
    for kind, end in segments_of_jpeg(content):
        part = content[position:end]
        profile = kind == 0xE2 and part[4:16] == b"ICC_PROFILE\0"
        adobe = kind == 0xEE and part[4:9] == b"Adobe"
        if profile or adobe or not (0xE1 <= kind <= 0xEF or kind == 0xFE):
            kept += part
        position = end
    scans = content[position:]
    end = scans.find(END)
    return kept + (scans if end < 0 else scans[: end + len(END)])


def segments_of_jpeg(content: bytes) -> Iterator[tuple[int, int]]:
    """Kind and end of each segment before the first scan."""
    position = 2  # after the start-of-image mark come segments: FF, kind, length (2 bytes)
    while content[position : position + 1] == b"\xff" and content[position + 1] != 0xDA:
        kind = content[position + 1]
        position += 2 + int.from_bytes(content[position + 2 : position + 4], "big")
        yield kind, position
