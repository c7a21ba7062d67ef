"""pymeshlab's filters on the objects of a scan; run in a child process, for they crash and hang.

pymeshlab is licensed under the GPL and imported here alone, by the child: we only exchange arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Array
from usdbrdf.model.mesh import compact, joined, welded_ids

# No object is reduced below this, or small ones would vanish beside a large one.
_MIN_TRIANGLES = 32


def repair_sheets(arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """Drop null and repeated faces, and separate the surface where more than two faces meet.

    points (V, 3) float32; triangles (F, 3) int32; sheet (F,) int32: each is repaired by itself,
    and in one sheet faces with the same three positions count as the same whatever their side.

    Returns no positions but where things came from: vertex (W,) int32, the input vertex at whose
    position each output vertex lies; triangles (G, 3) int32 into those; face (G,) int32, the input
    face that each output face was.
    """
    points, triangles, sheet = (arrays[k] for k in ("points", "triangles", "sheet"))
    parts, origins = [], []
    for index in np.unique(sheet):
        own = np.flatnonzero(sheet == index)
        used, own_points, corners = compact(points, triangles[own])
        vertex, faces, origin = _repaired(own_points, corners)
        parts.append((used[vertex], faces))
        origins.append(own[origin])
    vertex, faces, _ = joined(parts)
    return {
        "vertex": vertex.astype(np.int32),
        "triangles": faces,
        "face": np.concatenate(origins, dtype=np.int32),
    }


def _repaired(points: Array, triangles: Array) -> tuple[Array, Array, Array]:
    """(input vertex of each output vertex, output faces, input face of each output face)."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    # The scalars are names that the filters carry along with what they keep or copy.
    meshes.add_mesh(
        pymeshlab.Mesh(
            points.astype(np.float64),
            triangles,
            v_scalar_array=np.arange(len(points), dtype=np.float64),
            f_scalar_array=np.arange(len(triangles), dtype=np.float64),
        )
    )
    # Exporters split vertices at seams; only joined ones show which faces are neighbours.
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_null_faces()
    if meshes.current_mesh().face_number() == 0:
        return np.zeros(0, np.int32), np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_repair_non_manifold_edges(method="Split Vertices")
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    return (
        mesh.vertex_scalar_array().astype(np.int32),
        mesh.face_matrix(),
        mesh.face_scalar_array().astype(np.int32),
    )


def decimate_objects(
    arrays: Mapping[str, Array], parameters: Mapping[str, Any]
) -> dict[str, Array]:
    """Quadric edge collapse, object by object, to ``target`` triangles in all. With
    ``keep_borders`` borders stay as they are, so that objects do not come apart where they touch;
    without they are reduced too, so that few triangles need not all go to them.

    points (V, 3) float32; triangles (F, 3) int32; face_object (F,) int32; joined (J,) int32:
    objects whose neighbouring faces share vertices already. Returns the first three anew.
    """
    import pymeshlab

    points, triangles, face_object = (arrays[k] for k in ("points", "triangles", "face_object"))
    share, keep = parameters["target"] / len(triangles), bool(parameters["keep_borders"])
    objects = np.unique(face_object)
    parts: list[tuple[Array, Array]] = []
    for index in objects:
        _, own, corners = compact(points, triangles[face_object == index])
        if index not in arrays["joined"]:  # edges must be shared to be collapsed
            ids = welded_ids(own)
            _, first, shared = np.unique(ids, return_index=True, return_inverse=True)
            own, corners = own[first], shared[corners].astype(np.int32)
        target = max(_MIN_TRIANGLES, round(share * len(corners)))
        if target < len(corners):
            meshes = pymeshlab.MeshSet()
            meshes.add_mesh(pymeshlab.Mesh(own.astype(np.float64), corners))
            meshes.meshing_decimation_quadric_edge_collapse(
                targetfacenum=target, preserveboundary=keep, boundaryweight=2.0 if keep else 100.0,
                preservenormal=True, planarquadric=True, autoclean=True,
            )  # fmt: skip
            mesh = meshes.current_mesh()
            own, corners = mesh.vertex_matrix().astype(np.float32), mesh.face_matrix()
        parts.append((own, corners))
    points, triangles, part = joined(parts)
    return {"points": points, "triangles": triangles, "face_object": objects[part].astype(np.int32)}
