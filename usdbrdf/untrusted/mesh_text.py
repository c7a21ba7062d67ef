"""What trimesh makes something else of than PLY and OBJ files say: polygons of several sizes in a
binary PLY, and vertices that an OBJ counts backwards or writes in other ways than most."""

from __future__ import annotations

import codecs
import re
import struct
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np

_BACKWARDS = re.compile(rb"^[ \t]*f[ \t][^\n]*[ \t]-\d", re.MULTILINE)
_NOUGHT = re.compile(rb"^[ \t]*f[ \t](?:[^\n]*[ \t])?0+[/ \t\r\n]", re.MULTILINE)
_REMARK = re.compile(rb"^([ ]*(?:v[tn]?|f) [^\n#]*)#[^\n]*", re.MULTILINE)
# PLY's names of numbers, as struct spells them.
_KINDS = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h",
    "ushort": "H", "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
_LONGEST_HEADER = 1 << 16


def obj_counted_forwards(file: BinaryIO) -> BinaryIO:
    """An OBJ all of whose faces count vertices from the first one on. Its format lets them count
    back from where they stand; trimesh would count from the end of the file. It would also pass
    over lines whose words tabs part, or that a mark of UTF-8 begins, and stumble over remarks.

    Raises ValueError for a vertex 0, which would be taken for the last one.
    """
    content = file.read().removeprefix(codecs.BOM_UTF8).replace(b"\t", b" ")
    if b" #" in content:
        content = _REMARK.sub(rb"\1", content)
    if _NOUGHT.search(content):
        raise ValueError("a face has a vertex 0, but OBJ counts from 1")
    if not _BACKWARDS.search(content):
        return BytesIO(content)
    there = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = []
    for line in re.sub(rb"\\\r?\n", b" ", content).splitlines():
        key, *rest = line.split() or [b""]
        if key in there:
            there[key] += 1
        elif key == b"f":
            line = b" ".join([key, *(_forwards(corner, there) for corner in rest)])
        lines.append(line)
    return BytesIO(b"\n".join(lines) + b"\n")


def _forwards(corner: bytes, there: dict[bytes, int]) -> bytes:
    counted = []
    for number, known in zip(corner.split(b"/"), there.values(), strict=False):
        index = int(number or 0)
        if index < 0:
            index += known + 1
            if index < 1:
                raise ValueError("a face counts back to before the first vertex")
        counted.append(str(index).encode() if number else b"")
    return b"/".join(counted)


def binary_ply_of_polygons(file: BinaryIO) -> tuple[Any, Any, dict[str, Any]]:
    """Points (V, 3), triangles (F, 3) and the other single numbers of each triangle's face, by
    name, of a binary PLY whose faces have three or four corners each.

    Raises ValueError for what is none, or ends early.
    """
    file.seek(0)
    content = file.read()
    end = re.search(rb"end_header\r?\n", content[:_LONGEST_HEADER])
    if end is None:
        raise ValueError("no end of its header")
    header = content[: end.start()].decode("ascii", "replace").splitlines()
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(
        next((line.split()[1] for line in header if line.startswith("format ")), "")
    )
    if order is None:
        raise ValueError("it is no binary PLY")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in (line.split() for line in header):
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    place, points, faces = end.end(), None, None
    for name, count, properties in elements:
        if not 0 <= count <= len(content):
            raise ValueError(f"it announces {count} elements {name!r} in {len(content)} bytes")
        if name == "face":
            faces, place = _faces(content, place, count, properties, order)
            continue
        if any(words[0] == "list" for words in properties):
            raise ValueError(f"the element {name!r} has lists")
        row = np.dtype([(words[1], order + _KINDS[words[0]]) for words in properties])
        if place + count * row.itemsize > len(content):
            raise ValueError(f"it ends before its {count} elements {name!r}")
        if name == "vertex":
            rows = np.frombuffer(content, row, count, place)
            points = np.column_stack([rows[axis] for axis in "xyz"])
        place += count * row.itemsize
    if points is None or faces is None:
        raise ValueError("no vertices or no faces")
    return points, *faces


def _faces(
    content: bytes, place: int, count: int, properties: list[list[str]], order: str
) -> tuple[tuple[Any, dict[str, Any]], int]:
    """Triangles and their faces' numbers, and where the element ends."""
    triangles: list[tuple[int, ...]] = []
    numbers: dict[str, list[Any]] = {words[1]: [] for words in properties if words[0] != "list"}
    single = {k: struct.Struct(order + k) for k in set(_KINDS.values())}
    for _ in range(count):
        pieces, said = 1, {}
        for words in properties:
            if words[0] != "list":
                kind = single[_KINDS[words[0]]]
                said[words[1]] = _unpacked(kind, content, place)[0]
                place += kind.size
                continue
            kind = single[_KINDS[words[1]]]
            (corners,) = _unpacked(kind, content, place)
            place += kind.size
            size = single[_KINDS[words[2]]].size
            if words[3] in ("vertex_indices", "vertex_index"):
                if corners not in (3, 4):
                    raise ValueError(f"a face has {corners} corners")
                row = struct.unpack_from(f"{order}{corners}{_KINDS[words[2]]}", content, place)
                triangles.append(row[:3])
                if corners == 4:
                    triangles.append((row[0], row[2], row[3]))
                    pieces = 2
            elif corners < 0:
                raise ValueError(f"a list has {corners} elements")
            place += int(corners) * size
        for name, number in said.items():
            numbers[name] += [number] * pieces
    if place > len(content):
        raise ValueError("it ends before its last face")
    return (np.array(triangles).reshape(-1, 3), {k: np.array(v) for k, v in numbers.items()}), place


def _unpacked(kind: struct.Struct, content: bytes, place: int) -> tuple[Any, ...]:
    if place + kind.size > len(content):
        raise ValueError("it ends within a face")
    return kind.unpack_from(content, place)
