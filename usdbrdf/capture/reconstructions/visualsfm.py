"""VisualSFM's .nvm files, which COLMAP writes too: photographs with their cameras; a mesh in their
frame.

A camera is a focal length in pixels, the rotation from the world to it (a quaternion, OpenCV's
axes), its centre, and one number by which what is measured from the picture's middle is
undistorted: (1 + k r^2), r in focal lengths. Blanks in names are written as quotes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import CentredCamera, Shot, scan_of_shots
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_text
from usdbrdf.files.tables import beginning_in_utf8, files_of, numbers_among, only_one
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens
from usdbrdf.options import CaptureOptions

NAME = "visualsfm"
DESCRIPTION = DESCRIPTIONS[NAME]
_HEAD, _OF_MATRICES = b"NVM_V3", "NVM_V3_R9T"
# Numbers behind a camera's name: focal length, rotation, centre (of matrices translation), k, 0.
_COUNTS = {"NVM_V3": 10, _OF_MATRICES: 15}


def matches(path: Path) -> bool:
    """Such a file, or a folder with one."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    return [f for f in files_of(path, [".nvm"]) if beginning_in_utf8(f).lstrip().startswith(_HEAD)]


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    called = "files .nvm that begin with NVM_V3"
    source = only_one(documents, path, called, "Name the one that was exported")
    return scan_of_shots(
        shots_of(source, findings),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=source.parent,
        meshes=("mesh.*", "model.*"),
        how="VisualSFM has poses and no surface: make a mesh in the same frame, and put it into "
        "this folder",
    )


def _models(lines: list[str], source: Path) -> list[list[str]]:
    """The lines of each reconstruction's cameras: so many cameras, so many points, until there are
    none."""
    found, at = list[list[str]](), 0
    while at < len(lines):
        count = _count(lines[at], source)
        if not count:
            break
        found.append(lines[at + 1 : at + 1 + count])
        at += 1 + count
        if len(found[-1]) < count:
            raise InputRefused(
                f"{source}: {len(found[-1])} cameras where it announces {count}. It was "
                "cut off; export it again. [capture.format]"
            )
        at += 1 + _count(lines[at], source) if at < len(lines) else 0
    return found


def _count(line: str, source: Path) -> int:
    if not line.isdecimal() or len(line) > 9:
        raise InputRefused(
            f"{source}: {line[:40]!r} where it is to say how many cameras or points follow. Export "
            "it again. [capture.format]"
        )
    return int(line)


def shots_of(source: Path, findings: Findings) -> list[Shot]:
    """The photographs of the largest reconstruction of a document."""
    lines = [line.strip() for line in read_text(source).splitlines() if line.strip()]
    kind, *calibration = lines[0].split()
    if kind not in _COUNTS or calibration:
        raise InputRefused(
            f"{source}: it begins with {lines[0][:60]!r} (known: {', '.join(_COUNTS)}, without a "
            "fixed calibration). Reconstruct with a focal length of each camera's own, or with "
            "COLMAP. [capture.format]"
        )
    models = _models(lines[1:], source)
    if not models:
        raise InputRefused(
            f"{source}: no reconstruction with cameras. Reconstruct the photographs first. "
            "[capture.alignment]"
        )
    largest = max(models, key=len)
    if len(models) > 1:
        findings.warn(
            f"{source.name}: {len(models)} reconstructions that do not go together; taken is the "
            f"one with most photographs, {len(largest)}. [capture.format]"
        )
    return [_shot(line, kind) for line in largest]


def _shot(line: str, kind: str) -> Shot:
    name, *words = line.split()
    name, numbers = name.replace('"', " "), numbers_among(words, _COUNTS[kind])
    if numbers is None or not numbers[0] > 0 or not numbers[1:-5].any():
        return Shot(name=name, camera=None, world_from_camera=None)
    focal, k = float(numbers[0]), float(numbers[-2])
    if kind == _OF_MATRICES:
        turn = numbers[1:10].reshape(3, 3)
        centre = -turn.T @ numbers[10:13]
    else:
        turn = Rotation.from_quat(np.roll(numbers[1:5], -1)).as_matrix()
        centre = numbers[5:8]
    return Shot(
        name=name,
        camera=CentredCamera(focal=focal, lens=Lens(curve="undistorting", shape=(k,))),
        world_from_camera=rigid_pose(turn.T, centre),
    )
