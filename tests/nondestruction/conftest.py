"""A small room of eight objects, converted once for all tests of this folder."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import MadeCapture, make_capture, poses_down_and_up, write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.job.progress import set_quiet

COARSE = ["-q", "--texel-size", "0.2", "--standard-error", "0.2", "--rays", "32"]
COARSE += ["--max-pixels", "60", "--denoise", "none"]


@pytest.fixture(autouse=True)
def _quiet():
    set_quiet(True)
    yield
    set_quiet(False)


def photographed(folder: Path) -> MadeCapture:
    return make_capture(
        folder,
        subdivisions=1,
        poses=poses_down_and_up(5, 5),
        radiance={"ceiling": (0.125, 0.125, 0.125)},
    )


def convert(capture: Path, folder: Path, *options: str) -> Asset:
    assert main(["convert", str(capture), "-o", str(folder), *COARSE, *options]) == 0
    return Asset.at(folder)


def bytes_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="session")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("nondestruction")


@pytest.fixture(scope="session")
def capture(base):
    """The room, its walls four objects."""
    made = photographed(base / "scan")
    walls = np.flatnonzero(made.face_object == made.names.index("walls"))
    owner, names = made.face_object.copy(), [*made.names, "north", "west", "east"]
    for i, faces in enumerate(np.array_split(walls, 4)[1:]):
        owner[faces] = len(made.names) + i
    write_ply(made.folder / "mesh.ply", made.points, made.triangles, owner)
    labels = [{"id": i, "name": name, "class_name": name} for i, name in enumerate(names)]
    (made.folder / "objects.json").write_text(json.dumps({"objects": labels}))
    return made.folder


@pytest.fixture(scope="session")
def converted(base, capture):
    """Nobody may change it: tests copy the folder."""
    set_quiet(True)
    return convert(capture, base / "made" / "room")
