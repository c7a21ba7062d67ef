"""Eyeful Tower (Xu et al. 2023): rooms photographed by a rig, merged to HDR, with a mesh.

cameras.json has per picture, column by column, K (for the full size) and T (camera from world,
OpenCV's axes), and the lens. Pictures lie in images-2k/CAMERA/NAME.exr: linear, in DCI-P3, not
white-balanced. World: y up, metres, as mesh.obj.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    pictures_of,
    refuse_without_pictures,
    scan_of,
)
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import beginning_of
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.options import CaptureOptions

NAME = "eyeful-tower"
DESCRIPTION = DESCRIPTIONS[NAME]
_FOLDERS = (
    "images-2k", "images-1k", "images-4k", "images-8k", "images",
    "images-jpeg-4k", "images-jpeg-2k", "images-jpeg-1k", "images-jpeg",
)  # fmt: skip
_PRIMARIES = "lin_p3d65_scene"


def matches(path: Path) -> bool:
    """A folder with cameras.json, or this file, in the form that is named after K, R and T."""
    return b'"KRT"' in beginning_of(path / "cameras.json" if path.is_dir() else path)


def read(path: Path, options: CaptureOptions) -> Scan:
    path = path.resolve()
    source = path / "cameras.json" if path.is_dir() else path
    folder, findings = source.parent, Findings()
    pictures = pictures_of(folder, options, *_FOLDERS)
    refuse_without_pictures(pictures, source)
    records = frame_records(source, pictures, findings)
    mesh = partial(mesh_beside, folder, options, "mesh.obj", how="Download mesh.obj of this scene")
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        up_axis="Y",
        encoding=_PRIMARIES,
    )


def frame_records(source: Path, pictures: Pictures, findings: Findings) -> list[FrameRecord]:
    """The cameras of a cameras.json that have a picture."""
    document: Any = read_json(source)
    rows = document.get("KRT") if isinstance(document, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputRefused(
            f'{source}: no list "KRT" of cameras. Download it again. [capture.format]'
        )
    records = []
    for row in rows:
        name = str(row.get("cameraId", ""))
        image = pictures.named(name)
        if image is None:  # some were removed from the data, and people download a part
            findings.count("poses_without_photograph", 1)
            continue
        camera, pose = _matrix(row, "K", 3), _matrix(row, "T", 4)
        sides = [row.get("width"), row.get("height")]
        if camera is None or pose is None or not all(type(s) is int and s > 0 for s in sides):
            findings.drop(name, "it has no K, T, width and height", "capture.pose")
            continue
        records.append(
            FrameRecord(
                name=name,
                image_path=image,
                world_from_camera=opengl_from_opencv(np.asarray(np.linalg.inv(pose), np.float64)),
                intrinsics=(camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]),
                resolution=(int(sides[0]), int(sides[1])),
                lens=_lens(row, name, source),
            )
        )
    if not records and not findings.dropped:
        raise InputRefused(
            f"{source}: none of its {len(rows)} cameras has a picture in {pictures.folder.name}. "
            "Keep the folders of the data set as they are. [capture.frames]"
        )
    return sorted(records, key=lambda record: record.image_path)


def _matrix(row: dict[str, Any], key: str, size: int) -> Double | None:
    """A square matrix, stored column by column; None where it is none that can be inverted."""
    try:
        values = np.array(row.get(key), np.float64).reshape(size, size).T
    except (TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() and np.linalg.det(values) else None


def _lens(row: dict[str, Any], name: str, source: Path) -> Lens:
    model = row.get("distortionModel")
    terms: Any = row.get("distortion")
    sound = isinstance(terms, list) and all(type(term) in (int, float) for term in terms)
    terms = [*map(float, terms), *[0.0] * (8 - len(terms))] if sound else []
    # Those between, of which the authors' converter reads none, are 0 in what they publish.
    unknown = {"RadialAndTangential": terms[5:], "Fisheye": terms[4:6] + terms[8:]}
    if any(unknown.get(str(model), ())):
        raise InputRefused(
            f"{source}: the lens of {name!r} has more terms than its model {model} is known to "
            "have. Undistort the pictures, and bring them with a transforms.json. [capture.camera]"
        )
    if terms and model == "RadialAndTangential":
        k1, k2, p1, p2, k3, *_ = terms
        lens = Lens(radial=(k1, k2, k3), tangential=(p1, p2))
    elif terms and model == "Fisheye":
        lens = Lens(curve="fisheye", radial=tuple(terms[:4]), tangential=(terms[6], terms[7]))
    else:
        raise InputRefused(
            f"{source}: the lens of {name!r} is {str(model)[:40]!r}, not RadialAndTangential or "
            "Fisheye with its terms. Download it again. [capture.camera]"
        )
    return lens if lens.bends else PINHOLE
