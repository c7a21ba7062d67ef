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

from tests.fuzzing.seeds import missing
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
from usdbrdf.untrusted.colmap_models import colmap_model
from usdbrdf.untrusted.e57_files import pictures_of_e57
from usdbrdf.untrusted.mesh_files import mesh_from_file, model_from_file
from usdbrdf.untrusted.pictures import picture_from_file
from usdbrdf.untrusted.raw_files import raw_picture
from usdbrdf.untrusted.replica_files import labelled_faces
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
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("albedo.npy", "w") as stream:
            np.save(stream, np.zeros(1000, np.uint8))
        archive.infolist()[0].file_size = 5 << 30  # as the directory at its end will say


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


def test_a_comment_may_end_a_row_of_a_matrix(tmp_path):
    (tmp_path / "m.txt").write_text("1 0 0 .5 # x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert _matrix(str(tmp_path / "m.txt"))[0, 3] == 0.5


def test_elements_without_bytes_are_zeros_of_a_sound_file(tmp_path):
    """As the morph targets are that many exporters write."""
    _glb({"bufferView": 0})(tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    document["accessors"].append({"componentType": 5126, "count": 9000, "type": "VEC3"})
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + content[20 + length :]
    (tmp_path / "b.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)
    for name in ("a.glb", "b.glb"):
        message = _refused(mesh_from_file, tmp_path / name, tmp_path)
        assert "[mesh.tiny]" in message  # three points in one place: it was read


@pytest.mark.fault("S4")
def test_a_name_with_newlines_and_control_characters_stays_on_one_line(tmp_path):
    for name in ("a\nb.ply", "a\x1b[2J.ply", "a\rb.ply"):
        (tmp_path / name).write_bytes(b"ply\nnothing")
        with pytest.raises(InputRefused) as refused:
            mesh_from_file(tmp_path / name)
        assert str(refused.value).endswith("[mesh.read]")
    write_ply(tmp_path / "a\nb.ply", np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    assert len(mesh_from_file(tmp_path / "a\nb.ply").triangles) == 1
