"""What trimesh makes something else of than OBJ files say: vertices that are counted backwards,
faces of more than three corners, and lines that are written in other ways than most."""

from __future__ import annotations

import codecs
import re
from collections import Counter

import numpy as np

from usdbrdf.model.arrays import Long
from usdbrdf.model.mesh import triangulate
from usdbrdf.model.polygons import ears, fans_that_leave

_BACKWARDS = re.compile(rb"^f [^\n]*[ ]-\d", re.MULTILINE)
_NOUGHT = re.compile(rb"^f (?:[^\n]*[ ])?0+[/ \n]", re.MULTILINE)
_REMARK = re.compile(rb"^([ ]*(?:v[tn]?|f) [^\n#]*)#[^\n]*", re.MULTILINE)
_POLYGON = re.compile(rb"^f(?: +[^ \n]+){4}", re.MULTILINE)
_LARGE = re.compile(rb"^f(?: +[^ \n]+){4,}", re.MULTILINE)
_DIVIDER = re.compile(rb"^(o|g|usemtl)(?= |$)([^\n]*)", re.MULTILINE)
# A line that goes on in the next, as often as it does.
_CONTINUED = re.compile(rb"^(?:[^\n]*\\\n)+[^\n]*", re.MULTILINE)


def in_utf8(content: bytes) -> bytes:
    """A file of text as it would be in UTF-8 without a mark: shells and editors of Windows write
    UTF-16. Of any other file the bytes as they are. ValueError for UTF-16 that breaks off."""
    if content.startswith(codecs.BOM_UTF8):
        return content.removeprefix(codecs.BOM_UTF8)
    is_marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    # No text of 8 bits has a NUL, and what these files begin with is ASCII.
    little, big = content[1:4:2] == b"\0\0", content[0:3:2] == b"\0\0"
    if not (is_marked or (little ^ big and content[:4].strip(b"\0"))):
        return content
    encoding = "utf-16" if is_marked else "utf-16-le" if little else "utf-16-be"
    try:
        return content.decode(encoding).encode()
    except UnicodeError as error:
        raise ValueError("text in UTF-16 that breaks off or is damaged") from error


def plain_obj(content: bytes) -> bytes:
    """An OBJ all of whose faces count vertices from the first one on, line by line. Its format lets
    them count back from where they stand; trimesh would count from the end of the file. It would
    also pass over lines whose words tabs part, that are indented, that a CR alone ends or that a
    mark of UTF-8 begins, and stumble over remarks; of UTF-16 it would find nothing.

    Raises ValueError for a vertex 0, which would be taken for the last one.
    """
    content = in_utf8(content).replace(b"\t", b" ") + b"\n"
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in content:
        content = _CONTINUED.sub(_in_one_line, content)
    if b"\n " in content or content[:1] == b" ":
        content = re.sub(rb"^ +", b"", content, flags=re.MULTILINE)
    if b" #" in content:
        content = _REMARK.sub(rb"\1", content)
    if found := _NOUGHT.search(content):
        line = content.count(b"\n", 0, found.start()) + 1
        raise ValueError(f"line {line}: a face has a vertex 0, but OBJ counts from 1")
    return _counted_forwards(content) if _BACKWARDS.search(content) else content


def _in_one_line(found: re.Match[bytes]) -> bytes:
    """With empty lines behind it, so that the next one keeps its number."""
    lines = found[0].split(b"\\\n")
    return b" ".join(lines) + b"\n" * (len(lines) - 1)


def _counted_forwards(content: bytes) -> bytes:
    there = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.split(b"\n")
    for i, line in enumerate(lines):
        key, *rest = line.split() or [b""]
        if key in there:
            there[key] += 1
        elif key == b"f":
            try:
                lines[i] = b" ".join([key, *(_forwards(corner, there) for corner in rest)])
            except ValueError as error:
                raise ValueError(f"line {i + 1}: {error}") from error
    return b"\n".join(lines)


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


def obj_of_convex_faces(content: bytes) -> bytes:
    """A plain OBJ whose faces that a fan from their first corner would leave have become triangles,
    in place: trimesh makes fans of all.

    Raises IndexError where faces of more than three corners have vertices that do not exist.
    """
    if not _POLYGON.search(content):
        return content
    lines = content.split(b"\n")
    rows = [b" ".join(line.split(None, 4)[1:4]) for line in lines if line[:2] == b"v "]
    points = np.fromstring(b" ".join(rows), np.float64, sep=" ").reshape(len(rows), 3)
    places = [i for i, line in enumerate(lines) if line[:2] == b"f " and len(line.split()) > 4]
    text = b" ".join(lines[i][2:] for i in places)
    if b"/" in text:
        text = re.sub(rb"/[^ ]*", b"", text)
    corners = np.fromstring(text, np.int64, sep=" ") - 1
    if corners.max() >= len(points):
        raise IndexError("a face has a vertex that does not exist")
    counts = np.array([len(lines[i].split()) - 1 for i in places], np.int64)
    cut = triangulate(counts, corners)
    firsts = np.cumsum(counts) - counts
    for face in fans_that_leave(points, cut.triangles, cut.polygon).tolist():
        words = lines[places[face]].split()[1:]
        own = corners[firsts[face] : firsts[face] + counts[face]]
        lines[places[face]] = b"\n".join(
            b" ".join([b"f", *(words[corner] for corner in ear)])
            for ear in ears(points[own]).tolist()
        )
    return b"\n".join(lines)


def parts_of_obj(content: bytes) -> tuple[bytes, tuple[str, ...], Long]:
    """A plain OBJ without the lines that divide it; the names of its parts; and the part (T,) of
    each triangle that its faces become, in their order, in which trimesh would not leave them.

    Parts are objects, groups where there are none, each divided by its materials; they are numbered
    as they appear.
    """
    found = [*_DIVIDER.finditer(content)]
    outer = b"o" if any(line[1] == b"o" for line in found) else b"g"
    state = {b"o": b"", b"g": b"", b"usemtl": b""}
    number: dict[tuple[bytes, bytes], int] = {}
    part, counts = [], []
    ends = [*(line.start() for line in found), len(content)]
    for end, line in zip(ends, [None, *found], strict=True):
        if line is not None:
            state[line[1]] = line[2].strip()
        if count := _triangles_between(content, line.end() if line else 0, end):
            part.append(number.setdefault((state[outer], state[b"usemtl"]), len(number)))
            counts.append(count)
    of_triangle = np.repeat(np.array(part, np.int64), counts)
    return _DIVIDER.sub(b"", content) if found else content, _names(list(number)), of_triangle


def _triangles_between(content: bytes, start: int, end: int) -> int:
    more = (len(face[0].split()) - 4 for face in _LARGE.finditer(content, start, end))
    return content.startswith(b"f ", start) + content.count(b"\nf ", start, end) + sum(more)


def _names(parts: list[tuple[bytes, bytes]]) -> tuple[str, ...]:
    """Of objects or groups with their materials: the first, and both where it has several."""
    several = Counter(outer for outer, _ in parts)
    words = (
        (outer, material) if several[outer] > 1 or not outer else (outer,)
        for outer, material in parts
    )
    texts = ("_".join(w.decode("utf-8", "replace") for w in two if w) for two in words)
    return tuple(text or "unnamed" for text in texts)


def missing_vertex(content: bytes) -> str:
    """Where the first face of a plain OBJ stands that has a vertex beyond the last, "" for none."""
    lines = content.split(b"\n")
    there = sum(line[:2] == b"v " for line in lines)
    for i, line in enumerate(lines):
        for word in line.split()[1:] if line[:2] == b"f " else ():
            number = word.split(b"/", 1)[0]
            if number.isdigit() and int(number) > there:
                return f"line {i + 1}: a face has the vertex {int(number)}, but there are {there}"
    return ""
