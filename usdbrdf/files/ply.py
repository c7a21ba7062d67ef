"""Meshes as binary PLY, the one mesh format that we write."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.model.arrays import Float, Int


def write_ply(path: Path, points: Float, triangles: Int, face_object: Int) -> None:
    """Write points (V, 3) float32 and triangles (F, 3) with an object number each, (F,), as the
    face property ``object_id``; positions keep their bits."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\n"
        "property list uchar int vertex_indices\nproperty int object_id\nend_header\n"
    )
    face = np.dtype([("count", "u1"), ("corners", "<i4", 3), ("object_id", "<i4")])
    faces = np.zeros(len(triangles), face)
    faces["count"], faces["corners"], faces["object_id"] = 3, triangles, face_object
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.ascontiguousarray(points, "<f4").tobytes())
        file.write(faces.tobytes())
