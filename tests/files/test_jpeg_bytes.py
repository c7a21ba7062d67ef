"""JPEGs lose what says who made them and where, and nothing of the picture."""

from __future__ import annotations

import pytest

from usdbrdf.files.jpeg_bytes import END, jpeg_without_metadata


def segment(kind: int, content: bytes) -> bytes:
    return bytes((0xFF, kind)) + (len(content) + 2).to_bytes(2, "big") + content


START, SCAN = b"\xff\xd8", segment(0xDA, b"\x01\x01\x00\x00\x3f\x00") + b"\x12\xff\x00\x34"
JFIF, TABLE = segment(0xE0, b"JFIF\0\x01\x01"), segment(0xDB, bytes(65))
PROFILE, ADOBE = segment(0xE2, b"ICC_PROFILE\0\x01\x01"), segment(0xEE, b"Adobe\0d")


def test_what_says_how_the_numbers_are_colours_stays():
    plain = START + JFIF + PROFILE + ADOBE + TABLE + SCAN + END
    assert jpeg_without_metadata(plain) == plain


@pytest.mark.parametrize(
    "told",
    [
        segment(0xE1, b"Exif\0\0GPS"), segment(0xE2, b"MPF\0"), segment(0xE3, b"x"),
        segment(0xED, b"Photoshop"), segment(0xEE, b"Other"), segment(0xEF, b"x"),
        segment(0xFE, b"a comment"),
    ],
)  # fmt: skip
def test_what_else_applications_say_goes(told):
    plain = START + JFIF + TABLE + SCAN + END
    assert jpeg_without_metadata(START + JFIF + told + TABLE + told + SCAN + END) == plain


@pytest.mark.parametrize("behind", [b"", b"\0", b"a second picture", END])
def test_what_follows_the_end_goes_to_the_byte(behind):
    plain = START + TABLE + SCAN + END
    assert jpeg_without_metadata(plain + behind) == plain


def test_a_picture_that_has_lost_its_end_keeps_the_rest():
    """An artist's: what comes with a capture is refused."""
    assert jpeg_without_metadata(START + TABLE + SCAN) == START + TABLE + SCAN
