"""Alembic: recognised and refused, for no maintained package reads it; USD says the same."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import files_of
from usdbrdf.options import CaptureOptions

NAME = "alembic"
DESCRIPTION = DESCRIPTIONS[NAME]


def matches(path: Path) -> bool:
    """An Alembic file, or a folder with one."""
    return bool(files_of(path, [".abc"]))


def read(path: Path, options: CaptureOptions) -> NoReturn:
    raise InputRefused(
        f"{path}: Alembic cameras are not read. Import the file into Blender (File > Import > "
        "Alembic) or Houdini, export camera and meshes as USD, and convert that. [capture.format]"
    )
