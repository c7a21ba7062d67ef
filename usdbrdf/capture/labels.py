"""Which object each triangle belongs to, from labels or, without them, from connectivity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.naming import unique_identifiers
from usdbrdf.model.arrays import Int
from usdbrdf.model.mesh import ObjectLabel, doubled_areas, welded_ids
from usdbrdf.untrusted.mesh_files import FileMesh

_MAX_OBJECTS = 65_535
_UNLABELLED = "unlabelled"


@dataclass(frozen=True, kw_only=True)
class LabelTable:
    """What objects.json says: label and class of each id, and optionally an id per face."""

    entries: Mapping[int, tuple[str, str]]
    face_id: npt.NDArray[np.int64] | None = None


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """face_object (F,) int32, index into ``labels``, which are (label, class name)."""

    face_object: Int
    labels: tuple[tuple[str, str], ...]


def label_table(path: Path) -> LabelTable:
    """Read ``{"objects": [{"id", "name", "class_name"}], "face_object_id": [...]}``."""
    document = read_json(path)
    rows = document.get("objects") if isinstance(document, dict) else None
    if not isinstance(rows, list):
        raise InputRefused(f'{path}: no list "objects". See the example capture. [objects.format]')
    entries: dict[int, tuple[str, str]] = {}
    for row in rows:
        number = row.get("id") if isinstance(row, dict) else None
        if not isinstance(number, int) or isinstance(number, bool):
            raise InputRefused(
                f"{path}: the object {str(row)[:80]!r} has no whole number as id. Give every "
                "object an id. [objects.format]"
            )
        if number in entries:
            raise InputRefused(f"{path}: the id {number} occurs twice. Keep one. [objects.format]")
        names = [row.get(key) or "" for key in ("name", "class_name")]
        if not all(isinstance(name, str) for name in names):
            raise InputRefused(
                f"{path}: name and class_name of object {number} must be strings. [objects.format]"
            )
        entries[number] = (names[0] or f"object_{number}", names[1])
    return LabelTable(entries=entries, face_id=_face_ids(document, path))


def _face_ids(document: Mapping[str, Any], path: Path) -> npt.NDArray[np.int64] | None:
    ids = document.get("face_object_id")
    if ids is None:
        return None
    if not isinstance(ids, list) or not all(type(number) is int for number in ids):
        raise InputRefused(
            f'{path}: "face_object_id" is not a list of whole numbers. [objects.format]'
        )
    return np.array(ids, np.int64)


def segmentation(
    mesh: FileMesh, table: LabelTable | None, *, table_path: Path | None, min_area: float
) -> Segmentation:
    """Objects of a mesh: by the table's or the file's labels, else by connected parts.

    Ids without an entry are called ``object_<id>``; negative ids mean unlabelled. Parts smaller
    than ``min_area`` (scene units squared) are gathered in one object, ``rest``.
    """
    face_id = mesh.face_label
    if table is not None and table.face_id is not None:
        kept = mesh.kept if mesh.kept is not None else np.ones(len(mesh.triangles), np.bool_)
        if len(table.face_id) != len(kept):
            raise InputRefused(
                f"{table_path}: {len(table.face_id)} face labels for a mesh of {len(kept)} "
                "triangles. Write one object id per triangle of this mesh. [objects.count]"
            )
        face_id = table.face_id[kept]
    if face_id is None:
        return _connected_parts(mesh, min_area)
    face_id = np.where(face_id < 0, -1, face_id)
    ids, face_object = np.unique(face_id, return_inverse=True)
    if len(ids) > _MAX_OBJECTS:
        raise InputRefused(
            f"{table_path or 'the mesh'}: {len(ids)} different object ids (limit {_MAX_OBJECTS}). "
            "These do not look like objects. [objects.limit]"
        )
    entries = table.entries if table is not None else {}
    labels = [
        (_UNLABELLED, "")
        if number < 0
        else entries.get(number, (mesh.label_names.get(number, f"object_{number}"), ""))
        for number in ids.tolist()
    ]
    return Segmentation(face_object=face_object.astype(np.int32), labels=tuple(labels))


def _connected_parts(mesh: FileMesh, min_area: float) -> Segmentation:
    """Parts joined by position, largest first; one object where no second one is large enough."""
    corners = welded_ids(mesh.points)[mesh.triangles]
    count = int(corners.max()) + 1
    links = coo_array(
        (
            np.ones(2 * len(corners), np.int8),
            (np.repeat(corners[:, 0], 2), corners[:, 1:].reshape(-1)),
        ),
        shape=(count, count),
    )
    _, part_of_point = connected_components(links, directed=False)
    parts, part_of_face = np.unique(part_of_point[corners[:, 0]], return_inverse=True)
    area = np.bincount(
        part_of_face, weights=doubled_areas(mesh.points, mesh.triangles) / 2, minlength=len(parts)
    )
    order = np.argsort(-area, kind="stable")
    large = order[area[order] >= min_area][:_MAX_OBJECTS]
    if len(large) < 2:
        return Segmentation(
            face_object=np.zeros(len(mesh.triangles), np.int32), labels=(("scan", ""),)
        )
    object_of_part = np.full(len(parts), len(large), np.int32)
    object_of_part[large] = np.arange(len(large), dtype=np.int32)
    labels = [(f"part_{i + 1:03d}", "") for i in range(len(large))]
    if len(large) < len(parts):
        labels.append(("rest", ""))
    return Segmentation(face_object=object_of_part[part_of_face], labels=tuple(labels))


def objects_with_faces(
    face_object: Int, labels: tuple[tuple[str, str], ...]
) -> tuple[Int, tuple[ObjectLabel, ...]]:
    """Objects that still own a triangle, with unique identifiers, and the renumbered faces."""
    used, renumbered = np.unique(face_object, return_inverse=True)
    kept = [labels[i] for i in used.tolist()]
    identifiers = unique_identifiers([label for label, _ in kept])
    objects = tuple(
        ObjectLabel(identifier=identifier, label=label, class_name=class_name)
        for identifier, (label, class_name) in zip(identifiers, kept, strict=True)
    )
    return renumbered.astype(np.int32), objects
