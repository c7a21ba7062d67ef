"""The export folder of the iOS app "3d Scanner App": photographs, ARKit poses, and a mesh.

``frame_*.json`` holds a row-major camera-to-world matrix in ARKit's (OpenGL's) axes, in the frame
of the mesh, y up, metres, and intrinsics whose pixel centres are whole numbers. Most poses have no
photograph. Pixels are sRGB, 8 bit, so nothing that comes of them is radiometric.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.mesh_frames import path_in_capture
from usdbrdf.capture.parts import (
    as_photographs,
    geometry_from_file,
    radiance_encoding,
    scan_from_parts,
)
from usdbrdf.errors import ImageRefused, InputRefused, MeshMissing
from usdbrdf.files.documents import read_json
from usdbrdf.files.images import MAX_SIDE, image_size
from usdbrdf.files.paths import seen_of
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "scanner-app"
DESCRIPTION = DESCRIPTIONS[NAME]
# The app's own names, the one with the whole surface first.
_MESHES = ("export.obj", "textured_output.obj", "export.ply", "export_refined.obj")
_FRAME = re.compile(r"frame_\d+\.json")
# The app's own suffix first; the others are what it is copied or converted to.
_PHOTOGRAPHS = (".jpg", ".JPG", ".jpeg", ".JPEG", ".png", ".PNG")


def matches(path: Path) -> bool:
    """A folder with frame_00000.json and the like."""
    return path.is_dir() and any(_FRAME.fullmatch(p.name) for p in path.glob("frame_*.json"))


def read(path: Path, options: CaptureOptions) -> Scan:
    folder = path.resolve()
    findings = Findings()
    encoding = radiance_encoding(options, photographs=True)
    return scan_from_parts(
        as_photographs(_records(folder, options, findings), findings, folder),
        lambda: geometry_from_file(
            options.mesh or _mesh(folder, options),
            options.objects,
            options,
            findings,
            capture_root=folder,
        ),
        options,
        findings,
        name=folder.name,
        adapter=NAME,
        source=folder,
        encoding=encoding,
        radiometric=False,
        up_axis="Y",
    )


def _records(folder: Path, options: CaptureOptions, findings: Findings) -> list[FrameRecord]:
    documents = sorted(p for p in folder.glob("frame_*.json") if _FRAME.fullmatch(p.name))
    records = []
    for document in documents:
        beside = (
            path_in_capture(folder, document.with_suffix(suffix).name, options)
            for suffix in _PHOTOGRAPHS
        )
        photograph = next((path for path in beside if path.is_file()), None)
        if photograph is None:
            findings.count("poses_without_photograph", 1)
            continue
        pose = read_json(document, nonfinite_below=("cameraPoseARFrame",))
        record = _record(pose, document, photograph, findings)
        if record is not None:
            records.append(record)
    if not records and not findings.dropped:
        raise InputRefused(
            f"{folder}: {len(documents)} poses, but no photograph beside them (frame_*.jpg). "
            "Export with images. [capture.frames]"
        )
    if findings.counts.get("frames_without_exposure"):
        findings.warn(
            f"{folder.name}: {findings.counts['frames_without_exposure']} frames state no "
            "exposureDuration, so all count as exposed alike. [capture.exposure]"
        )
        records = [replace(record, exposure_time=1.0) for record in records]
    return records


def _record(document: Any, path: Path, photograph: Path, findings: Findings) -> FrameRecord | None:
    name = photograph.name
    if not isinstance(document, dict):
        raise InputRefused(f"{path}: not a pose of this app. Export again. [capture.format]")
    pose = _numbers(document, "cameraPoseARFrame", 16)
    if pose is None:
        findings.drop(name, "it has no cameraPoseARFrame of 16 finite numbers", "capture.pose")
        return None
    camera = _numbers(document, "intrinsics", 9)
    if camera is None or not (camera[0] > 0 and camera[4] > 0):
        raise InputRefused(
            f"{path}: no intrinsics of 9 numbers with focal lengths. Export again. [capture.camera]"
        )
    # The size of the image that the intrinsics belong to is told by the OpenGL projection.
    projection = _numbers(document, "projectionMatrix", 16)
    try:
        told = projection is not None and projection[0] > 0 and projection[5] > 0
        if projection is not None and told:
            sides = 2 * camera[0] / projection[0], 2 * camera[4] / projection[5]
            resolution = round(min(sides[0], MAX_SIDE + 1)), round(min(sides[1], MAX_SIDE + 1))
        else:
            resolution = image_size(photograph)[:2]
    except ImageRefused as error:
        findings.drop(name, clause_of(error, photograph), "capture.image")
        return None
    exposure = document.get("exposureDuration")
    if not (isinstance(exposure, int | float) and exposure > 0):
        findings.count("frames_without_exposure", 1)
        exposure = 1.0
    return FrameRecord(
        name=name,
        image_path=photograph,
        world_from_camera=np.array(pose).reshape(4, 4),
        # The first pixel's centre is (0, 0) there and (0.5, 0.5) here.
        intrinsics=(camera[0], camera[4], camera[2] + 0.5, camera[5] + 0.5),
        resolution=resolution,
        size_of_image=not told,
        exposure_time=float(exposure),
    )


def _numbers(document: Mapping[str, Any], key: str, count: int) -> list[float] | None:
    values = document.get(key)
    if not isinstance(values, list) or len(values) != count:
        return None
    sound = all(type(v) in (int, float) and math.isfinite(v) for v in values)
    return [float(v) for v in values] if sound else None


def _mesh(folder: Path, options: CaptureOptions) -> Path:
    others = sorted(
        p.name for p in seen_of(folder.iterdir()) if p.suffix.lower() in (".ply", ".obj")
    )
    for name in (*_MESHES, *others):
        path = path_in_capture(folder, name, options)
        if path.is_file():
            return path
    raise MeshMissing(
        f"{folder}: no mesh ({', '.join(_MESHES)}). Export the mesh into this folder, or name one "
        "with --mesh. [mesh.missing]"
    )
