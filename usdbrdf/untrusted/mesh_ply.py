"""PLY files, text and binary, with faces of any number of corners, and as trimesh reads them: it
joins or refuses polygons, and stumbles over what text may hold."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, Protocol

import numpy as np

from usdbrdf.model.arrays import Array, Double, Long
from usdbrdf.model.mesh import Triangulation, triangulate

# PLY's names of numbers, as NumPy spells them.
_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float16": "f2", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in reversed(_KINDS.items())}
_BEGINNING = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")
_LONGEST_HEADER = 1 << 16
_CORNERS, _UV = ("vertex_indices", "vertex_index"), "texcoord"
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


def ply_of(content: bytes) -> Ply:
    """What the bytes of a PLY say. ValueError for what is none, says less than it announces, or
    more: its numbers are not those that its header is for then."""
    beginning = _BEGINNING.match(content)
    if beginning is None:
        raise ValueError("it does not begin with a line 'ply'")
    # After lines that a CR alone ends the numbers may begin with what looks like a LF.
    end = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:" + beginning[1] + rb"|\r\n|\n)")
    last = end.search(content, 0, _LONGEST_HEADER)
    if last is None:
        raise ValueError("no end of its header")
    header = re.split(r"[\r\n]+", _decoded(content[: last.start()]))
    elements = _elements(header)
    for name, count, _ in elements:
        if not 0 <= count <= len(content):
            raise ValueError(f"it announces {count} elements {name[:40]!r} in {len(content)} bytes")
        if name in ("vertex", "face") and sum(name == other for other, *_ in elements) > 1:
            raise ValueError(f"its header has more than one element {name!r}")
    numbers = _numbers(header, content, last.end())
    try:
        read = _read(numbers, elements)
    except ValueError:
        start = last.end()
        text = isinstance(numbers, _Text) and _without_more_columns(content[start:], elements)
        if not text:
            raise
        read = _read(_Text(text), elements)
    vertex = {name: c.flat for name, c in read.get("vertex", {}).items() if not c.is_list}
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("it has no vertices with x, y and z")
    face = read.get("face", {})
    lists = {name: column for name, column in face.items() if column.is_list}
    listed = next((lists[name] for name in _CORNERS if name in lists), None)
    if listed is None:
        if face:
            raise ValueError(f"its faces have no list {_CORNERS[0]}")
        listed = _Column(counts=np.zeros(0, np.int64), flat=np.zeros(0, np.int64), is_list=True)
    if listed.flat.dtype.kind == "f":
        broken = np.isfinite(listed.flat) & (np.floor(listed.flat) != listed.flat)
        if broken.any():
            raise ValueError(f"a face has the vertex {listed.flat[broken][0]:g}")
    whole = np.abs(listed.flat.astype(np.float64)) <= np.iinfo(np.int32).max
    uv = lists.get(_UV)
    each = uv is not None and bool((uv.counts == 2 * listed.counts).all())
    textures = (line.split(None, 2)[2] for line in header if _names_texture(line))
    return Ply(
        vertices=vertex,
        counts=listed.counts,
        corners=np.where(whole, listed.flat, -1).astype(np.int64),
        faces={name: c.flat for name, c in face.items() if not c.is_list},
        corner_uv=uv.flat.reshape(-1, 2).astype(np.float64) if uv is not None and each else None,
        texture=next(textures, "").strip(),
    )


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
            if unknown := next((kind for kind in kinds[listed:] if kind not in _KINDS), ""):
                raise ValueError(f"it has numbers of an unknown kind, {unknown[:40]!r}")
            elements[-1][2].append(words[1:])
        elif words[:1] in (["element"], ["property"]):
            raise ValueError(f"its header has the line {' '.join(words)[:60]!r}")
    return elements


_Elements = Sequence[tuple[str, int, list[list[str]]]]


def _read(numbers: _Numbers, elements: _Elements) -> dict[str, dict[str, _Column]]:
    read = {
        name: _element(numbers, name, count, properties) for name, count, properties in elements
    }
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


@dataclass(frozen=True, kw_only=True)
class _Column:
    """A property of all rows of an element: ``counts`` of each row, numbers ``flat``."""

    counts: Long
    flat: Array
    is_list: bool


class _Numbers(Protocol):
    """The numbers behind a header, one after the other."""

    @property
    def of_counts(self) -> str:
        """The kind in which counts of lists are taken, "" for that of the header."""

    @property
    def left(self) -> int:
        """How many bytes or numbers nobody has taken."""

    def take(self, kind: str, count: int) -> Array:
        """(count,) of one kind; ValueError where there are less."""

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        """Rows of the same length: of each of its parts, a kind and how many, (rows, how many).
        None, and nothing is taken, where there are less."""

    def back(self, place: int) -> None:
        """Go back to a place."""

    place: int


class _Text:
    of_counts = "f8"  # as they stand: of what is none nothing is made

    def __init__(self, content: bytes) -> None:
        try:
            self.numbers: Array = np.fromstring(content, np.float64, sep=" ")
        except ValueError as error:
            raise ValueError(f"it holds {_no_number(content)}, which is no number") from error
        self.place = 0

    @property
    def left(self) -> int:
        return len(self.numbers) - self.place

    def take(self, kind: str, count: int) -> Array:
        if not 0 <= count <= self.left:
            raise ValueError("it ends within a face")
        self.place += count
        return _of_kind(self.numbers[self.place - count : self.place], kind)

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        ends = np.cumsum([count for _, count in kinds]).tolist()
        if rows * ends[-1] > self.left:
            return None
        part = self.numbers[self.place : self.place + rows * ends[-1]].reshape(rows, ends[-1])
        self.place += part.size
        return [
            _of_kind(part[:, end - count : end], kind)
            for (kind, count), end in zip(kinds, ends, strict=True)
        ]

    def back(self, place: int) -> None:
        self.place = place


def _no_number(content: bytes) -> str:
    for word in content.split():
        try:
            float(word)
        except ValueError:
            return repr(word[:40].decode("latin-1"))
    return "something"


def _of_kind(numbers: Array, kind: str) -> Array:
    """Numbers that were written as text. Whole ones that are none, or too large, become -1, or what
    is largest where nothing is below 0."""
    if kind[0] == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(kind)
    limits = np.iinfo(f"{kind[0]}{min(int(kind[1]), 4)}")  # beyond that, doubles are not exact
    fits = (numbers >= limits.min) & (numbers <= limits.max) & (np.floor(numbers) == numbers)
    return np.where(fits, numbers, -1 if kind[0] == "i" else limits.max).astype(kind)


class _Bytes:
    of_counts = ""

    def __init__(self, content: bytes, place: int, order: str) -> None:
        self.content, self.place, self.order = content, place, order

    @property
    def left(self) -> int:
        return 0  # what follows belongs to nobody, and is passed over

    def take(self, kind: str, count: int) -> Array:
        size = count * int(kind[1])
        if not 0 <= size <= len(self.content) - self.place:
            raise ValueError("it ends within a face")
        self.place += size
        if not size:
            return np.zeros(0, kind)
        return np.frombuffer(self.content, self.order + kind, count, self.place - size)

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        size = sum(int(kind[1]) * count for kind, count in kinds)
        if rows * size > len(self.content) - self.place:
            return None
        row = np.dtype(
            [(str(i), self.order + kind, (count,)) for i, (kind, count) in enumerate(kinds)]
        )
        found = np.frombuffer(self.content, row, rows, self.place) if rows else np.zeros(0, row)
        self.place += rows * size
        return [found[str(i)] for i in range(len(kinds))]

    def back(self, place: int) -> None:
        self.place = place


def _numbers(header: Sequence[str], content: bytes, start: int) -> _Numbers:
    said = next((line.split()[1:2] for line in header if line.split()[:1] == ["format"]), [])
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get("".join(said))
    if order is not None:
        return _Bytes(content, start, order)
    if said != ["ascii"]:
        raise ValueError(f"its format is {''.join(said)[:40]!r}")
    return _Text(content[start:])


def _element(
    numbers: _Numbers, name: str, count: int, properties: Sequence[Sequence[str]]
) -> dict[str, _Column]:
    """All rows of an element; of lists that are all as long as the first as one table."""
    start = numbers.place
    lengths = [lists[0] for lists in _one_by_one(numbers, min(count, 1), properties)[0]]
    numbers.back(start)
    kinds: list[tuple[str, int]] = []
    for words, length in zip(properties, lengths or [0] * len(properties), strict=True):
        if words[0] == "list":
            kinds.append((numbers.of_counts or _KINDS[words[1]], 1))
        kinds.append((_KINDS[words[-2]], length if words[0] == "list" else 1))
    if not kinds:
        return {}
    found: dict[str, _Column] = {}
    if (table := numbers.table(kinds, count)) is not None:
        parts = iter(table)
        for words, length in zip(properties, lengths or [0] * len(properties), strict=True):
            if (is_list := words[0] == "list") and not (next(parts) == length).all():
                break
            flat = next(parts).reshape(-1)
            counts = np.full(count, length if is_list else 1, np.int64)
            found[words[-1]] = _Column(counts=counts, flat=flat, is_list=is_list)
        else:
            return found
    if all(words[0] != "list" for words in properties):
        raise ValueError(f"it ends before its {count} elements {name!r}")
    numbers.back(start)
    sizes, pieces = _one_by_one(numbers, count, properties)
    return {
        words[-1]: _Column(
            counts=np.array(size, np.int64), flat=np.concatenate(piece), is_list=words[0] == "list"
        )
        for words, size, piece in zip(properties, sizes, pieces, strict=True)
    }


def _one_by_one(
    numbers: _Numbers, count: int, properties: Sequence[Sequence[str]]
) -> tuple[list[list[int]], list[list[Array]]]:
    """Of each property how many numbers each row has, and these; nothing of no rows."""
    sizes: list[list[int]] = [[] for _ in properties] if count else []
    pieces: list[list[Array]] = [[] for _ in properties] if count else []
    for _ in range(count):
        for words, size, piece in zip(properties, sizes, pieces, strict=True):
            length = 1
            if words[0] == "list":
                said = float(numbers.take(numbers.of_counts or _KINDS[words[1]], 1)[0])
                if not said.is_integer() or said < 0:
                    raise ValueError(f"a list has {said:g} elements")
                length = int(said)
            piece.append(numbers.take(_KINDS[words[-2]], length))
            size.append(length)
    return sizes, pieces
