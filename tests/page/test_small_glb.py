"""A page's binary glTF shows what the package's does, in far fewer bytes."""

from __future__ import annotations

import gzip
import json
import struct

import numpy as np
import pytest

from usdbrdf.delivery.package import write_package
from usdbrdf.options import PackageOptions
from usdbrdf.page.small_glb import FILTERED, _chunks, _read, filtered, small_glb


@pytest.fixture(scope="module")
def large(room, tmp_path_factory):
    file = tmp_path_factory.mktemp("glb") / "room.glb"
    write_package(room.asset, file, PackageOptions(max_size=64), lambda _: None)
    return file.read_bytes()


def glb_of(*meshes):
    """Positions (3 F, 3) of triangles' corners, as a mesh each."""
    views, accessors, nodes, primitives, binary = [], [], [], [], b""
    for i, position in enumerate(meshes):
        count = len(position)
        arrays = {
            "POSITION": position.astype("<f4"),
            "NORMAL": np.tile(np.float32((0, 0, 1)), (count, 1)),
            "TEXCOORD_0": np.zeros((count, 2), "<f4"),
            "indices": np.arange(count, dtype="<u4"),
        }
        for values in arrays.values():
            view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
            kind = f"VEC{values.shape[1]}" if values.ndim == 2 else "SCALAR"
            code = 5126 if values.ndim == 2 else 5125
            accessors.append(
                {"bufferView": len(views), "componentType": code, "count": count, "type": kind}
            )
            views.append(view)
            binary += values.tobytes()
        numbers = {name: 4 * i + k for k, name in enumerate(arrays)}
        rows = numbers.pop("indices")
        primitives.append({"attributes": numbers, "indices": rows})
        nodes.append({"mesh": i, "extras": {"usdPrim": str(i)}})
    meshes = [{"primitives": [primitive]} for primitive in primitives]
    return packed(
        {"nodes": nodes, "meshes": meshes, "accessors": accessors, "bufferViews": views}, binary
    )


def packed(document, binary):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = (struct.pack("<I4s", len(text), b"JSON"), text)
    return b"".join((head, *chunks, struct.pack("<I4s", len(binary), b"BIN\0"), binary))


def unfiltered(content, size, columns):
    """What web/room.js does."""
    planes = np.frombuffer(content, np.uint8).reshape(columns, size, -1)
    steps = np.ascontiguousarray(planes.transpose(2, 0, 1)).view(f"<u{size}")[..., 0]
    return np.cumsum(steps, axis=0, dtype=steps.dtype)


def corners_of(content):
    """Name of each mesh -> (3 F, 8) of its triangles' corners: position, normal, texture."""
    document, binary = _chunks(content)
    small = document.get("extras", {}).get(FILTERED, {})

    def values(number):
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        size = small.get(str(accessor["bufferView"]))
        if size is None:
            return _read(document, binary, number)
        start, length = view["byteOffset"], view["byteLength"]
        columns = view.get("byteStride", size) // size
        found = unfiltered(binary[start : start + length], size, columns)
        kept = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
        if accessor["componentType"] == 5120:
            return found.view(np.int8)[:, :kept] / 127
        return found[:, :kept] / (65535 if accessor.get("normalized") else 1)

    found = {}
    for node in document["nodes"]:
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        attributes = [values(primitive["attributes"][n]) for n in ("POSITION", "NORMAL")]
        attributes[0] = attributes[0] * node.get("scale", 1) + node.get("translation", 0)
        attributes.append(values(primitive["attributes"]["TEXCOORD_0"]))
        rows = values(primitive["indices"]).ravel().astype(int)
        found[node["extras"]["usdPrim"]] = np.concatenate(attributes, axis=1)[rows]
    return found


def test_it_shows_the_same_triangles_on_a_grid_of_the_room(large):
    small = small_glb(large)
    given, found = corners_of(large), corners_of(small)
    assert found.keys() == given.keys()
    everywhere = np.concatenate(list(given.values()))[:, :3]
    step = np.ptp(everywhere, axis=0).max() / 65535
    for name, corners in given.items():
        off = np.abs(found[name] - corners).max(axis=0)
        assert (off[:3] <= 0.51 * step + 1e-6).all(), name
        assert (off[3:6] <= 0.51 / 127).all()
        assert (off[6:] <= 16.1 / 65535).all()
    pictures = [
        [binary[view["byteOffset"] :][: view["byteLength"]] for view in views]
        for document, binary in (_chunks(large), _chunks(small))
        for views in [[document["bufferViews"][i["bufferView"]] for i in document["images"]]]
    ]
    assert pictures[0] == pictures[1]
    without = sum(map(len, pictures[0]))
    assert len(gzip.compress(small)) - without < 0.6 * (len(gzip.compress(large)) - without)
    document, _ = _chunks(small)
    assert "KHR_mesh_quantization" in document["extensionsRequired"]


def test_what_repeats_its_texture_stays_as_it_is(large):
    document, binary = _chunks(large)
    primitive = document["meshes"][0]["primitives"][0]
    accessor = document["accessors"][primitive["attributes"]["TEXCOORD_0"]]
    view = document["bufferViews"][accessor["bufferView"]]
    at = len(large) - len(binary) + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    other = large[:at] + np.float32(1.5).tobytes() + large[at + 4 :]
    given, found = corners_of(other), corners_of(small_glb(other))
    name = document["nodes"][0]["extras"]["usdPrim"]
    np.testing.assert_array_equal(found[name], given[name])
    assert found[name][:, 6].max() == 1.5
    assert sum(not np.array_equal(found[n], given[n]) for n in given) == len(given) - 1


def test_a_mesh_across_the_whole_room_keeps_its_corners_wherever_the_grid_begins():
    rng = np.random.default_rng(5)
    for _ in range(60):
        low, size = rng.uniform(-50, 50, 3), rng.uniform(1, 70, 3)
        box = (low + size * np.array([[0, 0, 0], [1, 1, 0], [1, 1, 1]])).astype(np.float32)
        found = corners_of(small_glb(glb_of(box)))["0"][:, :3]
        step = np.ptp(box.astype(float), axis=0).max() / 65535
        assert np.abs(found - box).max() <= 0.51 * step


def test_small_things_in_a_large_scan_keep_their_triangles_on_a_grid_that_holds_the_scans():
    rng = np.random.default_rng(6)
    hall = np.array([[-33.0, 0, 0], [33.05, 0, 0], [33.05, 3, 20]])
    knob = rng.uniform(4, 4.027, (200, 1, 3)) + rng.uniform(0, 4e-4, (200, 3, 3))
    content = small_glb(glb_of(hall, knob.reshape(-1, 3)))
    found = corners_of(content)["1"][:, :3]
    assert np.abs(found - knob.reshape(-1, 3)).max() < 0.0275 / 4096
    corners = found.reshape(-1, 3, 3)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(across, axis=1).all()
    coarse, fine = (node["scale"][0] for node in _chunks(content)[0]["nodes"])
    assert np.log2(coarse / fine) == round(np.log2(coarse / fine)) > 0


@pytest.mark.parametrize(
    "place",
    [
        {"matrix": [float(i % 5 == 0) for i in range(16)]},
        {"translation": [1, 2, 3]},
        {"rotation": [0, 0, 1, 0]},
        {"scale": [2, 2, 2]},
        {"children": [1]},
    ],
)
def test_a_mesh_with_a_place_of_its_own_or_of_others_stays_where_it_is(place):
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    document, binary = _chunks(glb_of(triangle, triangle + 0.3))
    document["nodes"][0] |= place
    small, arrays = _chunks(small_glb(packed(document, binary)))
    assert small["nodes"][0] == document["nodes"][0]
    number = small["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    np.testing.assert_array_equal(_read(small, arrays, number), triangle)
    assert small["nodes"][1].keys() >= {"translation", "scale"}


@pytest.mark.parametrize("dtype", ["i1", "<u2", "<u4"])
def test_differences_add_up_to_the_numbers(dtype):
    values = np.random.default_rng(3).integers(-100, 100, (50, 4)).astype(dtype)
    size = values.dtype.itemsize
    assert (unfiltered(filtered(values), size, 4).view(dtype) == values).all()
