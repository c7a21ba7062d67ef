"""LLFF folders, written as imgs2poses writes them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.inspection import inspect
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions, InspectOptions

OPTIONS = IngestOptions(assume_srgb=True)


@pytest.fixture
def room():
    return truth().centred()


@pytest.fixture
def capture(tmp_path, room):
    return write_llff(tmp_path / "head", room)


def write_llff(folder, room):
    """Poses as LLFF's own writer stores them; returns the folder."""
    rows = []
    for pose, lens in zip(room.opencv, room.intrinsics, strict=True):
        hwf = np.array([[HEIGHT], [WIDTH], [lens[0]]])
        # LLFF's own writer: from [right, down, forwards] to [down, right, backwards].
        matrix = np.concatenate(
            [pose[:3, 1:2], pose[:3, 0:1], -pose[:3, 2:3], pose[:3, 3:], hwf], 1
        )
        rows.append([*matrix.ravel(), 0.5, 9.0])
    folder.mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", np.array(rows))
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"IMG_{i:04d}.jpg", image)
    write_ply(folder / "surface.ply", room.points, room.triangles, room.face_object)
    return folder


def test_poses_are_read(capture, room):
    assert choose_adapter(capture).name == "llff"
    scan = read_scan(capture, OPTIONS)
    assert_same(scan, room)
    assert (scan.adapter, len(scan.objects)) == ("llff", len(room.names))


def test_radiance_beside_the_photographs_is_taken(capture, room):
    for i, image in enumerate(room.images):
        write_image(capture / "images" / f"IMG_{i:04d}.exr", image)
    scan = read_scan(capture, IngestOptions())
    assert {path.suffix for path in scan.frames.image_paths} == {".exr"}
    assert len(scan.frames) == len(room.images)
    assert any("radiance beside" in warning for warning in scan.warnings)


def test_one_picture_too_many_is_still_refused(capture, room):
    write_image(capture / "images" / "extra.jpg", room.images[0])
    with pytest.raises(InputRefused, match=r"poses for .* pictures"):
        read_scan(capture, OPTIONS)


@pytest.mark.parametrize("name", ["IMG_0004.png", "IMG_0004.jpg.png", "IMG_0004_mask.png"])
def test_masks_are_found_by_the_pictures_names(capture, name):
    hidden = np.ones((HEIGHT, WIDTH, 3))
    hidden[:, : WIDTH // 2] = 0
    write_image(capture / "masks" / name, hidden)
    scan = read_scan(capture, OPTIONS)
    masks = [view.mask for view in scan.views if view is not None and view.mask]
    assert masks == [capture / "masks" / name]
    assert any("1 masks are used" in warning for warning in scan.warnings)


def test_masks_of_pictures_of_one_name_are_told_apart(capture):
    images = sorted((capture / "images").iterdir())
    for place, names in (("a", images[:5]), ("b", images[5:])):
        (capture / "images" / place).mkdir()
        for i, path in enumerate(names):
            path.rename(capture / "images" / place / f"{i}.jpg")
    (capture / "images/b/4.jpg").rename(capture / "images/b/9.jpg")
    shown = np.ones((HEIGHT, WIDTH, 3))
    # That of one picture, one that could be of two, and one that is of a single one.
    for name in ("a/1.png", "2.png", "9.png"):
        write_image(capture / "masks" / name, shown)
    scan = read_scan(capture, OPTIONS)
    found = {
        path.relative_to(capture / "images").as_posix(): mask.relative_to(capture).as_posix()
        for path, mask in zip(scan.frames.photographs, scan.frames.masks, strict=True)
        if mask
    }
    assert found == {"a/1.jpg": "masks/a/1.png", "b/9.jpg": "masks/9.png"}


def _no_mesh(capture):
    (capture / "surface.ply").unlink()


def _picture_less(capture):
    (capture / "images" / "IMG_0003.jpg").unlink()


def _other_array(capture):
    np.save(capture / "poses_bounds.npy", np.zeros((10, 12)))


def _pickle(capture):
    np.save(capture / "poses_bounds.npy", np.array([{}], object))


def _other_axes(capture):
    rows = np.load(capture / "poses_bounds.npy")
    rows[:, :15].reshape(-1, 3, 5)[:, :, 0] *= -1
    np.save(capture / "poses_bounds.npy", rows)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"no mesh\. .*COLMAP.*--mesh\. \[mesh.missing\]"),
        (_picture_less, r"10 poses for 9 pictures in images.*\[capture.frames\]"),
        (_other_array, r"shape \(10, 12\).*\[capture.format\]"),
        (_pickle, r"pickled data is refused.*\[arrays.damaged\]"),
        (_other_axes, r"mirrored.*\[capture.pose\]"),
    ],
)
def test_refusals(capture, damage, sentence):
    damage(capture)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(capture, OPTIONS)


def test_frames_are_told_of_where_there_is_no_mesh(capture):
    (capture / "surface.ply").unlink()
    found = inspect(capture, InspectOptions(assume_srgb=True))
    assert found.summary()["frames"]["count"] == len(truth().images)
    assert "[mesh.missing]" in str(found.refusals[0])


@pytest.mark.parametrize("name", ["images_8", "images_64x48"])
def test_smaller_pictures_where_the_others_were_not_passed_on(capture, room, name):
    """As LLFF's minify makes them; of several the largest are taken."""
    rows = np.load(capture / "poses_bounds.npy")
    rows[:, [4, 9, 14]] *= 4
    np.save(capture / "poses_bounds.npy", rows)
    (capture / "images").rename(capture / "images_4")
    for i, image in enumerate(room.images):
        write_image(capture / name / f"image{i:03d}.png", image[::2, ::2])
    scan = read_scan(capture, OPTIONS)
    assert_same(scan, room)
    assert {path.parent.name for path in scan.frames.image_paths} == {"images_4"}
