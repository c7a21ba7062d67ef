"""What inspect tells of a capture: what was written into it, what it lacks, and ingest's own
refusals."""

from __future__ import annotations

import numpy as np
import pytest

from tests.json_schemas import checked
from tests.scenes import MadeCapture, edited, make_capture, rescale_images
from usdbrdf.asset.layout import Asset
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.inspection import inspect
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.images import read_exr, write_exr, write_preview_png
from usdbrdf.options import IngestOptions, InspectOptions


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "room", exposure_times=(0.02, 0.08), saturation_radiance=7.5)


def _as_photographs(capture: MadeCapture) -> None:
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            image = np.clip(read_exr(capture.image(i)) * 255, 0, 255).astype(np.uint8)
            frame["file_path"] = f"frames/{i:04d}.png"
            write_preview_png(capture.folder / frame["file_path"], image)


def test_frames_of_photographs_through_a_lens_count_as_what_these_are(capture):
    _as_photographs(capture)
    with edited(capture.manifest) as document:
        document |= {"camera_model": "OPENCV", "k1": -0.05}
    told = inspect(capture.folder, InspectOptions(assume_srgb=True)).summary()
    assert told["frames"]["files"] == {".png": 12}


def test_it_tells_what_was_written(capture):
    before = sorted(capture.folder.rglob("*"))
    found = inspect(capture.folder, InspectOptions())
    assert sorted(capture.folder.rglob("*")) == before
    told = found.summary()
    assert (told["adapter"], told["refused"], told["missing"]) == ("transforms", [], [])
    assert told["frames"] == {
        "count": 12,
        "files": {".exr": 12},
        "cameras": 1,
        "resolutions": [{"width": 32, "height": 24, "frames": 12}],
        "exposure_times": [0.02, 0.08],
        "frames_without_saturation": 0,
        "encoding": "lin_rec709_scene",
        "radiometric": True,
    }
    assert told["mesh"]["vertices"] == len(capture.points)
    assert told["mesh"]["faces"] == len(capture.triangles)
    np.testing.assert_allclose(told["mesh"]["size"], [4, 3, 2.5])
    assert [label["label"] for label in told["objects"]] == list(capture.names)
    # Half of the frames saturate at a quarter of 7.5, and no surface but the lamp is brighter.
    looked = np.unique(np.linspace(0, 11, 8).round()).astype(int)
    shown = np.array([read_exr(capture.image(i)) for i in looked])
    lamp = shown.max(axis=3) > 1.8
    assert told["radiance"]["clipped"] == pytest.approx(lamp.mean())
    assert told["radiance"]["most_clipped"] == pytest.approx(lamp.mean(axis=(1, 2)).max())
    levels = shown[~lamp].mean(axis=1)
    assert told["radiance"]["darkest"] == pytest.approx(levels.min())
    assert told["radiance"]["brightest"] == pytest.approx(levels.max())


def test_the_table_is_for_people_and_the_document_for_programs(capture, capsys):
    assert main(["inspect", str(capture.folder)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "transforms" in out
    assert "5: floor, ceiling, walls, lamp, box" in out
    assert "(2.0 stops)" in out
    assert "4 x 3 x 2.5 units, a unit is 1 m, Z up" in out
    assert main(["inspect", str(capture.folder), "--json"]) == 0
    assert checked(capsys.readouterr().out, "inspect")["frames"]["count"] == 12


def test_a_refusal_comes_with_what_was_read_by_then(capture, capsys):
    (capture.folder / "mesh.ply").unlink()
    with pytest.raises(InputRefused) as refused:
        read_scan(capture.folder, IngestOptions())
    assert main(["inspect", str(capture.folder), "--json"]) == 3
    out, err = capsys.readouterr()
    assert err == f"usdbrdf: {refused.value}\n"
    told = checked(out, "inspect")
    assert told["refused"] == [{"sentence": str(refused.value), "exit_code": 3}]
    assert (told["frames"]["count"], told["mesh"], told["missing"]) == (12, None, ["mesh"])
    assert told["radiance"]["brightest"] > 0.4


@pytest.mark.parametrize("mesh", [True, False])
def test_cameras_are_told_at_the_size_of_the_pictures(capture, mesh):
    rescale_images(capture, 0.5)
    if not mesh:
        (capture.folder / "mesh.ply").unlink()
    (row,) = (r for r in inspect(capture.folder, InspectOptions()).lines() if r.startswith("camer"))
    assert "16 x 12 pixels" in row


def test_photographs_are_read_on_as_if_they_were_granted(capture):
    _as_photographs(capture)
    (capture.folder / "mesh.ply").unlink()
    found = inspect(capture.folder, InspectOptions())
    assert ["[capture.ldr]" in str(e) for e in found.refusals] == [True, False]
    assert "[mesh.missing]" in str(found.refusals[1])
    assert found.granted == ("--assume-srgb",)
    assert found.summary()["frames"]["files"] == {".png": 12}
    found = inspect(capture.folder, InspectOptions(assume_srgb=True))
    assert len(found.refusals) == 1


def test_exposures_that_nobody_states_are_not_called_a_second(capture):
    def exposures():
        found = inspect(capture.folder, InspectOptions(assume_srgb=True))
        (row,) = (line for line in found.lines() if line.startswith("exposures"))
        return row.split(maxsplit=1)[1]

    assert exposures() == "2: 0.02 to 0.08 s (2.0 stops)"
    _as_photographs(capture)
    assert exposures() == "2, 2.0 stops apart"
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            del frame["exposure_time"]
    assert exposures() == "not stated"


def test_few_frames_are_looked_at_unless_one_of_them_is_bad(tmp_path):
    capture = make_capture(tmp_path / "room", frames=30)
    write_exr(capture.image(1), np.zeros((24, 32, 3), np.float32))
    found = inspect(capture.folder, InspectOptions(checked=4))
    assert (found.looked_at, len(found.frames)) == (4, 30)
    write_exr(capture.image(29), np.zeros((24, 32, 3), np.float32))
    found = inspect(capture.folder, InspectOptions(checked=4))
    assert (found.looked_at, len(found.frames)) == (30, 28)
    assert any("2 of 30 frames dropped" in warning for warning in found.warnings)


@pytest.mark.parametrize("what", ["nothing there", "empty folder", "no document", "a picture"])
def test_what_is_no_capture_is_refused_as_by_ingest(what, tmp_path, capsys):
    place = tmp_path / "scan"
    if what != "nothing there":
        place.mkdir()
    if what == "no document":
        place = place / "transforms.json"
        place.write_text('{"frames": 3}')
    if what == "a picture":
        place = place / "a.exr"
        write_exr(place, np.zeros((2, 2, 3), np.float32))
    status = main(["ingest", str(place), "-o", str(tmp_path / "out")])
    sentence = capsys.readouterr().err
    assert (main(["inspect", str(place)]), status) == (3, 3)
    assert capsys.readouterr().err == sentence


def test_wrong_options_stay_wrong(capture):
    with pytest.raises(UsageError, match="--encoding"):
        inspect(capture.folder, InspectOptions(encoding="acesfilm"))
    with pytest.raises(UsageError, match="not installed"):
        inspect(capture.folder, InspectOptions(), "colmap9")


@pytest.mark.parametrize(
    "part", [".", "room.usda", "layers", "layers/scan.usdc", "objects", "objects/wall", "textures"]
)
def test_an_asset_is_called_one(part, built, capsys):
    """Its root layer is a stage with cameras, and so is each of its objects' files."""
    place = built.asset.folder / part
    assert main(["inspect", str(place)]) == 3
    told = capsys.readouterr().err
    assert "an asset that usdbrdf wrote, and no capture" in told
    assert told.endswith("[capture.asset]\n")
    assert main(["convert", str(place), "-o", str(built.asset.folder.parent / "again")]) == 3
    assert capsys.readouterr().err == told
    assert not (built.asset.folder.parent / "again").exists()


def test_a_capture_beside_an_asset_or_in_its_folder_is_one(built):
    folder = make_capture(built.asset.folder / "capture").folder
    assert not inspect(folder, InspectOptions()).refusals
    assert Asset.around(folder) is None
    assert Asset.around(built.asset.folder.parent) is None
