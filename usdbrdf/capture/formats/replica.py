"""Replica's scenes as they were published: mesh.ply, textures/, habitat/.

There are no photographs: radiance lies in an atlas per part of the mesh, which shows no
reflections, so frames have to be rendered or brought.
"""

from __future__ import annotations

from pathlib import Path

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.formats import nice_slam
from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "replica"
DESCRIPTION = DESCRIPTIONS[NAME]
# Frames are read as those of the renders, with what lies beside these.
beside, beside_mesh = nice_slam.beside, nice_slam.beside_mesh


def matches(path: Path) -> bool:
    """A folder with mesh.ply and what belongs to it in textures/ or habitat/."""
    marks = ("textures/parameters.json", "habitat/info_semantic.json")
    return (path / "mesh.ply").is_file() and any((path / mark).is_file() for mark in marks)


def read(path: Path, options: CaptureOptions) -> Scan:
    folder = path.resolve()
    if not (folder / "traj.txt").is_file():
        raise InputRefused(
            f"{folder}: Replica holds no photographs, and the radiance of its atlas shows no "
            "reflections to fit materials to. Put frames with their trajectory (traj.txt and "
            "results/, as NICE-SLAM's renders have them) into the folder, or convert those with "
            f"--mesh {folder.name}/mesh.ply. [capture.frames]"
        )
    return nice_slam.read(folder, options)
