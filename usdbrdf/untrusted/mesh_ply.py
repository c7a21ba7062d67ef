"""PLY files, text and binary, with faces of any number of corners, and as trimesh reads them: it
joins or refuses polygons, and stumbles over what text may hold."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Array, Double, Long
from usdbrdf.model.mesh import Triangulation, triangulate
from usdbrdf.untrusted.mesh_text import in_utf8
from usdbrdf.untrusted.ply_numbers import KINDS, Column, Numbers, Text, element, numbers_behind

_NAMES = {kind: name for name, kind in reversed(KINDS.items())}
_BEGINNING = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")
LONGEST_HEADER = 1 << 16
_CORNERS, _UV = ("vertex_indices", "vertex_index"), "texcoord"
_STRIPS = "tristrips"  # in place of faces, as Stanford's scans have them
# Columns of a file's rows beside those that it names itself: no word of a header has blanks.
_COUNT, _FACE, _UV_COUNT, _FACE_UV = "corners of each", "the corners", "uv of each", "the uv"


@dataclass(frozen=True, kw_only=True)
class Ply:
    """The vertices and faces of a PLY.

    vertices  of each property its numbers (V,), as they are stored
    counts    (P,) corners of each face
    corners   (C,) int64 vertices of all faces' corners, -1 for what no mesh can have
    faces     of each single property of faces its numbers (P,)
    corner_uv (C, 2) texture coordinates of the corners, None where not all have some
    texture   the picture that the header names, "" for none
    """

    vertices: dict[str, Array]
    counts: Long
    corners: Long
    faces: dict[str, Array]
    corner_uv: Double | None = None
    texture: str = ""

    @property
    def points(self) -> Array:
        """(V, 3) of the vertices' own kind."""
        return np.column_stack([self.vertices[axis] for axis in "xyz"])

    @property
    def triangulation(self) -> Triangulation:
        """Triangles in place of the faces, with -1 for vertices that do not exist."""
        points = self.points
        there = (self.corners >= 0) & (self.corners < len(points))
        if not len(points):
            return triangulate(self.counts, np.full_like(self.corners, -1))
        cut = triangulate(self.counts, np.where(there, self.corners, 0), points=points)
        corners = np.where(there, self.corners, -1).astype(np.int32)
        return replace(cut, triangles=corners[cut.corners])

    def as_trimesh_reads_it(self) -> BytesIO:
        """A binary PLY of triangles with the same properties."""
        fans = self.triangulation
        head = ["ply", "format binary_little_endian 1.0"]
        head += [f"comment TextureFile {self.texture}"] if self.texture else []
        head += [f"element vertex {len(self.points)}", *map(_property, self.vertices.items())]
        head += [f"element face {len(fans.triangles)}", "property list uchar int vertex_indices"]
        others = {name: a for name, a in self.faces.items() if name not in (*_CORNERS, _UV)}
        face: dict[str, Array] = {name: a[fans.polygon] for name, a in others.items()}
        head += map(_property, face.items())
        row: list[Any] = [(_COUNT, "u1"), (_FACE, "<i4", 3)]
        row += [(name, array.dtype.newbyteorder("<")) for name, array in face.items()]
        if self.corner_uv is not None:
            head.append(f"property list uchar float {_UV}")
            row += [(_UV_COUNT, "u1"), (_FACE_UV, "<f4", 6)]
        rows = np.zeros(len(fans.triangles), np.dtype(row))
        rows[_COUNT], rows[_FACE] = 3, fans.triangles
        for name, array in face.items():
            rows[name] = array
        if self.corner_uv is not None:
            rows[_UV_COUNT] = 6
            rows[_FACE_UV] = self.corner_uv[fans.corners].reshape(-1, 6)
        columns = [(name, a.dtype.newbyteorder("<")) for name, a in self.vertices.items()]
        vertices = np.zeros(len(self.points), np.dtype(columns))
        for name, array in self.vertices.items():
            vertices[name] = array
        text = "\n".join([*head, "end_header", ""]).encode()
        return BytesIO(text + vertices.tobytes() + rows.tobytes())


def _property(named: tuple[str, Array]) -> str:
    name, array = named
    return f"property {_NAMES[array.dtype.str[1:]]} {name}"


_LABEL = re.compile(
    rb"property[ \t]+u?(?:char|short|int)\d*[ \t]+(\w*(?:label|object|segment|instance|class)\w*)",
    re.IGNORECASE,
)


def holds_points_alone(content: bytes) -> bool:
    """Whether a PLY has no faces, by its header, which the content need not go beyond."""
    head = _header(content)
    faces = re.search(rb"[\r\n]element[ \t]+(face|tristrips)[ \t]+0*[1-9]", head)
    return _BEGINNING.match(head) is not None and faces is None


def holds_splats(content: bytes) -> bool:
    """Whether its vertices are Gaussians, as they are trained, or as they are packed, and no
    mesh's."""
    gaussian = re.search(rb"property[ \t]+\w+[ \t]+(f_dc_0|packed_position)\b", _header(content))
    return gaussian is not None and holds_points_alone(content)


def whole_number_of_faces(content: bytes) -> str:
    """What a whole number of each face is called that may be the label of its object, by the
    header; "" without one."""
    head = _header(content)
    faces = re.search(rb"[\r\n]element[ \t]+face\b(.*?)(?:[\r\n]element|\Z)", head, re.DOTALL)
    found = _LABEL.search(faces[1]) if faces else None
    return found[1].decode("ascii", "replace") if found else ""


def _header(content: bytes) -> bytes:
    """Nothing where it does not end."""
    return content[: max(0, content.find(b"end_header", 0, LONGEST_HEADER))]


def ply_of(content: bytes) -> Ply:
    """What the bytes of a PLY say. ValueError for what is none, says less than it announces, or
    more: its numbers are not those that its header is for then."""
    content = in_utf8(content)
    beginning = _BEGINNING.match(content)
    if beginning is None:
        raise ValueError("it does not begin with a line 'ply'")
    # After lines that a CR alone ends the numbers may begin with what looks like a LF.
    end = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:" + beginning[1] + rb"|\r\n|\n)")
    last = end.search(content, 0, LONGEST_HEADER)
    if last is None:
        raise ValueError("no end of its header")
    header = re.split(r"[\r\n]+", _decoded(content[: last.start()]))
    elements = _elements(header)
    for name, count, _ in elements:
        if not 0 <= count <= len(content):
            raise ValueError(f"it announces {count} elements {name[:40]!r} in {len(content)} bytes")
        if name in ("vertex", "face", _STRIPS) and sum(name == other for other, *_ in elements) > 1:
            raise ValueError(f"its header has more than one element {name!r}")
    numbers = numbers_behind(header, content, last.end())
    try:
        read = _read(numbers, elements)
    except ValueError:
        start = last.end()
        text = isinstance(numbers, Text) and _without_more_columns(content[start:], elements)
        if not text:
            raise
        read = _read(Text(text), elements)
    vertex = {name: c.flat for name, c in read.get("vertex", {}).items() if not c.is_list}
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("it has no vertices with x, y and z")
    of_strips = not _rows(read.get("face", {})) and _rows(read.get(_STRIPS, {})) > 0
    face = read.get(_STRIPS if of_strips else "face", {})
    lists = {name: column for name, column in face.items() if column.is_list}
    listed = next((lists[name] for name in _CORNERS if name in lists), None)
    if listed is None:
        if face:
            raise ValueError(f"its faces have no list {_CORNERS[0]}")
        listed = Column(counts=np.zeros(0, np.int64), flat=np.zeros(0, np.int64), is_list=True)
    if listed.flat.dtype.kind == "f":
        broken = np.isfinite(listed.flat) & (np.floor(listed.flat) != listed.flat)
        if broken.any():
            raise ValueError(f"a face has the vertex {listed.flat[broken][0]:g}")
    whole = np.abs(listed.flat.astype(np.float64)) <= np.iinfo(np.int32).max
    corners = np.where(whole, listed.flat, -1).astype(np.int64)
    if of_strips:
        triangles = _triangles_of_strips(listed.counts, corners)
        return Ply(
            vertices=vertex,
            counts=np.full(len(triangles), 3, np.int64),
            corners=triangles.reshape(-1),
            faces={},
        )
    uv = lists.get(_UV)
    each = uv is not None and bool((uv.counts == 2 * listed.counts).all())
    textures = (line.split(None, 2)[2] for line in header if _names_texture(line))
    return Ply(
        vertices=vertex,
        counts=listed.counts,
        corners=corners,
        faces={name: c.flat for name, c in face.items() if not c.is_list},
        corner_uv=uv.flat.reshape(-1, 2).astype(np.float64) if uv is not None and each else None,
        texture=next(textures, "").strip(),
    )


def _rows(element: dict[str, Column]) -> int:
    return len(next(iter(element.values())).counts) if element else 0


def _triangles_of_strips(counts: Long, corners: Long) -> Long:
    """(T, 3) of strips in which each vertex makes a triangle with the two before it, every other
    one wound the other way; what is below 0 ends one and begins the next. Those that have a vertex
    twice only lead a strip elsewhere."""
    strip = np.full(len(corners) + len(counts), -1, np.int64)
    strip[np.arange(len(corners)) + np.repeat(np.arange(len(counts)), counts)] = corners
    place = np.arange(len(strip))
    since = place - np.maximum.accumulate(np.where(strip < 0, place + 1, 0))
    triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    odd = since[:-2] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    first, second, third = triangles.T
    apart = (first != second) & (second != third) & (third != first)
    return np.asarray(triangles[(triangles >= 0).all(axis=1) & apart], np.int64)


def _names_texture(line: str) -> bool:
    return re.match(r"comment\s+texturefile\s+\S", line, re.IGNORECASE) is not None


def _decoded(header: bytes) -> str:
    """Comments may be in the letters of any country."""
    try:
        return header.decode("utf-8")
    except UnicodeDecodeError:
        return header.decode("latin-1")


def _elements(header: Sequence[str]) -> list[tuple[str, int, list[list[str]]]]:
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in (line.split() for line in header):
        kinds = words[1:-1]
        listed = kinds[:1] == ["list"] and len(kinds) == 3
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements and (listed or len(kinds) == 1):
            if unknown := next((kind for kind in kinds[listed:] if kind not in KINDS), ""):
                raise ValueError(f"it has numbers of an unknown kind, {unknown[:40]!r}")
            elements[-1][2].append(words[1:])
        elif words[:1] in (["element"], ["property"]):
            raise ValueError(f"its header has the line {' '.join(words)[:60]!r}")
    return elements


_Elements = Sequence[tuple[str, int, list[list[str]]]]


def _read(numbers: Numbers, elements: _Elements) -> dict[str, dict[str, Column]]:
    read = {name: element(numbers, name, count, properties) for name, count, properties in elements}
    if numbers.left:
        raise ValueError(f"it holds {numbers.left} numbers more than its header announces")
    return read


def _without_more_columns(content: bytes, elements: _Elements) -> bytes | None:
    """Text of as many lines as rows are announced, without the columns behind those that are, where
    all rows of an element have as many of these. None where it is not so."""
    lines = [words for line in content.splitlines() if (words := line.split())]
    if len(lines) != sum(count for _, count, _ in elements):
        return None
    kept: list[bytes] = []
    for _, count, properties in elements:
        rows, lines = lines[:count], lines[count:]
        widths = [_width(row, properties) for row in rows]
        if len({len(row) - width for row, width in zip(rows, widths, strict=True)}) > 1:
            return None
        kept += [b" ".join(row[:width]) for row, width in zip(rows, widths, strict=True)]
    return b"\n".join(kept)


def _width(row: Sequence[bytes], properties: Sequence[Sequence[str]]) -> int:
    """Of how many words a row is to be, as far as it says so."""
    width = 0
    for words in properties:
        listed = row[width] if words[0] == "list" and width < len(row) else b"0"
        width += 1 + (int(listed) if listed.isdigit() else 0)
    return width
