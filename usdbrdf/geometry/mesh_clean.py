"""A scanned mesh without its dead weight: what was removed is counted, what stays is not moved.

NumPy finds what is wrong and with which objects; only these go through pymeshlab.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Bool, Float, Int, Long
from usdbrdf.model.mesh import compact, doubled_areas, welded_ids


@dataclass(frozen=True, kw_only=True)
class CleanMesh:
    """points (V, 3) float32, all used; triangles (F, 3) int32; face_object (F,) int32;
    counts: how many of what were removed or found."""

    points: Float
    triangles: Int
    face_object: Int
    counts: dict[str, int]


def clean_mesh(
    points: Float,
    triangles: Int,
    face_object: Int,
    *,
    decimate: int | None = None,
    label: str = "the mesh",
) -> CleanMesh:
    """Drop triangles without area, repeated triangles and unused vertices; separate the surface
    of an object along edges where more than two of its triangles meet; reduce if asked.

    Positions keep their bits, what stays its order, and objects without damage their vertices. A
    repeated triangle has the same three positions and the same side as an earlier one, of whatever
    object.

    decimate  number of triangles wanted in all; each object is reduced in proportion
    """
    found = _damage(points, triangles, face_object)
    if not found.num_whole:
        raise InputRefused(
            f"{label}: none of the {len(triangles)} faces has an area. Export it again. "
            "[mesh.empty]"
        )
    counts, num_given = found.counts, len(points)
    repaired = np.zeros(0, np.int32)
    if len(found.damaged_sheets):
        points, triangles, origin = _repaired(points, triangles, found, label)
        face_object, repaired = face_object[origin], np.unique(found.damaged_sheets // 2)
    if decimate is not None and decimate < len(triangles):
        points, triangles, face_object = decimated(
            points, triangles, face_object, decimate, label=label, joined=repaired
        )
        num_given = len(points)
        counts["decimated_faces"] = found.num_whole - len(triangles)
    used, points, triangles = compact(points, triangles)
    counts["unreferenced_vertices"] = num_given - int((used < num_given).sum())
    return CleanMesh(
        points=np.ascontiguousarray(points),
        triangles=triangles,
        face_object=face_object,
        counts=counts,
    )


def decimated(
    points: Float,
    triangles: Int,
    face_object: Int,
    target: int,
    *,
    label: str,
    joined: Int | None = None,
    keep_borders: bool = True,
) -> tuple[Float, Int, Int]:
    """Points, triangles and their objects (see ``decimate_objects``) of about ``target`` triangles
    in all, made in a child; ``label`` as messages call the mesh."""
    given = {"points": points, "triangles": triangles, "face_object": face_object}
    none = np.zeros(0, np.int32)
    reduced = run_child(
        function="usdbrdf.geometry.mesh_filters:decimate_objects",
        arrays={**given, "joined": none if joined is None else joined},
        parameters={"target": target, "keep_borders": keep_borders},
        timeout_s=300 + len(triangles) / 2000,
        label=f"{label}: reduction to {target} triangles",
    )
    return reduced["points"], reduced["triangles"], reduced["face_object"]


class _Damage(NamedTuple):
    """What is wrong with a mesh.

    void            (F,) bool: flat, or repeated from another object
    sheet           (F,) int32: 2 x object, + 1 for a face that lies on an earlier one of the same
                    object with its back to it (the two sides of a leaf are two sheets)
    damaged_sheets  numbers of the sheets with something to repair
    num_whole       how many faces are neither flat nor repeated
    """

    void: Bool
    sheet: Int
    damaged_sheets: Int
    num_whole: int
    counts: dict[str, int]


def _damage(points: Float, triangles: Int, face_object: Int) -> _Damage:
    corners = welded_ids(points)[triangles]
    a, b, c = corners.T
    edges = points.astype(np.float64)[triangles]
    longest = np.linalg.norm(np.roll(edges, -1, axis=1) - edges, axis=2).max(axis=1)
    # Relative to the longest edge, so that small scans keep their small triangles.
    flat = doubled_areas(points, triangles) <= 1e-9 * longest**2
    flat |= (a == b) | (b == c) | (c == a)
    turn = (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3
    first = _first_equal(np.take_along_axis(corners, turn, axis=1), ~flat)
    repeated = first != np.arange(len(triangles))
    keep = ~flat & ~repeated
    same_place = np.column_stack([np.sort(corners, axis=1), face_object])
    back = _first_equal(same_place, keep) != np.arange(len(triangles))
    sheet = (2 * face_object + back[first]).astype(np.int32)
    # Of each edge that more than two triangles of one sheet share, that sheet.
    ends = np.sort(corners[keep][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    edge = np.column_stack([np.repeat(sheet[keep], 3), ends[:, 0] << 32 | ends[:, 1]])
    edge = edge[np.lexsort(edge.T[::-1])]
    first_use = np.flatnonzero(np.r_[True, (edge[1:] != edge[:-1]).any(axis=1)])
    branching = edge[first_use[np.diff(first_use, append=len(edge)) > 2], 0]
    counts = {
        "degenerate_faces": int(flat.sum()),
        "duplicate_faces": int(repeated.sum()),
        "nonmanifold_edges": len(branching),
    }
    void = flat | (repeated & (face_object[first] != face_object))
    damaged = np.unique(np.concatenate([sheet[~keep], branching])).astype(np.int32)
    return _Damage(void, sheet, damaged, int(keep.sum()), counts)


def _first_equal(rows: Int, among: Bool) -> Long:
    """(F,) for each row the index of the first equal one, of the rows ``among``; else its own."""
    chosen = np.flatnonzero(among)
    # lexsort is stable: within a group of equal rows the file's order is kept.
    order = chosen[np.lexsort(rows[chosen].T[::-1])]
    again = np.zeros(len(order), np.bool_)
    again[1:] = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
    group = np.maximum.accumulate(np.where(again, 0, np.arange(len(order))))
    first = np.arange(len(rows))
    first[order] = order[group]
    return first


def _repaired(points: Float, triangles: Int, found: _Damage, label: str) -> tuple[Float, Int, Long]:
    """Points, triangles and the input face of each. Copies of vertices are appended."""
    damaged = np.isin(found.sheet, found.damaged_sheets)
    given = triangles[damaged]
    # pymeshlab only knows areas of exactly 0, in one mesh: whatever else is void is made a point.
    given[found.void[damaged]] = given[found.void[damaged], :1]
    result = run_child(
        function="usdbrdf.geometry.mesh_filters:repair_sheets",
        arrays={"points": points, "triangles": given, "sheet": found.sheet[damaged]},
        parameters={},
        timeout_s=300 + len(given) / 2000,
        label=f"{label}: repair of {len(found.damaged_sheets)} damaged objects",
    )
    vertex = result["vertex"]
    copied = np.ones(len(vertex), np.bool_)
    copied[np.unique(vertex, return_index=True)[1]] = False
    number = np.where(copied, len(points) + np.cumsum(copied) - 1, vertex).astype(np.int32)
    origin = np.concatenate([np.flatnonzero(~damaged), np.flatnonzero(damaged)[result["face"]]])
    order = np.argsort(origin)
    both = np.concatenate([triangles[~damaged], number[result["triangles"]]])
    return np.concatenate([points, points[vertex[copied]]]), both[order], origin[order]
