"""Captures of one scene in several lightings become one scan, or are refused in a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import edited, make_capture, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.lightings import (
    in_own_folder,
    names_of_lightings,
    options_of_lightings,
    refuse_other_scenes,
    scan_of_lightings,
)
from usdbrdf.cli import main
from usdbrdf.command_parser import parsed
from usdbrdf.commands import COMMANDS
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.model.capture import Scan
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions()
CREASE = OPTIONS.crease_angle_deg


@pytest.fixture
def pair(tmp_path):
    """The captures: by day, and by night, in which the lamp is dark and fewer frames were taken."""
    dark = {"lamp": (0.1, 0.1, 0.1), "ceiling": (4.0, 4.0, 4.0)}
    return (
        make_capture(tmp_path / "by day", frames=12),
        make_capture(tmp_path / "by night", frames=9, radiance=dark, exposure_times=(0.04,)),
    )


def _scans(*folders: Path) -> dict[str, Scan]:
    names = names_of_lightings(folders)
    return {name: read_scan(path, OPTIONS) for name, path in zip(names, folders, strict=True)}


def test_lightings_have_the_names_of_their_folders(tmp_path):
    folders = [tmp_path / name for name in ("by day", "2", "by night")]
    for folder in folders:
        folder.mkdir()
    main = folders[2] / "transforms.json"
    assert names_of_lightings([folders[0], folders[1], main]) == ("by_day", "_2", "by_night")
    assert names_of_lightings(folders[:1]) == ()
    (tmp_path / "other" / "BY DAY").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"would be called BY_DAY.*\[lighting.name\]"):
        names_of_lightings([tmp_path / "other" / "BY DAY", folders[0]])


def test_each_lighting_may_be_told_its_colour_space():
    def said(text: str | None, *names: str) -> dict[str, str | None]:
        found = options_of_lightings(IngestOptions(encoding=text), names)
        return {name: one.encoding for name, one in found.items()}

    assert said("day=ACEScg,night=lin_rec709_scene", "day", "night") == {
        "day": "ACEScg", "night": "lin_rec709_scene",
    }  # fmt: skip
    assert said("lin_rec709_scene,night=ACEScg", "day", "night") == {
        "day": "lin_rec709_scene", "night": "ACEScg",
    }  # fmt: skip
    assert said("day=ACEScg", "day", "night") == {"day": "ACEScg", "night": None}
    assert said(None, "day", "night") == {"day": None, "night": None}
    assert said("ACEScg") == {"": "ACEScg"}
    for text, names, problem in (
        ("dusk=ACEScg", ("day", "night"), "no lighting is called 'dusk'.*day, night"),
        ("day=ACEScg", (), "no lighting is called 'day'.*of one alone"),
        ("day=a,day=b", ("day", "night"), "one lighting twice"),
        ("a,b", ("day", "night"), "one lighting twice"),
        ("day=", ("day", "night"), "names no colour space"),
    ):
        with pytest.raises(UsageError, match=rf"--input-space .*{problem}.*\[usage.option\]"):
            said(text, *names)


def test_the_command_line_takes_a_colour_space_for_each_lighting():
    words = ["a", "b", "-o", "out", "--input-space", "a=ACEScg", "--input-space", "b=x"]
    command = parsed(["convert", *words], COMMANDS)
    assert command.options.ingest.encoding == "a=ACEScg,b=x"


def test_frames_follow_each_other_and_know_their_lighting(pair):
    scans = _scans(*(made.folder for made in pair))
    scan = scan_of_lightings(scans, CREASE)
    day, night = scans.values()
    assert len(scan.frames) == 21
    assert scan.frames.of_lighting("by_day") == range(12)
    assert scan.frames.of_lighting("by_night") == range(12, 21)
    for lighting, own in scans.items():
        again = scan.frames.at(scan.frames.of_lighting(lighting))
        assert again.image_paths == own.frames.image_paths
        np.testing.assert_array_equal(again.world_from_camera, own.frames.world_from_camera)
        np.testing.assert_array_equal(again.exposure_time, own.frames.exposure_time)
        assert set(again.lightings) == {lighting}
    np.testing.assert_array_equal(scan.mesh.triangles, day.mesh.triangles)
    np.testing.assert_array_equal(scan.mesh.corner_normals, night.mesh.corner_normals)


def test_of_one_nothing_changes(pair):
    scan = read_scan(pair[0].folder, OPTIONS)
    assert scan_of_lightings({"": scan}, CREASE) is scan
    assert in_own_folder(scan, "") is scan
    assert scan.frames.of_lighting("") == range(12)


def test_gains_masks_and_lenses_of_some_are_none_of_the_others(pair):
    scans = _scans(*(made.folder for made in pair))
    night = scans["by_night"].frames
    mask = tuple(Path("/mask.png") if i == 2 else None for i in range(9))
    scans["by_night"] = replace(
        scans["by_night"], frames=replace(night, gain=np.full(9, 2.0), masks=mask)
    )
    frames = scan_of_lightings(scans, CREASE).frames
    np.testing.assert_array_equal(frames.gain, [1.0] * 12 + [2.0] * 9)
    assert frames.masks == (None,) * 12 + mask
    assert frames.photographs == ()


@pytest.mark.parametrize("through_a_lens", ["by_day", "by_night"])
def test_each_lighting_keeps_what_is_said_of_its_images(pair, through_a_lens):
    scans = _scans(*(made.folder for made in pair))
    frames = scans[through_a_lens].frames
    taken = tuple(path.with_suffix(".jpg") for path in frames.image_paths)
    said = {"encoding": "lin_ap1_scene", "photograph_encoding": "acescct_ap1"}
    frames = replace(frames, photographs=taken, radiometric=False, **said)
    scans[through_a_lens] = replace(scans[through_a_lens], frames=frames)
    refuse_other_scenes(scans)
    joined = scan_of_lightings(scans, CREASE).frames
    assert sum(path is not None for path in joined.photographs) == len(taken)
    assert not joined.radiometric
    for name, scan in scans.items():
        of_one = joined.of_lighting(name)
        assert {joined.encoding_of(i) for i in of_one} == {scan.frames.encoding}
        own = joined.at(of_one)
        assert own.recorded == ()
        for field in ("encoding", "photograph_encoding", "radiometric"):
            assert getattr(own, field) == getattr(scan.frames, field)


def test_frames_of_lightings_that_are_recorded_alike_say_nothing_of_each(pair):
    assert scan_of_lightings(_scans(*(made.folder for made in pair)), CREASE).frames.recorded == ()


def test_the_lens_is_what_those_tell_that_tell_of_it(pair):
    scans = _scans(*(made.folder for made in pair))
    assert scan_of_lightings(scans, CREASE).frames.vignetting == (0, 0)
    night = scans["by_night"]
    frames = replace(night.frames, vignetting=(-0.3, -0.1))
    scans["by_night"] = replace(night, frames=frames)
    assert scan_of_lightings(scans, CREASE).frames.vignetting == pytest.approx((-0.3, -0.1))


def test_refusals_quote_any_path(pair):
    folder = pair[1].folder.rename(pair[1].folder.parent / "by {night}")
    with edited(folder / "objects.json") as document:
        document["objects"][0]["name"] = "other"
    with pytest.raises(InputRefused, match=r"night\}.*: its objects are others"):
        refuse_other_scenes(_scans(pair[0].folder, folder))


def test_all_cameras_tell_which_side_of_a_face_is_the_surface(tmp_path):
    """A sheet wound away from the cameras of the night, who alone see it."""
    made = [make_capture(tmp_path / name, frames=12) for name in ("day", "night")]
    # The box's faces the wrong way round.
    box = made[0].face_object == made[0].names.index("box")
    triangles = made[0].triangles.copy()
    triangles[box] = triangles[box][:, [0, 2, 1]]
    for capture in made:
        write_ply(capture.folder / "mesh.ply", capture.points, triangles, capture.face_object)
    scans = _scans(*(capture.folder for capture in made))
    assert scans["night"].turned_faces[box].all()
    day = scans["day"]
    # As if no frame of the day had shown the box.
    as_filed = replace(day.mesh, triangles=triangles)
    unseen = replace(day, mesh=as_filed, turned_faces=np.zeros(len(triangles), bool))
    refuse_other_scenes({**scans, "day": unseen})
    scan = scan_of_lightings({**scans, "day": unseen}, CREASE)
    np.testing.assert_array_equal(scan.turned_faces, scans["night"].turned_faces)
    np.testing.assert_array_equal(scan.mesh.triangles, scans["night"].mesh.triangles)
    np.testing.assert_allclose(scan.mesh.corner_normals, day.mesh.corner_normals, atol=1e-6)


def test_another_mesh_is_refused(pair):
    day, night = pair
    moved = night.points + np.float32(0.01)
    write_ply(night.folder / "mesh.ply", moved, night.triangles, night.face_object)
    with pytest.raises(InputRefused, match=r"by night.*by day.*--mesh. \[lighting.mesh\]"):
        refuse_other_scenes(_scans(day.folder, night.folder))


def test_fewer_triangles_are_refused(pair):
    day, night = pair
    some = slice(0, -2)
    write_ply(
        night.folder / "mesh.ply", night.points, night.triangles[some], night.face_object[some]
    )
    with pytest.raises(InputRefused, match=r"triangles are others.*\[lighting.mesh\]"):
        refuse_other_scenes(_scans(day.folder, night.folder))


def test_other_objects_are_refused(pair):
    day, night = pair
    with edited(night.folder / "objects.json") as document:
        document["objects"][0]["name"] = "carpet"
    with pytest.raises(InputRefused, match=r"objects are others.*\[lighting.objects\]"):
        refuse_other_scenes(_scans(day.folder, night.folder))


def test_other_units_are_refused(pair):
    scans = _scans(*(made.folder for made in pair))
    scans["by_night"] = replace(scans["by_night"], meters_per_unit=0.01)
    with pytest.raises(InputRefused, match=r"\[lighting.units\]"):
        refuse_other_scenes(scans)


def test_the_share_of_rays_that_hit_is_no_sum(pair):
    scans = _scans(*(made.folder for made in pair))
    shares = [scan.counts["rays_hit_percent"] for scan in scans.values()]
    assert scan_of_lightings(scans, CREASE).counts["rays_hit_percent"] == min(shares)


def test_what_is_true_of_all_lightings_is_told_once(tmp_path, capsys):
    """Of documents of one name."""
    for name in ("day", "night"):
        made = make_capture(tmp_path / name, frames=10)
        with edited(made.manifest) as document:
            for frame in document["frames"]:
                del frame["saturation_radiance"]
    folders = [str(tmp_path / name) for name in ("day", "night")]
    assert main(["ingest", *folders, "-o", str(tmp_path / "out"), "--json"]) == 0
    told, err = capsys.readouterr()
    warnings = json.loads(told)["steps"]["ingest"]["warnings"]
    (said,) = [s for s in warnings if "10 of 10 frames state no saturation" in s]
    assert err.count(said) == 1
