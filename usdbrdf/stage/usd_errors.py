"""USD's own words, fit for one of our sentences."""

from __future__ import annotations

_MAX_LENGTH = 300


def in_one_line(error: object) -> str:
    """The text of an error of USD, which often spans lines and repeats itself, on one line."""
    text = " ".join(str(error).split()).rstrip(".; ")
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ..."
