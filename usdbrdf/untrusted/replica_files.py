"""Replica's mesh of labelled polygons, read in a child process: its faces have any number of
corners, which the readers of plain meshes do not take."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double, Long
from usdbrdf.untrusted.bounds import read_in_child

_HEADER_BYTES = 1 << 16
_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4}
_SIZES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4}
_SIZES |= {"double": 8, "float64": 8}


def labelled_faces(path: Path) -> tuple[Double, Long]:
    """Centre (F, 3) and object number (F,) of each polygon of a mesh_semantic.ply."""
    found = read_in_child("mesh", f"{__name__}:read_here", path, tuple)
    return found[0], found[1]


def read_here(path: Path) -> tuple[Double, Long]:
    """``labelled_faces`` in this process, which is to be a child.

    Binary, little endian; vertices begin with x, y, z as floats; a face is a list of corners
    (one byte their number, then four bytes each) and the object's number in two or four bytes.
    """
    stored = path.read_bytes()
    end = stored[:_HEADER_BYTES].find(b"end_header\n") + len(b"end_header\n")
    header = stored[:end].decode("ascii", "replace")
    counts = dict(re.findall(r"element (\w+) (\d{1,10})", header))
    parts = re.split(r"element \w+ \d+", header)
    ids = re.search(r"property (\w+) object_id", header)
    if (
        "format binary_little_endian" not in header
        or list(counts) != ["vertex", "face"]
        or not ids
        or not re.search(r"list (uchar|uint8) (int|uint|int32|uint32) vertex_ind", parts[2])
    ):
        raise _refusal(path, "it is no binary PLY with an object_id for each face")
    widths = [_SIZES.get(kind, 0) for kind in re.findall(r"property (\w+) \w+", parts[1])]
    stride, num_vertices, num_faces = sum(widths), int(counts["vertex"]), int(counts["face"])
    first_face = end + stride * num_vertices
    if not all(widths) or stride < 12 or len(stored) < first_face:
        raise _refusal(path, "it ends within its vertices")
    if num_faces > len(stored) - first_face:  # before anything is made room for
        raise _refusal(path, "it ends within its faces")
    table = np.frombuffer(stored, np.uint8, stride * num_vertices, end).reshape(-1, stride)
    points = np.ascontiguousarray(table[:, :12]).view("<f4").astype(np.float64)
    size_of_id = _SIZES.get(ids[1], 0)
    starts, place = np.zeros(num_faces, np.int64), first_face
    for i in range(num_faces):
        if place >= len(stored):
            raise _refusal(path, "it ends within its faces")
        starts[i] = place
        place += 1 + 4 * stored[place] + size_of_id
    if place > len(stored) or size_of_id not in (2, 4):
        raise _refusal(path, "it ends within its faces")
    return _centres_and_ids(np.frombuffer(stored, np.uint8), starts, points, size_of_id, path)


def _centres_and_ids(
    stored: np.ndarray[tuple[int], np.dtype[np.uint8]],
    starts: Long,
    points: Double,
    size_of_id: int,
    path: Path,
) -> tuple[Double, Long]:
    corners = stored[starts].astype(np.int64)
    centre, number = np.zeros((len(starts), 3)), np.zeros(len(starts), np.int64)
    for count in np.unique(corners).tolist():
        own = np.flatnonzero(corners == count)
        here = starts[own, None] + 1 + np.arange(4 * count + size_of_id)
        rows = np.ascontiguousarray(stored[here])
        index = np.ascontiguousarray(rows[:, : 4 * count]).view("<u4").astype(np.int64)
        if count < 3 or index.max(initial=0) >= len(points):
            raise _refusal(path, "faces have less than three corners or none that exist")
        centre[own] = points[index].mean(axis=1)
        number[own] = np.ascontiguousarray(rows[:, 4 * count :]).view(f"<u{size_of_id}")[:, 0]
    if not np.isfinite(centre).all():
        raise _refusal(path, "faces have corners that are NaN or infinite")
    return centre, number


def _refusal(path: Path, why: str) -> InputRefused:
    return InputRefused(
        f"{path}: damaged, {why}. Bring the file of the dataset again. [objects.format]"
    )
