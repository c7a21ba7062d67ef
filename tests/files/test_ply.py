"""Meshes as we write them, byte by byte."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from usdbrdf.files.ply import write_ply


@pytest.mark.parametrize("faces", [0, 2])
def test_points_triangles_and_objects_are_written_as_they_are(tmp_path, faces):
    points = np.array([[0.1, -2.0, 3e7], [1 / 3, 0, 1e-38], [4, 5, 6], [7, 8, 9]], np.float32)
    triangles = np.array([[0, 1, 2], [3, 2, 70000]], np.int32)[:faces]
    write_ply(tmp_path / "a.ply", points, triangles, np.array([5, 65534], np.int32)[:faces])
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {faces}\n"
        "property list uchar int vertex_indices\nproperty int object_id\nend_header\n"
    )
    written = header.encode() + struct.pack("<12f", *points.ravel())
    for corners, number in list(zip(triangles.tolist(), (5, 65534), strict=False)):
        written += struct.pack("<B4i", 3, *corners, number)
    assert (tmp_path / "a.ply").read_bytes() == written
