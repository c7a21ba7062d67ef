"""A scanned mesh without its dead weight: what was removed is counted, what stays is untouched.

pymeshlab is licensed under the GPL; it is imported only in the child process that reduces meshes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import InputRefused
from usdbrdf.geometry.weld import welded_ids
from usdbrdf.job.child import run_child

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# No object is reduced below this, or small ones would vanish beside a large one.
_MIN_TRIANGLES = 32


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
    """Drop triangles without area, repeated triangles and unused vertices; reduce if asked.

    Vertices that stay keep their bits and their order. A repeated triangle has the same three
    positions and the same side as an earlier one, of whatever object.

    decimate  number of triangles wanted in all; each object is reduced in proportion
    label     what the mesh is called in messages
    """
    counts: dict[str, int] = {}
    position = welded_ids(points)
    corners = position[triangles]
    keep = _has_area(points, triangles, corners)
    counts["degenerate_faces"] = int((~keep).sum())
    repeated = keep & _repeated(corners, keep)
    counts["duplicate_faces"] = int(repeated.sum())
    keep &= ~repeated
    if not keep.any():
        raise InputRefused(
            f"{label}: none of the {len(triangles)} faces has an area. Export it again. "
            "[mesh.empty]"
        )
    counts["nonmanifold_edges"] = _nonmanifold_edges(corners[keep])
    triangles, face_object = triangles[keep], face_object[keep]
    if decimate is not None and decimate < len(triangles):
        before = len(triangles)
        points, triangles, face_object = _decimated(points, triangles, face_object, decimate, label)
        counts["decimated_faces"] = before - len(triangles)
    used, compact = np.unique(triangles, return_inverse=True)
    counts["unreferenced_vertices"] = len(points) - len(used)
    return CleanMesh(
        points=np.ascontiguousarray(points[used]),
        triangles=compact.reshape(-1, 3).astype(np.int32),
        face_object=face_object,
        counts=counts,
    )


def _has_area(points: Float, triangles: Int, corners: Int) -> Bool:
    a, b, c = corners.T
    distinct: Bool = (a != b) & (b != c) & (c != a)
    p = points.astype(np.float64)[triangles]
    longest = np.linalg.norm(np.roll(p, -1, axis=1) - p, axis=2).max(axis=1)
    twice_area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    # Relative to the longest edge, so that small scans keep their small triangles.
    flat: Bool = twice_area <= 1e-9 * longest**2
    return distinct & ~flat


def _repeated(corners: Int, among: Bool) -> Bool:
    """True for every triangle but the first of those with equal corners in equal cyclic order."""
    first = corners.argmin(axis=1)
    cyclic = np.take_along_axis(corners, (first[:, None] + np.arange(3)) % 3, axis=1)
    rows = np.flatnonzero(among)
    # lexsort is stable: within a group of equal triangles the file's order is kept.
    order = rows[np.lexsort(cyclic[rows].T[::-1])]
    again = (cyclic[order[1:]] == cyclic[order[:-1]]).all(axis=1)
    repeated = np.zeros(len(corners), np.bool_)
    repeated[order[1:]] = again
    return repeated


def _nonmanifold_edges(corners: Int) -> int:
    """Edges shared by more than two triangles."""
    edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    _, uses = np.unique(edges[:, 0] << 32 | edges[:, 1], return_counts=True)
    return int((uses > 2).sum())


def _decimated(
    points: Float, triangles: Int, face_object: Int, target: int, label: str
) -> tuple[Float, Int, Int]:
    """Quadric edge collapse, object by object, in a child process: it may crash or hang."""
    reduced = run_child(
        function="usdbrdf.geometry.mesh_clean:decimate_objects",
        arrays={"points": points, "triangles": triangles, "face_object": face_object},
        parameters={"target": target},
        timeout_s=60 + len(triangles) / 2000,
        label=f"{label}: reduction to {target} triangles",
    )
    return reduced["points"], reduced["triangles"], reduced["face_object"]


def decimate_objects(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """The child's part. Borders are kept, so that objects do not come apart where they touch."""
    import pymeshlab

    points, triangles, face_object = (arrays[k] for k in ("points", "triangles", "face_object"))
    share = parameters["target"] / len(triangles)
    parts: list[tuple[npt.NDArray[Any], npt.NDArray[Any], int]] = []
    for index in np.unique(face_object):
        own = triangles[face_object == index]
        target = max(_MIN_TRIANGLES, round(share * len(own)))
        part = _welded_part(points, own)
        if target < len(own):
            meshes = pymeshlab.MeshSet()
            meshes.add_mesh(pymeshlab.Mesh(part[0].astype(np.float64), part[1]))
            meshes.meshing_decimation_quadric_edge_collapse(
                targetfacenum=target, preserveboundary=True, boundaryweight=2.0,
                preservenormal=True, planarquadric=True, autoclean=True,
            )  # fmt: skip
            mesh = meshes.current_mesh()
            part = (mesh.vertex_matrix().astype(np.float32), mesh.face_matrix())
        parts.append((*part, int(index)))
    firsts = np.cumsum([0, *[len(p) for p, _, _ in parts]])
    return {
        "points": np.concatenate([p for p, _, _ in parts]),
        "triangles": np.concatenate(
            [f + firsts[i] for i, (_, f, _) in enumerate(parts)], dtype=np.int32
        ),
        "face_object": np.repeat(
            np.array([index for _, _, index in parts], np.int32), [len(f) for _, f, _ in parts]
        ),
    }


def _welded_part(
    points: npt.NDArray[Any], triangles: npt.NDArray[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """One object's own vertices, joined by position: edges must be shared to be collapsed."""
    used, corners = np.unique(triangles, return_inverse=True)
    own = points[used]
    _, first, joined = np.unique(welded_ids(own), return_index=True, return_inverse=True)
    return own[first], joined[corners.reshape(-1, 3)].astype(np.int32)
