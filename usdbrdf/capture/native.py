"""A Scan as a capture in our own format: transforms.json, frames, mesh.ply and objects.json.

Read again with the same options it gives the same Scan. What the format cannot hold is what a USD
mesh says beyond its triangles: its shading normals and the prims that it is referenced by.
"""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import OwnershipConflict
from usdbrdf.files.atomic import environment_failures, whole_folder
from usdbrdf.files.colour import kind_of_encoding
from usdbrdf.files.documents import write_json
from usdbrdf.files.images import read_radiance, write_preview_png
from usdbrdf.files.ply import write_ply
from usdbrdf.job.progress import progress, warn
from usdbrdf.job.versions import refuse_version
from usdbrdf.model.arrays import Int
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.upright import as_captured


def refuse_taken(folder: Path, capture: Path) -> None:
    """OwnershipConflict where the folder of a capture to be written holds anything, or lies in the
    capture that it is made of, or in a published version."""
    refuse_version(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise OwnershipConflict(
            f"{folder}: there is something already, and a capture is never written over. Name a "
            "new folder. [ownership.taken]"
        )
    # One that is not there is told by who reads it, whatever lies beside it.
    source = (capture.parent if capture.is_file() else capture).resolve()
    if folder.resolve().is_relative_to(source):
        raise OwnershipConflict(
            f"{folder}: lies inside the capture {source}, which would change by it. Name a folder "
            "elsewhere. [ownership.inside]"
        )


def write_capture(scan: Scan, images: Sequence[Path], folder: Path) -> None:
    """Write a scan, whose frames lie in ``images`` now, as a capture that the adapter "transforms"
    reads; it appears whole or not at all in the new or empty ``folder``, in the coordinates of the
    capture that it was.

    Frames are copied as they are. Raises EnvironmentFailure where the disk does not take them.
    """
    scan = as_captured(scan)
    if scan.usd_geometry is not None:
        warn(
            f"{folder}: mesh.ply holds the triangles and objects of {scan.usd_geometry.name}, not "
            "its normals and texture coordinates. [capture.write]"
        )
    with environment_failures(str(folder)), whole_folder(folder) as staged:
        (staged / "frames").mkdir()
        names = _frame_names(scan.frames)
        copies = zip(images, names, strict=True)
        for image, name in progress(copies, total=len(names), label="frames", unit="files"):
            shutil.copyfile(image, staged / name)
        masks = _write_masks(scan, images, names, staged)
        points = scan.mesh.points[: captured_points(scan)]
        write_ply(staged / "mesh.ply", points, *captured_faces(scan))
        objects = [
            {"id": i, "name": label.label, "class_name": label.class_name}
            | ({"directive": label.directive} if label.directive else {})
            for i, label in enumerate(scan.objects)
        ]
        write_json(staged / "objects.json", {"objects": objects})
        write_json(staged / "transforms.json", _document(scan, names, masks))


def _write_masks(
    scan: Scan, images: Sequence[Path], names: Sequence[str], folder: Path
) -> dict[int, str]:
    """Masks for frames that photographs through lenses became, by the frames' numbers: what the
    photographs do not show is unknown, which a reader of frames else takes for damage."""
    masks = {}
    for i, view in enumerate(scan.views):
        if view is not None:
            (folder / "masks").mkdir(exist_ok=True)
            masks[i] = f"masks/{Path(names[i]).name}.png"
            known = np.isfinite(read_radiance(images[i])).all(axis=2, keepdims=True)
            write_preview_png(folder / masks[i], np.repeat(np.uint8(255) * known, 3, axis=2))
    return masks


def as_copied(scan: Scan, asked: Scan) -> Scan:
    """The scan, whose files are copied as they are, with the poses and objects that were found."""
    refined, captured = asked.frames.world_from_camera, asked.frames.captured_pose
    frames = replace(scan.frames, world_from_camera=refined, captured_pose=captured)
    return replace(scan, frames=frames, mesh=asked.mesh, objects=asked.objects)


def _frame_names(frames: Frames) -> list[str]:
    """Paths in the capture: the images' own names, numbered where two are alike."""
    count = Counter(path.name.lower() for path in frames.image_paths)
    alike = max(count.values(), default=0) > 1
    numbered = (f"{i:05d}_" if alike else "" for i in range(len(frames)))
    return [f"frames/{n}{path.name}" for n, path in zip(numbered, frames.image_paths, strict=True)]


def _document(scan: Scan, names: list[str], masks: dict[int, str]) -> dict[str, Any]:
    frames = scan.frames
    return {
        "camera_model": "PINHOLE",
        "encoding": frames.encoding,
        # Frames that photographs through lenses became: their files do not tell.
        **({"radiometric": False} if _holds_light(frames) and not frames.radiometric else {}),
        "meters_per_unit": scan.meters_per_unit,
        "up_axis": scan.up_axis,
        "mesh": "mesh.ply",
        "objects": "objects.json",
        "frames": [
            _entry(frames, i, name) | ({"mask_path": masks[i]} if i in masks else {})
            for i, name in enumerate(names)
        ],
    }


def _holds_light(frames: Frames) -> bool:
    return kind_of_encoding(frames.encoding) != "display"


def _entry(frames: Frames, i: int, name: str) -> dict[str, Any]:
    width, height = frames.resolution[i].tolist()
    intrinsics = zip(("fl_x", "fl_y", "cx", "cy"), frames.intrinsics[i].tolist(), strict=True)
    entry: dict[str, Any] = {
        "file_path": name,
        "transform_matrix": frames.world_from_camera[i].tolist(),
        "w": width,
        "h": height,
        **dict(intrinsics),
        "exposure_time": float(frames.exposure_time[i]),
    }
    saturation = float(frames.saturation_radiance[i])
    if _holds_light(frames) and math.isfinite(saturation):
        entry["saturation_radiance"] = saturation
    if frames.captured_pose is not None:
        entry["captured_transform_matrix"] = frames.captured_pose[i].tolist()
    if _holds_light(frames) and frames.noise_floor_radiance[i] > 0:
        entry["noise_floor_radiance"] = float(frames.noise_floor_radiance[i])
    return entry


def own_faces(scan: Scan) -> int:
    """How many faces the capture's own mesh has: second skins come after them."""
    return len(scan.mesh.triangles) if scan.turned_faces is None else len(scan.turned_faces)


def captured_points(scan: Scan) -> int:
    """The same of its points: each face of a second skin has three of its own."""
    return len(scan.mesh.points) - 3 * (len(scan.mesh.triangles) - own_faces(scan))


def captured_faces(scan: Scan) -> tuple[Int, Int]:
    """Triangles (F, 3) as the capture winds them, and their objects (F,)."""
    count = own_faces(scan)
    triangles = scan.mesh.triangles[:count].copy()
    if scan.turned_faces is not None:
        triangles[scan.turned_faces] = triangles[scan.turned_faces][:, [0, 2, 1]]
    return triangles, scan.mesh.face_object[:count]
