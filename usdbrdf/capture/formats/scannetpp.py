"""ScanNet++: the photographs of dslr/ with the laser scan and the objects of scans/.

dslr/colmap and the mesh share a frame; transforms.json beside it has its axes changed. Objects are
groups of segments, and each vertex of the mesh is in one segment.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.colmap import lens_of, world_from_camera
from usdbrdf.capture.formats.named_pictures import (
    drop_without_picture,
    mesh_beside,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.parts import LabelTable
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.model.arrays import Int, Long
from usdbrdf.model.capture import Scan
from usdbrdf.model.mesh import ObjectName
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import colmap_model, model_files
from usdbrdf.untrusted.mesh_files import FileMesh

NAME = "scannetpp"
DESCRIPTION = DESCRIPTIONS[NAME]
_MESH = "mesh_aligned_0.05.ply"


def matches(path: Path) -> bool:
    """A scene's folder, with dslr/colmap and scans/."""
    return (path / "scans").is_dir() and bool(model_files(path / "dslr" / "colmap"))


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    source = folder / "dslr" / "colmap"
    if not model_files(source):
        raise InputRefused(
            f"{folder}: no COLMAP model in dslr/colmap. Name the folder of a scene, and download "
            "its DSLR assets. [capture.format]"
        )
    pictures = pictures_of(folder, options, "dslr/resized_images", "dslr/original_images")
    refuse_without_pictures(pictures, source)
    masks = folder / "dslr" / "resized_anon_masks"
    model, records = colmap_model(source), []
    for name, number, pose in zip(
        model.names, model.camera_of_image.tolist(), model.camera_from_world, strict=True
    ):
        image = pictures.named(name)
        if image is None:
            drop_without_picture(name, findings)
            continue
        lens, intrinsics = lens_of(model.cameras[number])
        mask = masks / f"{Path(name).stem}.png"
        records.append(
            FrameRecord(
                name=name,
                image_path=image,
                world_from_camera=world_from_camera(pose),
                intrinsics=intrinsics,
                resolution=model.cameras[number].resolution,
                lens=lens,
                mask_path=mask if mask.is_file() else None,
            )
        )
    warn_of_radiance(pictures.instead, findings, source)
    records.sort(key=lambda record: record.image_path)
    mesh = partial(
        mesh_beside, folder, options, f"scans/{_MESH}", how=f"Download scans/{_MESH} of this scene"
    )
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        name=folder.name,
        objects=_annotated(folder / "scans"),
    )


def _annotated(scans: Path) -> Callable[[FileMesh], LabelTable] | None:
    """What knows the objects by segments.json and segments_anno.json; None without these."""
    segments, groups = scans / "segments.json", scans / "segments_anno.json"
    if not (segments.is_file() and groups.is_file()):
        return None

    def objects(mesh: FileMesh) -> LabelTable:
        document: Any = read_json(segments)
        numbers = document.get("segIndices") if isinstance(document, dict) else None
        if not isinstance(numbers, list) or len(numbers) != len(mesh.points):
            raise InputRefused(
                f"{segments}: no segIndices for each of the {len(mesh.points)} vertices of "
                f"{_MESH}. Download both of one scene. [objects.count]"
            )
        entries, object_of_segment = _groups(groups)
        of_vertex = np.array([object_of_segment.get(number, -1) for number in numbers], np.int64)
        return LabelTable(entries, _of_faces(of_vertex, mesh.triangles))

    return objects


def _groups(path: Path) -> tuple[dict[int, ObjectName], dict[int, int]]:
    """Name and class of each object, and the object of each segment: of several, the smallest."""
    document: Any = read_json(path)
    rows: Any = document.get("segGroups") if isinstance(document, dict) else None
    sound = isinstance(rows, list) and all(
        isinstance(row, dict)
        and type(row.get("objectId", row.get("id"))) is int
        and isinstance(row.get("segments"), list)
        for row in rows
    )
    if not sound:
        raise InputRefused(
            f"{path}: no segGroups with objectId and segments each. Download it again. "
            "[objects.format]"
        )
    entries, object_of_segment = {}, {}
    for row in sorted(rows, key=lambda row: -len(row["segments"])):
        number, label = row.get("objectId", row.get("id")), str(row.get("label") or "")
        entries[number] = ObjectName(f"{label or 'object'}_{number}", label)
        object_of_segment.update(dict.fromkeys(row["segments"], number))
    return entries, object_of_segment


def _of_faces(of_vertex: Long, triangles: Int) -> Long:
    """(F,) what two of a triangle's corners are, else its first."""
    first, second, third = of_vertex[triangles].T
    return np.asarray(np.where(second == third, second, first), np.int64)
