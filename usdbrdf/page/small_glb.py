"""Binary glTF for a page: the same pictures of it in a third of the bytes.

Positions lie on a grid of the whole room, those of a small mesh on one that divides it; texture
coordinates and normals are small integers (KHR_mesh_quantization); vertices that are equal there
are one, in the order in which triangles use them; and each array is stored as its differences, byte
by byte, which compress well. ``unfiltered`` of web/room.js takes that last step back, for which the
document's extras name the arrays."""

from __future__ import annotations

import json
import struct
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.model.arrays import Array, Long

FILTERED = (
    "usdbrdfFiltered"  # of the document's extras: number of a buffer view -> bytes of a number
)
_QUANTIZATION = "KHR_mesh_quantization"
_FLOAT, _BYTE, _SHORT, _INT = 5126, 5120, 5123, 5125
_TYPES: dict[int, np.dtype[Any]] = {
    _FLOAT: np.dtype("<f4"), _BYTE: np.dtype("i1"), _SHORT: np.dtype("<u2"), _INT: np.dtype("<u4"),
}  # fmt: skip
_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SMALLER = {"POSITION", "NORMAL", "TEXCOORD_0"}
# Of a node: with one of them, its mesh or others lie in another place than the mesh says.
_PLACING = {"matrix", "translation", "rotation", "scale", "children"}
# The largest number of two bytes; and texture coordinates are multiples of this.
_LARGEST, _TEXTURE_STEP = 65535, 16
# Steps of its grid along a mesh, at least.
_FEWEST = 1 << 12
_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")


class _Mesh(NamedTuple):
    """A primitive that becomes smaller, and the node that places it."""

    primitive: dict[str, Any]
    node: dict[str, Any]
    corners: Long  # (3 F,) rows of the others
    position: Array
    normal: Array
    texture: Array


def small_glb(content: bytes) -> bytes:
    """A file as ``write_glb`` writes it, made small; meshes of another kind stay as they are."""
    document, binary = _chunks(content)
    meshes = _meshes(document, binary)
    if not meshes:
        return content
    every = np.concatenate([np.stack([m.position.min(0), m.position.max(0)]) for m in meshes])
    # A mesh's numbers begin at the step before it, so that they may end one after its extent.
    step = max(_extent(every) / (_LARGEST - 1), 1e-9)
    kept = _Kept(document, binary, {id(mesh.primitive) for mesh in meshes})
    for mesh in meshes:
        _put(kept, mesh, _step_of(mesh, step))
    return kept.file()


class _Kept:
    """A document whose arrays are written anew, one after another."""

    def __init__(self, document: dict[str, Any], binary: bytes, smaller: set[int]) -> None:
        self.document, self.binary = document, bytearray()
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.filtered: dict[str, int] = {}
        old_accessors, old_views = document["accessors"], document["bufferViews"]
        for primitive in _primitives(document):
            if id(primitive) in smaller:
                continue
            for held, key in _references(primitive):
                accessor = old_accessors[held[key]]
                view = old_views[accessor["bufferView"]]
                accessor = {**accessor, "bufferView": self._copied(view, binary)}
                held[key] = self._accessor(accessor)
        for image in document.get("images", ()):
            image["bufferView"] = self._copied(old_views[image["bufferView"]], binary)

    def _copied(self, view: dict[str, Any], binary: bytes) -> int:
        start = view.get("byteOffset", 0)
        content = binary[start : start + view["byteLength"]]
        rest = {k: v for k, v in view.items() if k not in ("buffer", "byteOffset", "byteLength")}
        return self._view(content, **rest)

    def _view(self, content: bytes, **more: Any) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        place = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        self.views.append({**place, **more})
        self.binary += content
        return len(self.views) - 1

    def _accessor(self, accessor: dict[str, Any]) -> int:
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add(self, values: Array, kind: str, **more: Any) -> int:
        """Integers (N, C), of which ``kind`` tells the first; the number of the accessor."""
        code = next(code for code, dtype in _TYPES.items() if dtype == values.dtype)
        stride = {} if kind == "SCALAR" else {"byteStride": values.dtype.itemsize * values.shape[1]}
        view = self._view(filtered(values), **stride)
        self.filtered[str(view)] = values.dtype.itemsize
        told = {"bufferView": view, "componentType": code, "count": len(values), "type": kind}
        return self._accessor({**told, **more})

    def file(self) -> bytes:
        """The whole of it."""
        document = self.document
        document["accessors"], document["bufferViews"] = self.accessors, self.views
        document["buffers"] = [{"byteLength": len(self.binary)}]
        document["extras"] = {**document.get("extras", {}), FILTERED: self.filtered}
        for name in ("extensionsUsed", "extensionsRequired"):
            document[name] = sorted({*document.get(name, ()), _QUANTIZATION})
        text = json.dumps(document, separators=(",", ":")).encode("utf-8")
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + bytes(-len(self.binary) % 4)
        size = _HEAD.size + 2 * _CHUNK.size + len(text) + len(binary)
        return b"".join((
            _HEAD.pack(b"glTF", 2, size), _CHUNK.pack(len(text), b"JSON"), text,
            _CHUNK.pack(len(binary), b"BIN\0"), binary,
        ))  # fmt: skip


def filtered(values: Array) -> bytes:
    """Integers (N, C) as differences down each column, their lowest bytes first, then the next."""
    size = values.dtype.itemsize
    unsigned = values.view(f"<u{size}")
    steps = np.diff(unsigned, axis=0, prepend=np.zeros((1, values.shape[1]), unsigned.dtype))
    planes = np.ascontiguousarray(steps.T)[..., None].view(np.uint8)
    return np.ascontiguousarray(planes.transpose(0, 2, 1)).tobytes()


def _extent(position: Array) -> float:
    """Along the longest axis."""
    return float(np.ptp(position, axis=0).max())


def _step_of(mesh: _Mesh, step: float) -> float:
    """That of the room, halved until a small mesh keeps its shape; so its grid holds every point
    of the room's, and the seams between meshes stay below half of the room's step."""
    extent = _extent(mesh.position)
    while 0 < extent < _FEWEST * step:
        step /= 2
    return step


def _put(kept: _Kept, mesh: _Mesh, step: float) -> None:
    low = np.floor(mesh.position.min(axis=0) / step).astype(np.int64)
    grid = np.rint(mesh.position / step).astype(np.int64) - low
    texture = np.rint(mesh.texture * (_LARGEST / _TEXTURE_STEP)).astype(np.int64) * _TEXTURE_STEP
    # Rows of positions and normals begin at multiples of four bytes.
    rows = np.zeros((len(grid), 10), np.int64)
    rows[:, 0:3], rows[:, 4:7] = grid, np.rint(mesh.normal * 127)
    rows[:, 8:10] = np.minimum(texture, _LARGEST)
    rows, corners = _in_order_of_use(rows, mesh.corners)
    position, short = rows[:, :4].astype("<u2"), len(rows) <= _LARGEST
    mesh.node["translation"], mesh.node["scale"] = (low * step).tolist(), [step] * 3
    mesh.primitive["attributes"] = {
        "POSITION": kept.add(
            position,
            "VEC3",
            min=position[:, :3].min(0).tolist(),
            max=position[:, :3].max(0).tolist(),
        ),
        "NORMAL": kept.add(rows[:, 4:8].astype("i1"), "VEC3", normalized=True),
        "TEXCOORD_0": kept.add(rows[:, 8:].astype("<u2"), "VEC2", normalized=True),
    }
    mesh.primitive["indices"] = kept.add(
        corners[:, None].astype("<u2" if short else "<u4"), "SCALAR"
    )


def _in_order_of_use(rows: Long, corners: Long) -> tuple[Long, Long]:
    """Rows that ``corners`` use, each once, and corners that are rows of these."""
    _, first, same = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    used, at, place = np.unique(same.reshape(-1)[corners], return_index=True, return_inverse=True)
    order = np.argsort(at)
    rank = np.empty(len(used), np.int64)
    rank[order] = np.arange(len(used))
    return rows[first[used[order]]], rank[place.reshape(-1)]


def _meshes(document: dict[str, Any], binary: bytes) -> list[_Mesh]:
    """Those of one node that neither has a place of its own nor gives one to others, and whose
    textures do not repeat."""
    nodes = document.get("nodes", ())
    uses = Counter(node["mesh"] for node in nodes if "mesh" in node)
    found = []
    for node in nodes:
        if "mesh" not in node or uses[node["mesh"]] > 1 or node.keys() & _PLACING:
            continue
        primitives = document["meshes"][node["mesh"]]["primitives"]
        if len(primitives) != 1 or primitives[0]["attributes"].keys() != _SMALLER:
            continue
        primitive = primitives[0]
        position, normal, texture = (
            _read(document, binary, primitive["attributes"][name]).astype(np.float64)
            for name in ("POSITION", "NORMAL", "TEXCOORD_0")
        )
        if texture.min() < 0 or texture.max() > 1:
            continue
        corners = _read(document, binary, primitive["indices"]).reshape(-1).astype(np.int64)
        found.append(_Mesh(primitive, node, corners, position, normal, texture))
    return found


def _read(document: dict[str, Any], binary: bytes, number: int) -> Array:
    """The array of an accessor, whose rows follow each other."""
    accessor = document["accessors"][number]
    view, columns = document["bufferViews"][accessor["bufferView"]], _COUNTS[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    dtype = _TYPES[accessor["componentType"]]
    values = np.frombuffer(binary, dtype, accessor["count"] * columns, start)
    return np.asarray(values.reshape(-1, columns))


def _primitives(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [p for mesh in document["meshes"] for p in mesh["primitives"]]


def _references(primitive: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """Where a primitive names accessors."""
    found = [(primitive["attributes"], name) for name in primitive["attributes"]]
    return found + ([(primitive, "indices")] if "indices" in primitive else [])


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    length, _ = _CHUNK.unpack_from(content, _HEAD.size)
    start = _HEAD.size + _CHUNK.size
    document: dict[str, Any] = json.loads(content[start : start + length])
    return document, content[start + length + _CHUNK.size :]
