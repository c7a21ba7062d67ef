"""Meshes are taken vertex by vertex, and broken ones refused."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.scenes import room_mesh, write_ply
from usdbrdf.errors import InputRefused
from usdbrdf.model.mesh import triangulate
from usdbrdf.model.polygons import ears
from usdbrdf.untrusted import bounds
from usdbrdf.untrusted.mesh_files import FileMesh, checked_mesh, mesh_from_file, model_from_file
from usdbrdf.untrusted.mesh_ply import ply_of

_SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def test_ply_comes_back_bit_for_bit_with_its_labels(tmp_path):
    points, triangles, face_object, _ = room_mesh()
    write_ply(tmp_path / "mesh.ply", points, triangles, face_object)
    mesh = mesh_from_file(tmp_path / "mesh.ply")
    assert mesh.points.tobytes() == points.tobytes()
    assert mesh.triangles.tobytes() == triangles.tobytes()
    assert mesh.face_label is not None
    np.testing.assert_array_equal(mesh.face_label, face_object)
    assert mesh.kept is None


def test_a_container_of_little_memory_is_no_limit_on_addresses(tmp_path, monkeypatch):
    """Of which libraries take more than they fill: here 0.3 GB, and on many cores more."""
    points, triangles, face_object, _ = room_mesh()
    write_ply(tmp_path / "mesh.ply", points, triangles, face_object)
    monkeypatch.setattr(bounds, "machine_bytes", lambda: 128 << 20)
    assert len(mesh_from_file(tmp_path / "mesh.ply").points) == len(points)


def test_quads_become_two_triangles_in_place_and_keep_their_label(tmp_path):
    path = tmp_path / "quads.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property int object_id\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 6\n4 3 2 1 0 7\n"
    )
    mesh = mesh_from_file(path)
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 1], [3, 1, 0]]
    assert mesh.face_label is not None
    assert mesh.face_label.tolist() == [6, 6, 7, 7]


def _polygons(path: Path, order: str, faces: list[list[int]], *, corners_uv: bool = False) -> bytes:
    """A binary PLY of faces of several sizes, with texture coordinates (of each, or of each of
    its corners) and labels."""
    endian = "little" if order == "<" else "big"
    head = (
        f"ply\nformat binary_{endian}_endian 1.0\ncomment TextureFile a.png\n"
        "element vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
        f"property uchar red\nelement face {len(faces)}\n"
        "property list uchar uint vertex_indices\nproperty list uchar float texcoord\n"
        "property int object_id\nend_header\n"
    )
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
    body = b"".join(struct.pack(f"{order}3dB", *point, 9) for point in points)
    for i, face in enumerate(faces):
        body += struct.pack(f"{order}B{len(face)}I", len(face), *face)
        uv = [0, 0, i, 0.5, 0, 1] if corners_uv else [0.5, 0.5]
        body += struct.pack(f"{order}B{len(uv)}fi", len(uv), *uv, 6 + i)
    path.write_bytes(head.encode() + body)
    return head.encode() + body


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_triangles_beside_quads_are_read(tmp_path, order):
    path = tmp_path / "mixed.ply"
    content = _polygons(path, order, [[1, 4, 2], [0, 1, 2, 3], [2, 1, 0]])
    mesh = mesh_from_file(path)
    assert mesh.triangles.tolist() == [[1, 4, 2], [0, 1, 2], [0, 2, 3], [2, 1, 0]]
    assert mesh.points[4].tolist() == [2, 0, 0]
    assert mesh.face_label is not None
    assert mesh.face_label.tolist() == [6, 7, 7, 8]
    path.write_bytes(content[:-3])
    with pytest.raises(InputRefused, match=r"\[mesh\.read\]$"):
        mesh_from_file(path)


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
@pytest.mark.parametrize("counts", [("uchar", "B"), ("int", "i"), ("float", "f")])
def test_many_faces_of_several_sizes_take_no_time(tmp_path, order, counts):
    rng = np.random.default_rng(1)
    kind, packed = counts
    sizes = rng.integers(3, 6, 60_000)
    faces = [np.arange(size) + 5 * (i % 1000) for i, size in enumerate(sizes.tolist())]
    turns = np.array([0, 1, 2, 3, 4]) * 1.2
    points = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
    points = np.tile(points, (1000, 1)).astype("f4")
    named = {"<": "binary_little_endian", ">": "binary_big_endian"}.get(order, order)
    head = (
        f"ply\nformat {named} 1.0\nelement vertex 5000\nproperty float x\nproperty float y\n"
        f"property float z\nelement face 60000\nproperty short material\n"
        f"property list {kind} int vertex_indices\nproperty int object_id\nend_header\n"
    )
    if order == "ascii":
        rows = [f"{x} {y} {z}" for x, y, z in points.tolist()]
        rows += [f"7 {len(f)} {' '.join(map(str, f))} {i}" for i, f in enumerate(faces)]
        body = ("\n".join(rows) + "\n").encode()
    else:
        body = points.astype(f"{order}f4").tobytes()
        for i, face in enumerate(faces):
            body += struct.pack(f"{order}h{packed}{len(face)}ii", 7, len(face), *face, i)
    start = time.process_time()
    ply = ply_of(head.encode() + body)
    assert time.process_time() - start < 0.6
    assert ply.counts.tolist() == sizes.tolist()
    assert ply.corners.tolist() == np.concatenate(faces).tolist()
    assert ply.faces["object_id"].tolist() == list(range(60_000))
    assert set(ply.faces["material"].tolist()) == {7}
    if order != "ascii":
        with pytest.raises(ValueError, match="ends within a face"):
            ply_of(head.encode() + body[:-1])


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_strips_of_triangles_are_faces(tmp_path, order):
    """As Stanford's scans have them: what is below 0 ends a strip, a vertex twice leads it on."""
    strips = [[0, 1, 2, 3, -1, 2, 3, 4, 5, 5, 0, -1], [4, 3, 0]]
    named = {"<": "binary_little_endian", ">": "binary_big_endian"}.get(order, order)
    head = (
        f"ply\nformat {named} 1.0\nelement vertex 6\nproperty float x\nproperty float y\n"
        "property float z\nelement tristrips 2\nproperty list int int vertex_indices\nend_header\n"
    )
    points = np.array([(i % 2, i // 2, 0) for i in range(6)], f"{order[:1].strip('a')}f4")
    if order == "ascii":
        rows = [*points.tolist(), *([len(strip), *strip] for strip in strips)]
        body = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    else:
        body = points.tobytes()
        for strip in strips:
            body += struct.pack(f"{order}{len(strip) + 1}i", len(strip), *strip)
    path = tmp_path / "dragon.ply"
    path.write_bytes(head.encode() + body)
    expected = [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [4, 3, 0]]
    assert mesh_from_file(path).triangles.tolist() == expected
    (surface,) = model_from_file(path)
    assert surface.triangles.tolist() == expected
    assert surface.points.tolist() == points.tolist()


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_corners_with_texture_coordinates_part_no_vertices(tmp_path, order):
    """As MeshLab writes them: triangles alone, each corner with its own place in the picture."""
    path = tmp_path / "textured.ply"
    faces = [[1, 4, 2], [0, 1, 2], [2, 1, 0]]
    content = _polygons(path, "<" if order == "ascii" else order, faces, corners_uv=True)
    if order == "ascii":
        head = (
            content[: content.index(b"end_header")].decode().replace("binary_little_endian", order)
        )
        rows = ["0 0 0 9", "1 0 0 9", "1 1 0 9", "0 1 0 9", "2 0 0 9"]
        for i, face in enumerate(faces):
            corners = " ".join(map(str, face))
            rows.append(f"3 {corners} 6 0 0 {i} 0.5 0 1 {6 + i}")
        path.write_text(head + "end_header\n" + "\n".join(rows) + "\n")
    mesh = mesh_from_file(path)
    assert mesh.triangles.tolist() == faces
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]]
    assert mesh.face_label is not None
    assert mesh.face_label.tolist() == [6, 7, 8]


# A room in the shape of an L, seen from above, which a fan from its first corner leaves; a square
# with a square hole, which a cut joins to the outline.
_L = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]
_HOLED = [
    (0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1),
]  # fmt: skip
_DART = [(0, 0), (4, 1), (0, 2), (1, 1)]


def _files_of_polygon(folder: Path, corners: list[tuple[int, int]], *, turned: bool) -> list[Path]:
    """A triangle, then the polygon, in a plane that leans, in OBJ and in both kinds of PLY."""
    points = [*((x, y, x + 2.0 * y) for x, y in corners), (0, 0, 5), (1, 0, 6), (0, 1, 7)]
    faces = [[len(corners), len(corners) + 1, len(corners) + 2], [*range(len(corners))]]
    faces = [face[::-1] for face in faces] if turned else faces
    rows = [f"v {x} {y} {z}" for x, y, z in points]
    rows += ["f " + " ".join(f"{i + 1}/1" for i in face) for face in faces]
    (folder / "polygon.obj").write_text("\n".join(["vt 0 0", *rows, ""]))
    head = (
        f"ply\nformat {{}} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property int object_id\nend_header\n"
    )
    rows = [f"{x} {y} {z}" for x, y, z in points]
    rows += [f"{len(face)} {' '.join(map(str, face))} {7 + i}" for i, face in enumerate(faces)]
    (folder / "text.ply").write_text(head.format("ascii") + "\n".join(rows) + "\n")
    body = np.float32(points).tobytes()
    for i, face in enumerate(faces):
        body += struct.pack(f"<B{len(face)}ii", len(face), *face, 7 + i)
    (folder / "binary.ply").write_bytes(head.format("binary_little_endian").encode() + body)
    return [folder / name for name in ("polygon.obj", "text.ply", "binary.ply")]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("corners", "area"), [(_L, 3), (_L[:5], 2), (_HOLED, 8), (_DART, 3)])
def test_polygons_of_any_shape_are_covered_once(tmp_path, corners, area, turned):
    for path in _files_of_polygon(tmp_path, corners, turned=turned):
        mesh = mesh_from_file(path)
        assert len(mesh.triangles) == 1 + len(corners) - 2
        (surface,) = model_from_file(path)
        for points, triangles in (
            (mesh.points, mesh.triangles), (surface.points, surface.triangles)
        ):  # fmt: skip
            x, y = np.moveaxis(points[triangles[1:]].astype(np.float64), -1, 0)[:2]
            seen = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0])
            seen = (seen - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])) / 2
            assert ((-seen if turned else seen) >= 0).all()
            assert abs(seen.sum()) == pytest.approx(area)
        if path.suffix == ".ply":
            assert mesh.face_label.tolist() == [7] + [8] * (len(corners) - 2)


def test_polygons_that_cross_themselves_and_many_quads_take_no_time():
    rng = np.random.default_rng(0)
    tangle = np.pad(rng.random((1600, 2)), ((0, 0), (0, 1)))
    darts = np.tile([(*corner, 0) for corner in _DART], (20_000, 1))
    start = time.process_time()
    triangles = ears(tangle)
    cut = triangulate(np.full(20_000, 4), np.arange(80_000), points=darts)
    assert time.process_time() - start < 10
    assert triangles.shape == (1598, 3)
    assert np.unique(triangles).size == 1600
    assert cut.corners[-2:].tolist() == [[79_997, 79_998, 79_999], [79_997, 79_999, 79_996]]


def test_polygons_of_very_many_corners_are_fans():
    turns = np.linspace(0, 2 * np.pi, 2100, endpoint=False)
    across = np.where(np.arange(2100) % 2, 1, 0.5)
    star = np.stack([across * np.cos(turns), across * np.sin(turns), 0 * turns], axis=1)
    cut = triangulate(np.array([2100]), np.arange(2100), points=star)
    assert (cut.corners[:, 0] == 0).all()


def test_objects_of_an_obj_may_have_faces_of_other_sizes(tmp_path):
    """trimesh has those of each object as they are, where they all have as many corners."""
    path = tmp_path / "mesh.obj"
    objects = "o three\nf 1 2 3\no four\nf 1 2 3 4\nf 4 3 2 1\no five\nf 1 2 5 3 4\nf 4 3 5 2 1\n"
    path.write_text(f"{_SQUARE}v 2 0.5 0\n{objects}")
    mesh = mesh_from_file(path)
    assert mesh.face_label is not None
    found = dict(zip(("three", "four", "five"), ([], [], []), strict=True))
    for label, corners in zip(mesh.face_label.tolist(), mesh.triangles, strict=True):
        # A triangle is the same from whichever corner on.
        first = int(np.argmin(corners))
        found[mesh.label_names[label]].append(np.roll(corners, -first).tolist())
    a, b, c, d, e = range(5)
    assert found == {
        "three": [[a, b, c]],
        "four": [[a, b, c], [a, c, d], [b, d, c], [a, d, b]],
        "five": [[a, b, e], [a, e, c], [a, c, d], [c, e, d], [b, d, e], [a, d, b]],
    }
    assert sum(len(surface.triangles) for surface in model_from_file(path)) == 11


@pytest.mark.parametrize(
    "written",
    [
        lambda text: text.replace("comment", "comment Größe in Metern,").encode("latin-1"),
        lambda text: text.replace("end_header\n", "end_header\n\n").encode(),
        lambda text: text.replace("\n", "\r").encode(),
        lambda text: text.replace("\n", " \r\n").replace(" \r", "\r", 1).encode(),
        lambda text: text.replace("\n0 1 2", "\n\n  0\t1\n2").encode(),
        lambda text: text.replace("of mine", "before the end_header\ncomment b").encode(),
        lambda text: text.replace("format ascii", "format\tascii").encode(),
        lambda text: text.replace("list uchar", "list float").encode(),
        lambda text: text.replace(" 0\n", " 0 7 7\n").replace("0 1 2\n1", "0 1 2 7 7\n1").encode(),
        lambda text: text.replace("3 0 1 2\n", "3 0 1 2 9\n").encode(),
        lambda text: (
            text.replace("indices\n", "indices\nproperty int n\nproperty int corners\n") + "8 9\n"
        ).encode(),
    ],
)
def test_text_of_ply_may_be_written_in_other_ways(tmp_path, written):
    text = (
        "ply\nformat ascii 1.0\ncomment of mine\nelement vertex 3\nproperty float x\n"
        "property float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 1 2\n1 0 0\n1 1 0\n3 0 1 2\n"
    )
    (tmp_path / "mesh.ply").write_bytes(written(text))
    assert mesh_from_file(tmp_path / "mesh.ply").points.tolist() == [
        [0, 1, 2],
        [1, 0, 0],
        [1, 1, 0],
    ]
    (surface,) = model_from_file(tmp_path / "mesh.ply")
    assert surface.triangles.tolist() == [[0, 1, 2]]


def test_binary_ply_whose_header_has_lines_of_cr_alone(tmp_path):
    """Its first number begins with the byte of a LF."""
    content = _polygons(tmp_path / "a.ply", "<", [[1, 4, 2]])
    head, body = content.split(b"end_header\n")
    body = b"\n" + body[1:]
    (tmp_path / "a.ply").write_bytes(head.replace(b"\n", b"\r") + b"end_header\r" + body)
    assert mesh_from_file(tmp_path / "a.ply").points[1:3].tolist() == [[1, 0, 0], [1, 1, 0]]


@pytest.mark.parametrize(
    ("kind", "row", "words"),
    [
        ("float", "3 0 1 1.5 0", "a face has the vertex 1.5"),
        ("int", "3 0 1 2 nan", "object_id nan, no object's number"),
        ("int", "3 0 1 2 1.5", "object_id 1.5, no object's number"),
        ("int", "3 0 1 2 7", ""),
    ],
)
def test_numbers_of_vertices_and_objects_are_whole(tmp_path, kind, row, words):
    path = tmp_path / "mesh.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\nelement face 1\nproperty list float {kind} vertex_indices\n"
        f"property float object_id\nend_header\n0 0 0\n1 0 0\n1 1 0\n{row}\n"
    )
    if words:
        with pytest.raises(InputRefused, match=rf"mesh\.ply: .*{words}.*\[mesh\.read\]$"):
            mesh_from_file(path)
    else:
        assert mesh_from_file(path).face_label.tolist() == [7]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("property float y", "property vec y"), "numbers of an unknown kind, 'vec'"),
        (("1 0 0", "1 zero 0"), "it holds 'zero', which is no number"),
        (("3 0 1 2\n", "3 0 1 2\n3 0 1 2\n"), "4 numbers more than its header announces"),
        (("float z", "float w"), "no vertices with x, y and z"),
        (("end_header", "header ends"), "no end of its header"),
        (("ascii", "packed"), "its format is 'packed'"),
        (("element vertex", "element vertex of"), "its header has the line"),
        (("element face", "element vertex 0\nelement face"), "more than one element 'vertex'"),
        (("list uchar int", "int"), "its faces have no list vertex_indices"),
        (("3 0 1 2", "inf 0 1 2"), "a list has inf elements"),
        (("3 0 1 2", "2.5 0 1 2"), "a list has 2.5 elements"),
        (("1 1 0\n", "1 1 0 5\n"), "it ends within a face"),
    ],
)
def test_ply_that_says_no_mesh_is_refused_in_our_words(tmp_path, change, words):
    text = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n"
    )
    (tmp_path / "mesh.ply").write_text(text.replace(*change))
    with pytest.raises(InputRefused, match=r"mesh\.ply: .*\[mesh\.read\]$") as refused:
        mesh_from_file(tmp_path / "mesh.ply")
    assert words in str(refused.value)


@pytest.mark.parametrize("face", ["f 1 2 9", "f 1/1 2/1 3/1 9/1", "f 9//1 2//1 3//1"])
def test_the_line_of_an_obj_is_named_whose_vertex_is_not_there(tmp_path, face):
    path = tmp_path / "mesh.obj"
    path.write_text(f"{_SQUARE}vt 0 0\nf 1 \\\n 2 3\nf 1 2 3\n{face}\nf 1 3 4\n")
    with pytest.raises(
        InputRefused, match=r"line 9: .* vertex 9, but there are 4\..*\[mesh\.index\]$"
    ):
        mesh_from_file(path)


def test_obj_may_count_its_vertices_back_from_where_a_face_stands(tmp_path):
    path = tmp_path / "back.obj"
    triangle = "v 0 0 {0}\nv 1 0 {0}\nvt 0 0\nv 0 \\\n 1 {0}\nf -3/-1 -2/-1 -1/-1\n"
    path.write_text("o near\n" + triangle.format(0) + "o far\n" + triangle.format(5))
    mesh = mesh_from_file(path)
    assert mesh.face_label is not None
    height = {
        mesh.label_names[label]: mesh.points[corners][:, 2].tolist()
        for corners, label in zip(mesh.triangles, mesh.face_label, strict=True)
    }
    assert height == {"near": [0, 0, 0], "far": [5, 5, 5]}
    shown = [s.points[s.triangles][..., 2].tolist() for s in model_from_file(path)]
    assert np.concatenate(shown).tolist() == [[0, 0, 0], [5, 5, 5]]


@pytest.mark.parametrize(
    "written",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace(" ", "\t"),
        lambda text: text.replace(" ", "  ").replace("\n", " \r\n"),
        lambda text: text.replace("\n", " # of mine\n"),
        lambda text: f"o seat #1\n{text}\n# 4 vertices, 2 faces",
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("\n", "\n  "),
    ],
)
def test_obj_may_be_written_in_other_ways(tmp_path, written):
    text = f"{_SQUARE}v 9 9 9\nf 1 2 3\nf 1 3 4\n"
    (tmp_path / "mesh.obj").write_text(written(text), newline="")
    mesh = mesh_from_file(tmp_path / "mesh.obj")
    assert mesh.points[:4].tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


_PLY_OF_SQUARE = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
)


@pytest.mark.parametrize("name", ["square.obj", "square.ply"])
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-16-le", "utf-8-sig"])
def test_text_of_meshes_may_be_in_utf_16(tmp_path, name, encoding):
    """As PowerShell's > and editors of Windows write it, with a mark or without."""
    path = tmp_path / name
    text = _PLY_OF_SQUARE if name.endswith("ply") else f"{_SQUARE}o K\u00fcche\nf 1 2 3\nf 1 3 4\n"
    path.write_text(text, encoding=encoding)
    assert mesh_from_file(path).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    (surface,) = model_from_file(path)
    assert len(surface.triangles) == 2
    if encoding == "utf-16":
        path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(InputRefused, match=r"text in UTF-16 that breaks off.*\[mesh\.read\]$"):
            mesh_from_file(path)


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1/1 2/1 0/1", "f -1 -2 -5"])
def test_obj_faces_with_vertices_before_the_first_are_refused(tmp_path, face):
    (tmp_path / "from_0.obj").write_text(_SQUARE + face + "\n")
    with pytest.raises(InputRefused, match=r"\[mesh\.read\]$"):
        mesh_from_file(tmp_path / "from_0.obj")


@pytest.mark.parametrize(
    ("first", "second", "names"),
    [
        ("g seat", "g back", {"seat", "back"}),
        ("g seat\ns off\nusemtl grey", "g back\nusemtl grey", {"seat", "back"}),
        ("o chair\ng seat", "g back", set()),
        ("g seat", "s 1", set()),
    ],
)
def test_groups_of_an_obj_without_objects_are_its_objects(tmp_path, first, second, names):
    path = tmp_path / "chair.obj"
    path.write_text(f"{_SQUARE}{first}\nf 1 2 3\n{second}\nf 1 3 4\n")
    mesh = mesh_from_file(path)
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert {*mesh.label_names} == names


def test_faces_of_an_obj_stay_in_their_order_whatever_divides_them(tmp_path):
    """Labels by the number of a face would be another's; here of triangles, quads and a pentagon,
    of materials that come back and whose names go the other way."""
    path = tmp_path / "floor.obj"
    grid = "".join(f"v {i % 6} {i // 6} 0\n" for i in range(12)) + "vt 0 0\nvt 1 1\n"
    faces = ["1 2 8", "2 3 9 8", "3/1 4/2 10/1", "4 5 6 12 11", "1 8 7", "5 11 10"]
    materials = ["z", "a", "z", "m", "a", "b"]
    lines = (f"usemtl {m}\nf {face}\n" for m, face in zip(materials, faces, strict=True))
    path.write_text(grid + "".join(lines))
    mesh = mesh_from_file(path)
    corners = [[int(word.split("/")[0]) - 1 for word in face.split()] for face in faces]
    expected = [sorted(own) for own in corners for _ in own[2:]]
    assert mesh.points.tolist() == [[i % 6, i // 6, 0] for i in range(12)]
    for triangle, own in zip(mesh.triangles.tolist(), expected, strict=True):
        assert {*triangle} <= {*own}
    assert mesh.label_names == ("z", "a", "m", "b")
    assert mesh.face_label is not None
    assert mesh.face_label.tolist() == [0, 1, 1, 0, 2, 2, 2, 1, 3]


def test_obj_keeps_vertices_and_its_objects_become_labels(tmp_path):
    path = tmp_path / "two.obj"
    path.write_text(_SQUARE + "o seat\nf 1 2 3\no back\nf 1 3 4\n")
    mesh = mesh_from_file(path)
    assert len(mesh.triangles) == 2
    assert mesh.face_label is not None
    assert {mesh.label_names[i] for i in mesh.face_label.tolist()} == {"seat", "back"}


def test_glb_nodes_become_labels_in_world_positions(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), node_name="box")
    moved = trimesh.transformations.translation_matrix([3, 0, 0])
    scene.add_geometry(trimesh.creation.icosphere(), node_name="ball", transform=moved)
    scene.export(tmp_path / "scene.glb")
    mesh = mesh_from_file(tmp_path / "scene.glb")
    assert sorted(mesh.label_names) == ["ball", "box"]
    np.testing.assert_allclose(mesh.points.max(axis=0), [4, 1, 1], atol=1e-6)


def _quad_glb(path: Path, **changes: object) -> None:
    """A square of two triangles; ``changes`` of its document, of the first entry of what is a
    list."""
    points = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    blob = points.tobytes() + np.uint32([0, 1, 2, 0, 2, 3]).tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"byteLength": len(blob)}],
    }
    primitive = document["meshes"][0]["primitives"][0]
    for key, change in changes.items():
        if key == "primitive":
            primitive.update(change)
        elif isinstance(change, dict):
            document[key][0].update(change)
        else:
            document[key] = change
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob)


_DRACO = {"extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}}
_SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5125}, "values": {}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"primitive": _DRACO, "accessors": [{"componentType": 5126, "count": 4, "type": "VEC3"},
             {"componentType": 5125, "count": 6, "type": "SCALAR"}]},
            "compressed (Draco)",
        ),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "compressed (meshopt)"),
        ({"nodes": {"extensions": {"EXT_mesh_gpu_instancing": {}}}}, "copies of meshes"),
        ({"accessors": {"sparse": _SPARSE}}, "sparse"),
        ({"accessors": {"componentType": 5122, "normalized": True}}, "quantised"),
        ({"primitive": {"mode": 6}}, "fans"),
        ({"nodes": {"skin": 0}, "skins": [{"joints": [0]}]}, "its mesh '0' is posed by a skeleton"),
        (
            {"meshes": {"name": "face", "weights": [0, 0.5]}, "primitive": {"targets": [{}, {}]}},
            "its mesh 'face' is shaped by morph targets",
        ),
        ({"nodes": {"weights": [1]}, "primitive": {"targets": [{}]}}, "morph targets"),
    ],
)  # fmt: skip
def test_glb_whose_geometry_would_be_another_is_refused(tmp_path, changes, words):
    """trimesh would leave some of it out, or take zeros and whole numbers for places."""
    path = tmp_path / "mesh.glb"
    _quad_glb(path, primitive=_DRACO)  # beside vertices as they are
    assert mesh_from_file(path).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    _quad_glb(path, **changes)
    for read in (mesh_from_file, model_from_file):
        with pytest.raises(InputRefused, match=r"mesh\.glb: .*\[mesh\.format\]$") as refused:
            read(path)
        assert words in str(refused.value)


@pytest.mark.parametrize("weights", [{}, {"weights": [0.0]}])
def test_morph_targets_of_no_weight_leave_a_glb_as_it_is(tmp_path, weights):
    primitive = {"targets": [{"POSITION": 0}]}
    _quad_glb(tmp_path / "mesh.glb", primitive=primitive, meshes=weights)
    assert mesh_from_file(tmp_path / "mesh.glb").triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.fault("G2")
@pytest.mark.parametrize("broken", ["nan", "index"])
def test_a_few_broken_faces_are_left_out(tmp_path, broken):
    points, triangles, face_object, _ = room_mesh(subdivisions=8)
    if broken == "nan":
        points[triangles[5, 0]] = np.nan
        expected = ~(triangles == triangles[5, 0]).any(axis=1)
    else:
        triangles[5, 0] = -1
        expected = np.arange(len(triangles)) != 5
    write_ply(tmp_path / "mesh.ply", points, triangles, face_object)
    mesh = mesh_from_file(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(mesh.kept, expected)
    assert np.isfinite(mesh.points).all()
    assert len(mesh.triangles) == len(mesh.face_label) == expected.sum()


_SPLATS = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty %s\nend_header\n1234"


def test_files_of_other_kinds_say_what_to_do(tmp_path):
    (tmp_path / "splats.ply").write_bytes(_SPLATS % b"float f_dc_0")
    with pytest.raises(InputRefused, match=r"Gaussian splats, which have no surface\. Have a mesh"):
        mesh_from_file(tmp_path / "splats.ply")
    with pytest.raises(InputRefused, match=r"Save it as GLB\."):
        mesh_from_file(tmp_path / "room.gltf")


def test_a_mesh_whose_vertices_are_gaussians_too_is_a_mesh(tmp_path):
    axes = "".join(f"property float {name}\n" for name in ("x", "y", "z", "f_dc_0"))
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}element face 1\n"
    rows = "property list uchar int vertex_indices\nend_header\n0 0 0 1\n1 0 0 1\n0 1 0 1\n"
    (tmp_path / "mesh.ply").write_text(f"{head}{rows}3 0 1 2\n")
    assert len(mesh_from_file(tmp_path / "mesh.ply").triangles) == 1


def test_a_large_compressed_glb_says_that_it_is_compressed(tmp_path):
    """All of whose elements are announced, and none has bytes."""
    accessors = [
        {"componentType": 5126, "count": 2_000_000, "type": "VEC3"},
        {"componentType": 5125, "count": 12_000_000, "type": "SCALAR"},
    ]
    _quad_glb(tmp_path / "mesh.glb", primitive=_DRACO, accessors=accessors)
    with pytest.raises(InputRefused, match=r"its meshes are compressed \(Draco\)"):
        mesh_from_file(tmp_path / "mesh.glb")
    _quad_glb(tmp_path / "mesh.glb", accessors=accessors)
    with pytest.raises(InputRefused, match=r"14000000 elements without bytes"):
        mesh_from_file(tmp_path / "mesh.glb")


@pytest.mark.fault("G1")
@pytest.mark.fault("G8")
@pytest.mark.parametrize(
    ("name", "content", "rule"),
    [
        ("empty.ply", b"", "mesh.read"),
        ("garbage.ply", b"\x00\x01garbage", "mesh.read"),
        ("garbage.glb", b"glTF\x02\x00\x00\x00\x10", "mesh.read"),
        ("nothing.obj", b"", "mesh.empty"),
        ("points.obj", _SQUARE.encode(), "mesh.empty"),
        ("index.obj", (_SQUARE + "f 1 2 9\n").encode(), "mesh.index"),
        ("far.obj", b"v 0 0 0\nv 1e9 0 0\nv 0 1 0\nf 1 2 3\n", "mesh.far"),
        ("tiny.obj", b"v 0 0 0\nv 1e-9 0 0\nv 0 1e-9 0\nf 1 2 3\n", "mesh.tiny"),
        ("mesh.stl", b"solid", "mesh.format"),
        ("mesh.gltf", b"{}", "mesh.format"),
        ("splats.ply", _SPLATS % b"float f_dc_0", "mesh.empty"),
        ("packed.ply", _SPLATS % b"uint packed_position", "mesh.empty"),
    ],
)
def test_unusable_files_are_refused_in_one_sentence(tmp_path, name, content, rule):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputRefused, match=rf"{name}: .*\[{rule}\]$") as refused:
        mesh_from_file(tmp_path / name)
    assert "\n" not in str(refused.value)


@pytest.mark.fault("G8")
def test_georeferenced_points_that_single_precision_would_move_are_refused(tmp_path):
    """At 600 km steps are of 6 cm; in a mesh of 4 km they say nothing. Northings of UTM are farther
    away, and their cure is the same: cameras come along."""
    cases = ((4, 0, False), (4, 6e5, True), (4000, 6e5, False), (4, 5.4e6, True))
    for size, place, refused in cases:
        x, y = place, place / 3
        corners = [(x, y), (x + size, y), (x + size, y + size)]
        rows = "".join(f"v {p:.3f} {q:.3f} 400\n" for p, q in corners)
        (tmp_path / "mesh.obj").write_text(rows + "f 1 2 3\n")
        if refused:
            with pytest.raises(InputRefused, match=r"one offset .*\[mesh\.far\]$"):
                mesh_from_file(tmp_path / "mesh.obj")
        else:
            assert len(mesh_from_file(tmp_path / "mesh.obj").triangles) == 1


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_truncated_files_are_refused(tmp_path, share):
    points, triangles, face_object, _ = room_mesh()
    path = tmp_path / "mesh.ply"
    write_ply(path, points, triangles, face_object)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputRefused, match=r"\[mesh\.(read|empty)\]"):
        mesh_from_file(path)


def test_a_folder_in_place_of_the_mesh_is_refused(tmp_path):
    (tmp_path / "mesh.ply").mkdir()
    with pytest.raises(InputRefused, match=r"not a regular file.*\[mesh.missing\]"):
        mesh_from_file(tmp_path / "mesh.ply")


@pytest.mark.fault("G7")
def test_more_triangles_than_can_be_a_scan_are_refused_before_they_are_looked_at(tmp_path):
    """50 million and one, which take no memory."""
    many = np.broadcast_to(np.arange(3, dtype=np.int32), (50_000_001, 3))
    mesh = FileMesh(points=np.eye(3, dtype=np.float32), triangles=many)
    with pytest.raises(InputRefused, match=r"50000001 triangles .*Reduce.*\[mesh\.size\]$"):
        checked_mesh(mesh, tmp_path / "mesh.ply")
