"""Files that were made to do harm: every reader against everything that can lie at its path, and
contents that promise more than they hold or lead elsewhere. Each ends in a sentence, soon, with
nothing new on the disk."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.fuzzing.seeds import missing, package
from tests.scenes import write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.review import read_review
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.parts import label_table
from usdbrdf.command_parser import _matrix
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import load_arrays, read_json
from usdbrdf.files.images import image_size, read_radiance
from usdbrdf.files.tables import csv_rows, number_rows, read_array, read_xml
from usdbrdf.options import IngestOptions
from usdbrdf.relighting.relit_scene import _scene_of_others
from usdbrdf.untrusted.colmap_models import colmap_model
from usdbrdf.untrusted.e57_files import pictures_of_e57
from usdbrdf.untrusted.mesh_files import mesh_from_file, model_from_file
from usdbrdf.untrusted.pictures import picture_from_file
from usdbrdf.untrusted.raw_files import raw_picture
from usdbrdf.untrusted.replica_files import labelled_faces
from usdbrdf.untrusted.usd_cameras import cameras_from_usd
from usdbrdf.untrusted.usd_files import meshes_from_usd

Read = Callable[[Path], object]


def _colmap(path: Path) -> object:
    (path.parent / "cameras.txt").write_text("1 PINHOLE 32 24 20 20 16 12\n")
    return read_scan(path.parent, IngestOptions(), "colmap", plugins=False)


def _review(path: Path) -> object:
    found = read_review(Asset(path.parent, "room"))
    if not found:  # what is no file says nothing
        raise InputRefused(f"{path}: nothing said. [review.none]")
    return found


# Name of a file, and what reads it.
READERS: dict[str, tuple[str, Read]] = {
    "frame": ("a.exr", read_radiance),
    "8-bit frame": ("a.png", image_size),
    "picture": ("a.hdr", picture_from_file),
    "camera raw": ("a.dng", raw_picture),
    "PLY": ("a.ply", mesh_from_file),
    "OBJ": ("a.obj", mesh_from_file),
    "model": ("a.glb", model_from_file),
    "labelled PLY": ("a.ply", labelled_faces),
    "USD": ("a.usda", meshes_from_usd),
    "USDZ": ("a.usdz", meshes_from_usd),
    "COLMAP": ("images.txt", _colmap),
    "E57": ("a.e57", pictures_of_e57),
    "JSON": ("a.json", read_json),
    "labels": ("objects.json", label_table),
    "XML": ("a.xml", read_xml),
    "CSV": ("a.csv", csv_rows),
    "numbers": ("a.txt", number_rows),
    "array": ("a.npy", read_array),
    "arrays": ("a.npz", load_arrays),
    "matrix": ("matrix.txt", lambda path: _matrix(str(path))),
    "review": ("review.usda", _review),
}
_NEEDS = {"COLMAP": "colmap_text", "E57": "e57", "camera raw": "dng"}
# An empty table of numbers is one: what needs rows says so.
_MAY_BE_EMPTY = {"numbers"}


def _link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


PLACES: dict[str, Callable[[Path], None]] = {
    "a fifo": lambda path: os.mkfifo(path),
    "a device": _link("/dev/zero"),
    "a terminal": _link("/dev/tty"),
    "a folder": lambda path: path.mkdir(),
    "a link to nowhere": _link("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "nothing": lambda path: None,
    "an empty file": lambda path: path.touch(),
}


@pytest.fixture(autouse=True)
def _in_time() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def _refused(read: Read, path: Path, folder: Path) -> str:
    before = set(folder.rglob("*"))
    with pytest.raises(InputRefused) as refused:
        read(path)
    message = str(refused.value)
    assert re.fullmatch(r"[^\n\r]+ \[[a-z0-9_]+\.[a-z0-9_]+\]", message), message
    assert set(folder.rglob("*")) <= before | {folder / "capture" / "cameras.txt"}
    return message


@pytest.mark.fault("I13")
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("reader", READERS)
def test_what_lies_at_the_path_is_no_file_of_its_kind(tmp_path, reader, place):
    if missing(_NEEDS.get(reader, "")):
        pytest.skip("an optional package is missing")
    name, read = READERS[reader]
    if place == "an empty file" and reader in _MAY_BE_EMPTY:
        pytest.skip("that is a sound one")
    (tmp_path / "capture").mkdir()
    PLACES[place](tmp_path / "capture" / name)
    _refused(read, tmp_path / "capture" / name, tmp_path)


# --- Contents that promise more than they hold ----------------------------------------------------


def _png_of_a_promise(path: Path) -> None:
    """60,000 x 60,000 grey pixels, of which a thousand rows are there."""
    rows = zlib.compress(bytes(60_001 * 1000), 1)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)),
        (b"IDAT", rows),
        (b"IEND", b""),
    )
    parts = (
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def _tiff_of_a_promise(path: Path) -> None:
    spec = oiio.ImageSpec(64, 64, 3, "float")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((64, 64, 3), np.float32))
    assert output.close()
    content = bytearray(path.read_bytes())
    (at,) = struct.unpack_from("<I", content, 4)
    for i in range(struct.unpack_from("<H", content, at)[0]):
        entry = at + 2 + 12 * i
        if struct.unpack_from("<H", content, entry)[0] in (256, 257):
            struct.pack_into("<HII", content, entry + 2, 4, 1, 9000)
    path.write_bytes(content)


def _npz_of_zeros(path: Path) -> None:
    head = b"\x93NUMPY\x01\x00\x76\x00{'descr': '|u1', 'fortran_order': False, "
    head += b"'shape': (314572800,), }"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("albedo.npy", "w") as stream,
    ):
        stream.write(head.ljust(127) + b"\n")
        for _ in range(300):
            stream.write(bytes(1 << 20))


def _glb(accessor: dict[str, object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        document = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}], "buffers": [{"byteLength": 36}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [{"componentType": 5126, "count": 3, "type": "VEC3", **accessor}],
        }  # fmt: skip
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text
        body += struct.pack("<I4s", 36, b"BIN\0") + bytes(36)
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)

    return write


def _header(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(text.encode() + bytes(100)) and None


def _colmap_of_a_promise(path: Path) -> None:
    for name in ("cameras", "images", "rigs"):
        (path.parent / f"{name}.bin").write_bytes(struct.pack("<Q", 0))
    path.write_bytes(struct.pack("<Q", 1 << 62) + bytes(200))


_PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {v}\nproperty float x\nproperty float y\n"
)
_PLY += "property float z\nelement face {f}\nproperty list uchar int vertex_indices\n"
_PLY += "property ushort object_id\nend_header\n"
_NPY = (
    "\u0093NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 17), }"
)

PROMISES: dict[str, tuple[str, Read, Callable[[Path], object]]] = {
    "PNG of 60,000 x 60,000 zeros": ("a.png", image_size, _png_of_a_promise),
    "TIFF of 9,000 x 9,000 in a few bytes": ("a.tif", read_radiance, _tiff_of_a_promise),
    "HDR of 60,000 x 60,000 in a few bytes": (
        "a.hdr", read_radiance, _header("#?RADIANCE\n\n-Y 60000 +X 60000\n")
    ),
    "arrays of zeros": ("a.npz", load_arrays, _npz_of_zeros),
    "array of a promise": (
        "a.npy", read_array, lambda path: path.write_bytes(_NPY.encode("latin-1").ljust(200))
    ),
    "PLY of 2,000,000,000 points": (
        "a.ply", mesh_from_file, _header(_PLY.format(v=2_000_000_000, f=1))
    ),
    "labelled PLY of 9,999,999,999 faces": (
        "a.ply", labelled_faces, _header(_PLY.format(v=1, f=9_999_999_999))
    ),
    "GLB of a promise": ("a.glb", model_from_file, _glb({"bufferView": 0, "count": 2_000_000_000})),
    "GLB of zeros that it does not hold": ("a.glb", model_from_file, _glb({"count": 200_000_000})),
    "COLMAP's frames, 2^62 of them": (
        "frames.bin", lambda path: colmap_model(path.parent), _colmap_of_a_promise
    ),
    "nested document": ("a.json", read_json, lambda path: path.write_text("[" * 100_000)),
    "nested XML": ("a.xml", read_xml, lambda path: path.write_text("<a>" * 100_000)),
    "entities": (
        "a.xml", read_xml, lambda path: path.write_text('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')
    ),
    "an entity that names a file": (
        "a.xml", read_xml,
        lambda path: path.write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><a>&b;</a>'),
    ),
    "number of a million digits": (
        "a.json", read_json, lambda path: path.write_text("9" * 1_000_000)
    ),
}  # fmt: skip


@pytest.mark.fault("I12")
@pytest.mark.fault("C13")
@pytest.mark.parametrize("promise", PROMISES)
def test_a_promise_is_refused_and_not_made_room_for(tmp_path, promise):
    name, read, write = PROMISES[promise]
    if name == "frames.bin" and missing("colmap_binary"):
        pytest.skip("an optional package is missing")
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size < 4 << 20
    _refused(read, tmp_path / name, tmp_path)


# --- Stages that lead elsewhere -------------------------------------------------------------------

_TRIANGLE = """def Mesh "m" {
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}
"""
_HEAD = '#usda 1.0\n(\n defaultPrim = "m"\n)\n'
_SECRET = '#usda 1.0\ndef Xform "secret" {\n double secret = 3\n}\n'


def _referring(path: str) -> str:
    return f'#usda 1.0\ndef "r" (references = @{path}@</secret>) {{\n}}\n'


def _packed(folder: Path, inner: str) -> Path:
    """A package whose root layer refers to another one in it."""
    root = _HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n'
    entries = {"root.usda": root.encode(), "sub.usda": _referring(inner).encode()}
    return package(folder / "a.usdz", entries)


def _packed_absolute(folder: Path) -> Path:
    return _packed(folder, str(folder.parent / "secret.usda"))


def _packed_twice(folder: Path) -> Path:
    content = _packed_absolute(folder).read_bytes()
    root = _HEAD + _TRIANGLE + 'def "r" (references = @inner.usdz@</m>) {\n}\n'
    return package(folder / "b.usdz", {"root.usda": root.encode(), "inner.usdz": content})


def _packed_and_referred_to(folder: Path) -> Path:
    _packed_absolute(folder)
    path = folder / "b.usda"
    path.write_text(_HEAD + _TRIANGLE + 'def "r" (references = @a.usdz[sub.usda]@</r>) {\n}\n')
    return path


def _variable_of_a_stronger_layer(folder: Path) -> Path:
    """What the layer says of itself leads to its neighbour, what is composed leads out."""
    (folder / "inner.usda").write_text(_SECRET)
    own = 'expressionVariables = {{\n string X = "{}"\n}}\n'
    referring = _referring('`"${X}"`').replace(
        "#usda 1.0\n", f"#usda 1.0\n(\n{own.format('inner.usda')})\n"
    )
    (folder / "b.usda").write_text(referring)
    head = _HEAD.replace(")\n", own.format("../secret.usda") + ")\n")
    path = folder / "a.usda"
    path.write_text(head + _TRIANGLE + 'def "r" (references = @b.usda@</r>) {\n}\n')
    return path


def _with(arc: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "a.usda").write_text(f'{_HEAD}{_TRIANGLE}def "r" ({arc}) {{\n}}\n')
        return folder / "a.usda"

    return write


_CLIP = 'clips = {{\n dictionary default = {{\n {}\n string primPath = "/secret"\n}}\n}}'
STAGES: dict[str, Callable[[Path], Path]] = {
    "absolute path in a package": _packed_absolute,
    "absolute path in a package in a package": _packed_twice,
    "absolute path in a package that a layer refers to": _packed_and_referred_to,
    "variable of a stronger layer": _variable_of_a_stronger_layer,
    "expression": _with('references = @`"../secret.usda"`@</secret>'),
    "payload": _with("payload = @../secret.usda@</secret>"),
    "arguments of a format": _with("references = @../secret.usda:SDF_FORMAT_ARGS:a=b@</secret>"),
    "clip": _with(
        _CLIP.format("asset[] assetPaths = [@../secret.usda@]\n double2[] active = [(0, 0)]")
    ),
    "template of clips": _with(
        _CLIP.format('string templateAssetPath = "../secret.#.usda"\n'
                     "double templateStartTime = 1\n"
                     "double templateEndTime = 2\n double templateStride = 1")
    ),
    "URL": _with("references = @http://localhost:9/secret.usda@</secret>"),
    "format of a plug-in": _with("payload = @x.evil@</secret>"),
}  # fmt: skip


@pytest.mark.fault("S1")
@pytest.mark.fault("S3")
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_leads_out_is_refused(tmp_path, stage):
    (tmp_path / "capture").mkdir()
    for name in ("secret.usda", "secret.1.usda", "secret.2.usda"):
        (tmp_path / name).write_text(_SECRET)
    path = STAGES[stage](tmp_path / "capture")
    message = _refused(meshes_from_usd, path, tmp_path)
    assert re.search(r"\[(paths\.(outside|variables)|stage\.input)\]$", message)


def test_a_package_of_several_layers_is_read(tmp_path):
    """What is refused above is not that there are several."""
    sub = _referring("more/secret.usda").encode()
    root = (_HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n').encode()
    entries = {"root.usda": root, "sub.usda": sub, "more/secret.usda": _SECRET.encode()}
    found = meshes_from_usd(package(tmp_path / "a.usdz", entries))
    assert len(found.mesh.triangles) == 1


@pytest.mark.fault("S4")
def test_a_name_with_newlines_and_control_characters_stays_on_one_line(tmp_path):
    for name in ("a\nb.ply", "a\x1b[2J.ply", "a\rb.ply"):
        (tmp_path / name).write_bytes(b"ply\nnothing")
        with pytest.raises(InputRefused) as refused:
            mesh_from_file(tmp_path / name)
        assert str(refused.value).endswith("[mesh.read]")
    write_ply(tmp_path / "a\nb.ply", np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    assert len(mesh_from_file(tmp_path / "a\nb.ply").triangles) == 1


# --- Values of types that their attributes cannot have --------------------------------------------

_TYPES = {
    "points": (_TRIANGLE.replace("point3f[] points", "double[] points").replace(
        "[(0, 0, 0), (1, 0, 0), (0, 1, 0)]", "[1, 2, 3, 4]"), "mesh.topology"),
    "points of a type that nobody knows": (
        _TRIANGLE.replace("point3f[]", "vector9q[]"), "mesh.topology"
    ),
    "indices beyond 32 bits": (
        _TRIANGLE.replace("int[] faceVertexIndices = [0, 1, 2]",
                          "int64[] faceVertexIndices = [0, 1, 99999999999]"), "mesh.topology"
    ),
    "normals": (_TRIANGLE.replace("point3f", "string normals = 'up'\n    point3f"), ""),
    "labels": (
        _TRIANGLE.replace("point3f", "double semantics:labels:class = 3\n    point3f"), ""
    ),
}  # fmt: skip


@pytest.mark.fault("G2")
@pytest.mark.parametrize("kind", _TYPES)
@pytest.mark.parametrize("read", [meshes_from_usd, _scene_of_others])
def test_a_value_of_another_type_ends_in_a_sentence_or_counts_as_none(tmp_path, read, kind):
    text, rule = _TYPES[kind]
    (tmp_path / "a.usda").write_text(_HEAD + text)
    read_it = read if read is meshes_from_usd else lambda path: _scene_of_others(path, ())
    if rule:
        assert f"[{rule}]" in _refused(read_it, tmp_path / "a.usda", tmp_path)
    else:
        read_it(tmp_path / "a.usda")


def test_a_back_plate_that_is_no_path_is_none(tmp_path):
    camera = 'def Camera "c" {\n custom string backPlate:a:image = "x.exr"\n}\n'
    (tmp_path / "a.usda").write_text(_HEAD + _TRIANGLE + camera)
    (found,) = cameras_from_usd(tmp_path / "a.usda").cameras
    assert found.images == ("",)
