"""What pages are put together of: the files of ``static``."""

from __future__ import annotations

from pathlib import Path

_STATIC = Path(__file__).resolve().parent / "static"


def static_part(name: str) -> str:
    """The text of one, by its name."""
    return (_STATIC / name).read_text("utf-8")
