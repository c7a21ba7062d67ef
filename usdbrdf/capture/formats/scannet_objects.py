"""Objects as ScanNet and ScanNet++ have them: groups of segments, and each vertex of the mesh is in
one segment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from usdbrdf.capture.mesh_frames import LabelTable
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.model.arrays import Int, Long
from usdbrdf.model.mesh import ObjectName
from usdbrdf.untrusted.mesh_files import FileMesh


def annotated_objects(segments: Path, groups: Path) -> Callable[[FileMesh], LabelTable] | None:
    """What knows the objects by the segments of vertices and their groups; None without these."""
    if not (segments.is_file() and groups.is_file()):
        return None

    def objects(mesh: FileMesh) -> LabelTable:
        document: Any = read_json(segments)
        numbers = document.get("segIndices") if isinstance(document, dict) else None
        if not _are_numbers(numbers) or len(numbers) != len(mesh.points):
            raise InputRefused(
                f"{segments}: no segIndices for each of the {len(mesh.points)} vertices of the "
                "mesh. Download both of one scene. [objects.count]"
            )
        entries, object_of_segment = _groups(groups)
        of_vertex = np.array([object_of_segment.get(number, -1) for number in numbers], np.int64)
        return LabelTable(entries, _of_faces(of_vertex, mesh.triangles))

    return objects


def _groups(path: Path) -> tuple[dict[int, ObjectName], dict[int, int]]:
    """Name and class of each object, and the object of each segment: of several, the smallest.
    Numbers below 0 are no object's, as what is in none has -1."""
    document: Any = read_json(path)
    rows: Any = document.get("segGroups") if isinstance(document, dict) else None
    sound = isinstance(rows, list) and all(
        isinstance(row, dict)
        and type(row.get("objectId", row.get("id"))) is int
        and _are_numbers(row.get("segments"))
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
        if number < 0:
            continue
        entries[number] = ObjectName(f"{label or 'object'}_{number}", label)
        object_of_segment.update(dict.fromkeys(row["segments"], number))
    return entries, object_of_segment


def _are_numbers(listed: object) -> TypeGuard[list[int]]:
    return isinstance(listed, list) and all(type(number) is int for number in listed)


def _of_faces(of_vertex: Long, triangles: Int) -> Long:
    """(F,) what two of a triangle's corners are, else its first."""
    first, second, third = of_vertex[triangles].T
    return np.asarray(np.where(second == third, second, first), np.int64)
