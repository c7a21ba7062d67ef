"""The objects of Replica's scenes, and their panes of glass and mirrors.

The objects' numbers stand at the faces of another mesh (habitat/mesh_semantic.ply) than mesh.ply:
each face here takes that of the nearest face there. Panes and mirrors (glass.sur) are planes; faces
on them are objects of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.capture.mesh_frames import LabelTable
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.model.arrays import Bool, Double, Long
from usdbrdf.model.mesh import ObjectName
from usdbrdf.untrusted.mesh_files import FileMesh
from usdbrdf.untrusted.replica_files import labelled_faces

# Metres from a pane within which a face is on it; the scans' faces are larger.
_GAP = 0.01


def semantic_files(mesh: Path) -> list[Path]:
    """What ``semantics_beside`` a mesh reads, as far as it is there."""
    names = ("habitat/info_semantic.json", "habitat/mesh_semantic.ply", "glass.sur")
    return [file for name in names if (file := mesh.parent / name).is_file()]


def semantics_beside(mesh: Path) -> Callable[[FileMesh], LabelTable] | None:
    """What knows the objects of a scene's mesh.ply by the files that lie beside it; None where
    these are missing."""
    info = mesh.parent / "habitat" / "info_semantic.json"
    if mesh.suffix.lower() != ".ply" or not info.is_file():
        return None

    def objects(found: FileMesh) -> LabelTable:
        entries = _entries(info)
        centre_there, number_there = labelled_faces(info.with_name("mesh_semantic.ply"))
        if len(centre_there) == 0:
            return LabelTable(entries, None)
        centre = found.points[found.triangles].astype(np.float64).mean(axis=1)
        number = number_there[cKDTree(centre_there).query(centre)[1]]
        glass = mesh.parent / "glass.sur"
        if glass.is_file():
            first = int(max([*entries, *number.tolist()], default=0)) + 1
            for i, on_pane in enumerate(_panes(glass, found)):
                if on_pane.any():
                    number[on_pane] = first + i
                    entries[first + i] = ObjectName(f"pane_{i + 1}", "glass")
        return LabelTable(entries, number)

    return objects


def _entries(info: Path) -> dict[int, ObjectName]:
    document: Any = read_json(info)
    rows: Any = document.get("objects") if isinstance(document, dict) else None
    sound = isinstance(rows, list) and all(
        isinstance(row, dict) and type(row.get("id")) is int for row in rows
    )
    if not sound:
        raise InputRefused(
            f'{info}: no list "objects" with an id each. Bring the file of the dataset. '
            "[objects.format]"
        )
    classes = {row["id"]: str(row.get("class_name") or "") for row in rows}
    return {n: ObjectName(f"{name or 'object'}_{n}", name) for n, name in classes.items()}


def _panes(glass: Path, mesh: FileMesh) -> list[Bool]:
    """Of each plane, the triangles that lie on it, within its border."""
    document: Any = read_json(glass)
    planes = document if isinstance(document, list) else []
    corner = mesh.points[mesh.triangles].astype(np.float64)
    centre, across = (
        corner.mean(axis=1),
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]),
    )
    found = []
    for plane in planes:
        equation = _numbers(plane, "plane_w", (4,))
        border = _numbers(plane, "boundary_w", (-1, 3))
        if equation is None or border is None or len(border) < 3:
            raise InputRefused(
                f"{glass}: a plane without plane_w and boundary_w. Bring the file of the dataset. "
                "[objects.format]"
            )
        normal = equation[:3] / np.linalg.norm(equation[:3])
        # The border's centre is on the plane, whatever the sign of the equation's last number.
        height = (corner - border.mean(axis=0)) @ normal
        flat = np.abs(across @ normal) > 0.9 * np.linalg.norm(across, axis=1)
        on = (np.abs(height) <= _GAP).all(axis=1) & flat
        on[on] = _inside(centre[on], border, normal)
        found.append(on)
    return found


def _numbers(row: Any, key: str, shape: tuple[int, ...]) -> Double | None:
    try:
        values = np.array(row[key], np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() and values.size else None


def _inside(points: Double, border: Double, normal: Double) -> Bool:
    """(P,) whether points on a plane are inside a polygon on it, by the parity of crossings."""
    along = np.linalg.svd(normal[None])[2][1:]
    x, y = ((points - border[0]) @ along.T).T
    corners: Double = (border - border[0]) @ along.T
    crossings: Long = np.zeros(len(points), np.int64)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay != by:
            between = (ay > y) != (by > y)
            crossings += between & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return np.asarray(crossings % 2 == 1)
