"""A scan that is written as a capture is the same scan when it is read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.lens_scenes import capture_through
from tests.scenes import edited, make_capture, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.develop import developed_in
from usdbrdf.capture.native import write_capture
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.images import read_exr, write_preview_png
from usdbrdf.model.capture import Scan
from usdbrdf.options import IngestOptions


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "room", exposure_times=(0.02, 0.08), unit=3.0)


def _assert_same(one: Scan, other: Scan) -> None:
    """To the bit, all but where it lies."""
    for part in ("mesh", "frames"):
        for name, value in vars(getattr(one, part)).items():
            again = getattr(getattr(other, part), name)
            if isinstance(value, np.ndarray):
                assert value.dtype == again.dtype, name
                assert value.tobytes() == again.tobytes(), name
            elif name == "image_paths":
                files = [(path.name, path.read_bytes()) for path in value]
                assert files == [(path.name, path.read_bytes()) for path in again]
            else:
                assert value == again, name
    assert one.turned_faces.tobytes() == other.turned_faces.tobytes()
    assert one.objects == other.objects
    assert (one.meters_per_unit, one.up_axis) == (other.meters_per_unit, other.up_axis)


def test_a_capture_comes_back_to_the_bit(capture, tmp_path):
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            # Digits as other programs print them, which have to be made rigid.
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 6).tolist()
            frame.update(fl_x=19.2 + i / 7, cx=16.1)
        del document["frames"][3]["saturation_radiance"]
    options = IngestOptions(meters_per_unit=0.3, up_axis="Y", encoding="lin_ap1_scene")
    scan = read_scan(capture.folder, options)
    write_capture(scan, scan.frames.image_paths, tmp_path / "new" / "copy")
    again = read_scan(tmp_path / "new" / "copy", IngestOptions())
    _assert_same(scan, again)
    assert again.name == "copy"
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["copy"]


def test_turned_faces_and_second_skins_come_back_as_they_were_wound(tmp_path):
    """A leaf in the middle of the room that frames see from both sides, and a floor wound down."""
    capture = make_capture(tmp_path / "room")
    points = np.concatenate([
        capture.points,
        np.array([[1.2, 1.5, 0.9], [2.8, 1.5, 0.9], [2.8, 1.5, 1.7], [1.2, 1.5, 1.7]], np.float32),
    ])  # fmt: skip
    n = len(capture.points)
    triangles = np.concatenate([capture.triangles, [[n, n + 1, n + 2], [n, n + 2, n + 3]]])
    labels = np.concatenate([capture.face_object, [2, 2]])
    floor = labels == 0
    triangles[floor] = triangles[floor][:, [0, 2, 1]]
    write_ply(capture.folder / "mesh.ply", points, triangles.astype(np.int32), labels)
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.turned_faces.sum() >= floor.sum() > 0
    assert scan.counts["faces_of_two_sides"] > 0
    write_capture(scan, scan.frames.image_paths, tmp_path / "copy")
    again = read_scan(tmp_path / "copy", IngestOptions())
    _assert_same(scan, again)
    assert again.counts == scan.counts


def test_photographs_stay_photographs(capture, tmp_path):
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            image = np.clip(read_exr(capture.image(i)) * 80, 0, 255).astype(np.uint8)
            image[0, 0] = i
            frame["file_path"] = f"frames/{i:04d}.png"
            write_preview_png(capture.folder / frame["file_path"], image)
    scan = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    write_capture(scan, scan.frames.image_paths, tmp_path / "copy")
    with pytest.raises(InputRefused, match=r"--assume-srgb"):
        read_scan(tmp_path / "copy", IngestOptions())
    _assert_same(scan, read_scan(tmp_path / "copy", IngestOptions(assume_srgb=True)))


def test_frames_that_photographs_became_do_not_pass_for_radiance(tmp_path):
    """Neither do their clipped pixels, which no EXR file tells; and what the photographs do not
    show is no damage."""
    capture = capture_through(tmp_path / "room", "OPENCV")
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            image = np.clip(read_exr(capture.image(i)) * 80, 0, 255).astype(np.uint8)
            frame["file_path"] = f"frames/{i:04d}.png"
            frame["exposure_time"] = (0.02, 0.08)[i % 2]
            write_preview_png(capture.folder / frame["file_path"], image)
    asked = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    (tmp_path / "made").mkdir()
    frames = developed_in(asked.frames, asked.views, tmp_path / "made")
    write_capture(replace(asked, frames=frames), frames.image_paths, tmp_path / "copy")
    again = read_scan(tmp_path / "copy", IngestOptions())
    assert not again.frames.radiometric
    assert any("not radiometric" in w and w.endswith("[capture.ldr]") for w in again.warnings)
    for name in ("saturation_radiance", "noise_floor_radiance", "exposure_time", "intrinsics"):
        np.testing.assert_array_equal(getattr(again.frames, name), getattr(asked.frames, name))
    np.testing.assert_allclose(
        again.frames.world_from_camera, asked.frames.world_from_camera, atol=1e-9
    )


def test_images_of_one_name_from_several_folders(capture, tmp_path):
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            place = capture.folder / f"pass{i}" / "view.exr"
            place.parent.mkdir()
            capture.image(i).rename(place)
            frame["file_path"] = f"pass{i}/view.exr"
    scan = read_scan(capture.folder, IngestOptions())
    write_capture(scan, scan.frames.image_paths, tmp_path / "copy")
    again = read_scan(tmp_path / "copy", IngestOptions())
    assert again.frames.image_paths[11].name == "00011_view.exr"
    _assert_same(replace(scan, frames=replace(scan.frames, image_paths=())),
                 replace(again, frames=replace(again.frames, image_paths=())))  # fmt: skip


def test_nothing_is_written_over_and_nothing_is_left_half(capture, tmp_path, monkeypatch, capsys):
    copy, out = tmp_path / "copy", tmp_path / "out"
    arguments = ["ingest", str(capture.folder), "-o", str(out), "-q", "--write-capture"]
    assert main([*arguments, str(copy)]) == 0
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    assert len(before) == 15
    assert main([*arguments, str(copy)]) == 6
    assert "[ownership.taken]" in capsys.readouterr().err
    assert main([*arguments, str(capture.folder / "mine")]) == 6
    assert "[ownership.inside]" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before
    # Nothing changed, so that ingest itself has nothing to do.
    assert main([*arguments, str(tmp_path / "second")]) == 0
    assert (tmp_path / "second" / "mesh.ply").read_bytes() == before[copy / "mesh.ply"]

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("usdbrdf.capture.native.shutil.copyfile", full)
    again = read_scan(copy, IngestOptions())
    with pytest.raises(EnvironmentFailure, match="No space left"):
        write_capture(again, again.frames.image_paths, tmp_path / "third")
    assert {p.name for p in tmp_path.iterdir()} == {"room", "copy", "out", "second"}


@pytest.mark.parametrize(
    ("key", "word"), [("encoding", "acesfilm"), ("up_axis", "x"), ("encoding", 3)]
)
def test_words_of_the_document_that_mean_nothing(capture, key, word):
    with edited(capture.manifest) as document:
        document[key] = word
    with pytest.raises(InputRefused, match=rf"{key} is '{word}', none of .*\[capture.format\]"):
        read_scan(capture.folder, IngestOptions())


def test_an_encoding_that_the_images_do_not_have(capture):
    with edited(capture.manifest) as document:
        document["encoding"] = "srgb_rec709_scene"
    with pytest.raises(InputRefused, match=r"but the images are scene-linear.*\[capture.format\]"):
        read_scan(capture.folder, IngestOptions())


def test_the_document_of_the_copy_is_relative(capture, tmp_path):
    scan = read_scan(capture.folder, IngestOptions())
    write_capture(scan, scan.frames.image_paths, tmp_path / "copy")
    Path(tmp_path / "copy").rename(tmp_path / "moved")
    assert str(tmp_path) not in (tmp_path / "moved" / "transforms.json").read_text()
    assert len(read_scan(tmp_path / "moved", IngestOptions()).frames) == 12
