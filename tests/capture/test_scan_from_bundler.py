"""Bundler's files, written after its manual (v0.4, "Output format and scene representation") and
COLMAP's exporter (reconstruction_io.cc, ExportBundler)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.capture.reconstructions.bundler import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True, meters_per_unit=1.0)
HEAD = "# Bundle file v0.3\n"


def _document(room, *, k1=0.0, k2=0.0, head=HEAD, lost=()):
    lines = [f"{len(room.images)} 1"]
    for i, pose in enumerate(room.world_from_camera):
        turn = pose[:3, :3].T
        rows = [[room.intrinsics[i, 0], k1, k2], *turn, -turn @ pose[:3, 3]]
        rows = np.zeros((5, 3)) if i in lost else rows
        lines += [" ".join(f"{number:.17g}" for number in row) for row in rows]
    return head + "\n".join([*lines, "1.5 2.5 3.5", "255 0 0", "2 0 7 -3.5 4.25 1 9 2.5 1.5", ""])


def _write(folder, room, document, name="bundle.out", listed="list.txt", line="images/{}.jpg"):
    names = [f"{i:04d}" for i in range(len(room.images))]
    for i, image in zip(names, room.images, strict=True):
        write_image(folder / "images" / f"{i}.jpg", image)
    write_obj(folder / "mesh.obj", room)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text(document)
    (folder / listed).write_text("\n".join(line.format(i) for i in names) + "\n")


@pytest.mark.parametrize(
    ("name", "listed", "line"),
    [
        ("bundle.out", "list.txt", "images/{}.jpg 0 532.5"),
        ("bundle/bundle.out", "list.txt", "images/{}.jpg"),
        ("room.bundle.out", "room.list.txt", "{}.jpg"),
        ("cameras.out", "cameras_list.txt", "D:\\shoot\\{}.JPG"),
        ("room.out", "room-list.txt", "./images/{}.jpg 0 1e3"),
    ],
)
def test_the_document_is_the_room(tmp_path, name, listed, line):
    room = truth().centred()
    _write(tmp_path, room, _document(room), name, listed, line)
    assert choose_adapter(tmp_path / name).name == choose_adapter(tmp_path).name == "bundler"
    assert choose_adapter(tmp_path, "bundler").module.matches(tmp_path)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert scan.adapter == "bundler"


@pytest.mark.parametrize("named", ["bundle/bundle.out", "bundle"])
def test_the_list_is_found_above_the_folder_of_bundler(tmp_path, named):
    room = truth().centred()
    _write(tmp_path, room, _document(room), "bundle/bundle.out")
    scan = read_scan(tmp_path / named, OPTIONS)
    assert_same(scan, room)
    beside = files_beside(choose_adapter(tmp_path / named), tmp_path / named, None)
    own = [tmp_path / "list.txt", tmp_path / "mesh.obj"]
    assert beside == sorted([*scan.frames.image_paths, *own])
    assert files_beside(choose_adapter(tmp_path), tmp_path, None) == []


def test_half_of_a_list_that_an_archive_of_a_mac_brings_is_none(tmp_path):
    room = truth().centred()
    _write(tmp_path, room, _document(room), "bundle/bundle.out")
    (tmp_path / "bundle/._list.txt").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    assert_same(read_scan(tmp_path / "bundle", OPTIONS), room)


def test_a_capture_may_be_called_as_the_folder_of_bundler(tmp_path):
    room = truth().centred()
    _write(tmp_path / "bundle", room, _document(room))
    assert_same(read_scan(tmp_path / "bundle/bundle.out", OPTIONS), room)


def test_folders_of_pmvs_have_their_pictures_undistorted_and_numbered(tmp_path):
    """The list names the originals, whose lens these cameras do not have."""
    room = truth().centred()
    _write(tmp_path, room, _document(room), "bundle.rd.out", "bundle.rd.out.list.txt", "{}.jpg")
    (tmp_path / "visualize").mkdir()
    for i in range(10):
        place = tmp_path / f"visualize/{i:08d}.jpg"
        (tmp_path / f"images/{i:04d}.jpg").rename(place)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert {path.parent.name for path in scan.frames.image_paths} == {"visualize"}


def test_a_file_of_its_name_needs_no_remark_at_its_head(tmp_path):
    room = truth().centred()
    _write(tmp_path, room, _document(room, head=""))
    assert_same(read_scan(tmp_path, OPTIONS), room)


def test_what_was_never_placed_is_left_out(tmp_path):
    room = truth().centred()
    _write(tmp_path, room, _document(room, lost=(3, 7)))
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 8
    assert any("2 of 10 frames dropped" in said for said in scan.warnings)


def test_distortions_are_those_of_bundler(tmp_path):
    """p = -P / P.z; p' = f r(p) p with r = 1 + k1 |p|^2 + k2 |p|^4, from the middle, y up."""
    room, (k1, k2) = truth().centred(), (-0.1, 0.02)
    (tmp_path / "bundle.out").write_text(_document(room, k1=k1, k2=k2))
    shot = shots_of(tmp_path / "bundle.out", tuple("abcdefghij"))[4]
    pose = room.world_from_camera[4]
    point = pose[:3, 3] + pose[:3, :3] @ (0.31, 0.23, -1.0)
    turn = pose[:3, :3].T
    seen = turn @ point - turn @ pose[:3, 3]
    p = -seen[:2] / seen[2]
    squared = (p**2).sum()
    across, up = room.intrinsics[4, 0] * (1 + k1 * squared + k2 * squared**2) * p
    camera = shot.camera.of_size(WIDTH, HEIGHT)
    world = shot.world_from_camera
    local = (world[:3, :3].T @ (point - world[:3, 3])) * (1, -1, -1)
    pixel = camera.lens.project(local, camera.intrinsics)
    np.testing.assert_allclose(pixel, (WIDTH / 2 + across, HEIGHT / 2 - up), atol=1e-9)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda text: text[: len(text) // 2], "It was cut off, or is of another format"),
        (lambda text: text.replace("10 1\n", "10\n", 1), "says how many cameras and points follow"),
        (
            lambda text: text.replace("10 1\n", "1e300 1\n", 1),
            "says how many cameras and points follow",
        ),
        (
            lambda text: text.replace("10 1\n", "nan 1\n", 1),
            "says how many cameras and points follow",
        ),
        (lambda text: text.replace("10 1\n", "9 1\n", 1), "9 cameras, but 10 pictures in the list"),
        (lambda text: text.replace("10 1\n", "10 1\nfocal length\n", 1), "not a row of numbers"),
        (lambda text: HEAD, "no line at its beginning says"),
    ],
)
def test_a_broken_file_is_refused(tmp_path, broken, said):
    room = truth().centred()
    _write(tmp_path, room, broken(_document(room)))
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def test_without_its_list_nobody_knows_whose_cameras_they_are(tmp_path):
    room = truth().centred()
    _write(tmp_path, room, _document(room))
    (tmp_path / "list.txt").unlink()
    with pytest.raises(InputRefused, match=r"no bundle\.list\.txt or list\.txt beside it"):
        read_scan(tmp_path, OPTIONS)


def test_a_picture_that_cannot_be_read_has_no_middle(tmp_path):
    room = truth().centred()
    _write(tmp_path, room, _document(room))
    (tmp_path / "images/0004.jpg").write_bytes(b"no picture")
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 9


def test_cameras_of_no_pictures_say_so(tmp_path):
    room = replace(truth().centred(), images=[])
    _write(tmp_path, room, HEAD + "0 0\n")
    with pytest.raises(InputRefused, match="no pictures below"):
        read_scan(tmp_path, OPTIONS)
