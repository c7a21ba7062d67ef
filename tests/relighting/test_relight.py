"""From the composed stage to a picture: what is published is what is rendered."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf

from tests.json_schemas import checked
from tests.relighting.conftest import BASE
from usdbrdf.asset.header import read_header
from usdbrdf.asset.layers.scan_layer import write_pending_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.errors import OwnershipConflict, UsdBrdfError
from usdbrdf.files.images import read_radiance
from usdbrdf.options import RelightOptions
from usdbrdf.relighting import description
from usdbrdf.relighting.relight import relight
from usdbrdf.relighting.render import VARIANTS, mitsuba_variant

# Half the fan of a square lamp, 3 m above: F = 4/(2 pi) * 2 * a/sqrt(1+a^2) atan(a/sqrt(1+a^2)).
_A = 1 / 3
_FORM = 4 / math.pi * _A / math.hypot(1, _A) * math.atan(_A / math.hypot(1, _A))
_FLOOR, _LAMP = np.array([0.2, 0.4, 0.8]), np.array([4.0, 2.0, 1.0])

_EDIT = """#usda 1.0
over "room"
{
    over "mtl"
    {
        over "floor"
        {
            over "s"
            {
                color3f inputs:diffuseColor = (0.4, 0.4, 0.4)
            }
        }
    }
}
"""
_HIDE = """#usda 1.0
over "room"
{
    over "geo"
    {
        over "lamp" %s
    }
}
"""


@pytest.fixture(autouse=True)
def _scalar(monkeypatch: pytest.MonkeyPatch) -> None:
    """The variant that starts at once and works everywhere."""
    _choose(monkeypatch, "scalar_rgb")


def _choose(monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    # By its module: usdbrdf.relight is the function.
    module = sys.modules[relight.__module__]
    monkeypatch.setattr(module, "mitsuba_variant", partial(mitsuba_variant, variant))


def _mean(room: Path, **options: object) -> np.ndarray:
    picture = room.parent / "picture.exr"
    relight(
        room,
        picture,
        RelightOptions(camera="/room/eye", width=8, samples=64, denoise="none", **options),  # type: ignore[arg-type]
    )
    return read_radiance(picture).reshape(-1, 3).mean(axis=0)


def test_the_captured_lamp_lights_the_floor(room: Path) -> None:
    # L = rho / pi * pi * L_lamp * form factor; the colours show that channels keep their order.
    assert _mean(room) == pytest.approx(_FLOOR * _LAMP * _FORM, rel=0.02)


def test_what_was_not_measured_yet_is_told(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _mean(room)
    assert "was not run" not in capsys.readouterr().err
    layer = Asset.made(room).layer("material")
    write_pending_layer(layer, "material", read_header(room / "layers/scan.usdc"))
    _mean(room)
    told = "room: the step fit was not run; the picture lacks what it measures."
    assert told in capsys.readouterr().err


def test_an_artists_override_is_rendered_and_the_asset_stays(room: Path) -> None:
    (room / "edits.usda").write_text(_EDIT)
    before = {p: p.read_bytes() for p in room.rglob("*") if p.is_file()}
    assert _mean(room) == pytest.approx(0.4 * _LAMP * _FORM, rel=0.02)
    assert {p: p.read_bytes() for p in room.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("variant", VARIANTS)
def test_where_nothing_reflects_what_glows_is_seen_and_no_light_is_looked_for(
    room: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    _choose(monkeypatch, variant)
    glows = "= (0, 0, 0)\ncolor3f inputs:emissiveColor = (0.5, 0.25, 0.125)"
    (room / "edits.usda").write_text(_EDIT.replace("= (0.4, 0.4, 0.4)", glows))
    asked: list[dict[str, object]] = []
    monkeypatch.setattr(description, "integrator", lambda bounces: asked.append({}))
    assert _mean(room) == pytest.approx([0.5, 0.25, 0.125], rel=1e-3)
    assert asked == []


def test_what_the_artist_hides_is_gone(room: Path) -> None:
    (room / "edits.usda").write_text(_HIDE % "(active = false)\n{\n}")
    assert _mean(room).max() == 0
    (room / "edits.usda").write_text(_HIDE % '{\ntoken visibility = "invisible"\n}')
    assert _mean(room).max() == 0


_DISK = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Y"
)
def DiskLight "disk" {
    float inputs:radius = 50
    float inputs:intensity = 1
    float inputs:exposure = 3
    color3f inputs:color = (1, 0.5, 0.25)
    double3 xformOp:translate = (0, 250, 0)
    float3 xformOp:rotateXYZ = (-90, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
}
"""


def test_lights_of_another_file_come_in_its_units_and_axes(room: Path, tmp_path: Path) -> None:
    lights = tmp_path / "lights.usda"
    lights.write_text(_DISK)
    # 2.5 m above, 0.5 m of radius: E = pi L r^2 / (r^2 + h^2), L = 2^3 colour.
    disk = np.array([8.0, 4.0, 2.0]) / (1 + 5.0**2)
    assert _mean(room, lights=lights) == pytest.approx(_FLOOR * disk, rel=0.02)
    # The disc hides the middle of the lamp above it.
    both = _mean(room, lights=lights, keep_emitters=True)
    assert (both > _FLOOR * (disk + 0.4 * _LAMP * _FORM)).all()
    assert (both < _FLOOR * (disk + 0.8 * _LAMP * _FORM)).all()


def test_a_glowing_mesh_of_another_file_takes_the_place_of_the_captured_one(
    room: Path, tmp_path: Path
) -> None:
    lights = tmp_path / "other.usda"
    lights.write_text(BASE.replace("(4, 2, 1)", "(1, 3, 5)"))
    other = np.array([1.0, 3.0, 5.0])
    assert _mean(room, lights=lights) == pytest.approx(_FLOOR * other * _FORM, rel=0.02)


def test_png_is_exposed_and_says_how_far(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "picture.png"
    arguments = ["relight", str(room), "-o", str(target), "--camera", "/room/eye"]
    assert main([*arguments, "--width", "8", "--samples", "62", "--json"]) == 0
    shown = read_radiance(target)
    printed = capsys.readouterr()
    assert checked(printed.out, "relight")["pictures"] == [str(target)]
    said = printed.err.split("exposure: ")[1].split(" stops (automatic)")[0]
    level = float((_FLOOR * _LAMP).mean()) * _FORM
    assert float(said) == pytest.approx(math.log2(0.8 / level), abs=0.1)
    assert shown.shape == (8, 8, 3)
    # Linear 0.8 of the mean; here red = green = blue but for noise.
    assert np.median(shown) == pytest.approx(1.055 * 0.8 ** (1 / 2.4) - 0.055, abs=0.02)


def test_a_picture_may_be_a_jpeg(room: Path, tmp_path: Path) -> None:
    target = tmp_path / "picture.jpg"
    options = ["--camera", "/room/eye", "--width", "8", "--samples", "62"]
    assert main(["relight", str(room), "-o", str(target), *options]) == 0
    # Linear 0.8 of the mean, as above.
    shown = np.median(read_radiance(target))
    assert shown == pytest.approx(1.055 * 0.8 ** (1 / 2.4) - 0.055, abs=0.03)


@pytest.mark.parametrize("variant", VARIANTS)
def test_both_variants_render_a_folder_of_views(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    if variant != VARIANTS[1] and mitsuba_variant().variant() != variant:
        pytest.skip("no usable LLVM library")
    _choose(monkeypatch, variant)
    views = _views(tmp_path, "a", "b")
    found = relight(room, tmp_path / "out", RelightOptions(views=views, samples=64, denoise="none"))
    pictures = [read_radiance(tmp_path / "out" / f"{name}.exr") for name in "ab"]
    assert [Path(name).name for name in found["pictures"]] == ["a.exr", "b.exr"]
    for picture in pictures:
        assert picture.mean(axis=(0, 1)) == pytest.approx(_FLOOR * _LAMP * _FORM, rel=0.02)
    assert (pictures[0] != pictures[1]).any()  # noise of its own in each view


def test_views_are_of_the_frame_that_is_asked_for(room: Path, tmp_path: Path) -> None:
    """An artist's edits may move: the lamp is gone at the second."""
    root = room / "room.usda"
    range_of_two = "startTimeCode = 1\nendTimeCode = 2\nupAxis"
    root.write_text(root.read_text().replace("upAxis", range_of_two))
    moving = 'token visibility.timeSamples = { 1: "inherited", 2: "invisible" }'
    edits = f'over "room" {{\n over "geo" {{\n over "lamp" {{\n {moving}\n }}\n }}\n }}'
    (room / "edits.usda").write_text(f"#usda 1.0\n{edits}\n")
    views, named = _views(tmp_path, "a"), ["--samples", "16", "--denoise", "none"]
    means = []
    for number in ("1", "2"):
        target = tmp_path / number
        command = ["relight", str(room), "-o", str(target), "--views", str(views), *named]
        assert main([*command, "--frame", number]) == 0
        means.append(read_radiance(target / "a.exr").mean())
    assert means[0] > 0.01
    assert means[1] == 0


def test_views_through_lenses_are_those_of_their_pinhole_frames(room: Path, tmp_path: Path) -> None:
    views = _views(tmp_path, "a")
    document = json.loads(views.read_text())
    size = {"w": 64, "h": 32, "camera_model": "EQUIRECTANGULAR"}
    views.write_text(json.dumps({"frames": document["frames"], **size}))
    found = relight(room, tmp_path / "out", RelightOptions(views=views, samples=64, denoise="none"))
    names = [Path(name).name for name in found["pictures"]]
    assert names == [f"a.{face}.exr" for face in ("front", "right", "left", "up", "down", "back")]
    # The document's camera looks down on the floor.
    front = read_radiance(tmp_path / "out" / "a.front.exr")
    height, width = (side // 2 for side in front.shape[:2])
    middle = front[height - 1 : height + 1, width - 1 : width + 1]
    assert middle.mean() == pytest.approx(_FLOOR * _LAMP * _FORM, rel=0.1)


def test_views_without_images_need_their_size_stated(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = _views(tmp_path, "../elsewhere/a")
    relight(room, tmp_path / "out", RelightOptions(views=views, samples=1, denoise="none"))
    assert (tmp_path / "out" / "a.exr").is_file()
    document = json.loads(views.read_text())
    document["frames"][0]["file_path"] = "a.exr"
    del document["w"]
    views.write_text(json.dumps(document))
    status, said = _refused([str(room), "-o", str(tmp_path / "b"), "--views", str(views)], capsys)
    assert (status, "does not exist" in said) == (3, True)


def _views(folder: Path, *names: str) -> Path:
    """A document of poses a metre above the floor; there are no images."""
    pose = np.eye(4)
    pose[2, 3] = 1.0
    frames = [{"file_path": f"{name}.exr", "transform_matrix": pose.tolist()} for name in names]
    lens = {"w": 8, "h": 8, "fl_x": 100.0, "fl_y": 100.0, "cx": 4.0, "cy": 4.0}
    document = folder / "views.json"
    document.write_text(json.dumps({**lens, "frames": frames}))
    return document


def _refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    status = main(["relight", *arguments, "-q"])
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert said.endswith("]")
    return status, said


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--insert", "no.obj"], 3, "no.obj: no such file"),
        (["--lights", "no.usda"], 3, "no.usda: no such file"),
        (["--lights", "no.txt"], 2, "UsdLux|latitude-longitude"),
        (["--camera", "/room/nobody"], 2, "/room/eye"),
        (["--bounces", "3"], 2, "at least 4"),
        (["--insert", "a.ply", "colour=1"], 2, "color="),
        (["--insert", "a.ply", "at=1,2"], 2, "expected 3 finite number"),
        (["--insert", "a.ply", "at=1,2,3", "drop=1,2"], 2, "exclude each other"),
        (["--frame", "12"], 2, "--frame 12"),
        (["--frame", "nan"], 2, "finite"),
        (["--seed", "-1"], 2, "whole number"),
        (["--exposure", "nan"], 2, "finite"),
        (["--insert", "a.ply", "scale=inf"], 2, "finite"),
        (["--insert", "a.ply", "at=1,nan,0"], 2, "finite"),
        (["--insert", "a.ply", "at=1e308,0,0"], 2, "at most 10,000,000,000"),
        (["--insert", "a.ply", "drop=0,-1e30"], 2, "at least -10,000,000,000"),
        (["--insert", "a.ply", "scale=1e30"], 2, "at most 1,000,000,000"),
        (["--exposure", "2"], 2, "--exposure: is of .png"),
        (["--format", "png"], 2, "--format png: is of the pictures of --views"),
        (["--views", "v.json", "--camera", "/room/eye"], 2, "--views, --camera: they exclude"),
    ],
)
def test_refusals_are_one_sentence(
    room: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    status: int,
    words: str,
) -> None:
    target = tmp_path / "picture.exr"
    found, said = _refused([str(room), "-o", str(target), *options], capsys)
    assert found == status
    assert any(word in said for word in words.split("|")), said
    assert not target.exists()


@pytest.mark.parametrize(
    "option", [["--exposure", "2"], ["--format", "png"], ["--denoise", "none"]]
)
def test_a_scene_takes_no_options_of_pictures(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    target = tmp_path / "scene.xml"
    start = [str(room), "-o", str(target), "--camera", "/room/eye", "--width", "8"]
    status, said = _refused([*start, *option], capsys)
    assert status == 2
    assert f"{option[0]}: is of pictures" in said
    assert not target.exists()


def test_a_scene_has_the_cameras_of_the_views_or_one_of_the_stage(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--views", str(_views(tmp_path, "a")), "--camera", "/room/eye"]
    status, said = _refused([str(room), "-o", str(tmp_path / "scene.xml"), *asked], capsys)
    assert status == 2
    assert "--views, --camera: they exclude each other" in said
    assert not (tmp_path / "scene.xml").exists()


def test_two_views_of_one_name_are_refused(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # As images have it, and as the faces of a lens do.
    views = _views(tmp_path, "a", "a.front")
    document = json.loads(views.read_text())
    round_about = {"w": 64, "h": 32, "camera_model": "EQUIRECTANGULAR"}
    for changed in ({"file_path": "b/a.front.png"}, round_about):
        document["frames"][0] |= changed
        views.write_text(json.dumps(document))
        for output in ("scene.xml", "pictures"):
            place = tmp_path / output
            command = [str(room), "-o", str(place), "--views", str(views), "--samples", "1"]
            status, said = _refused(command, capsys)
            assert (status, "two views have images of one name" in said) == (3, True)
            assert not place.exists()
        document["frames"][0]["file_path"] = "a.png"


def test_a_matrix_excludes_what_it_holds_itself(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    matrix = tmp_path / "m.txt"
    np.savetxt(matrix, np.eye(4))
    start = [str(room), "-o", str(tmp_path / "a.exr"), "--insert", "a.ply", f"matrix={matrix}"]
    for more in ("scale=2", "rotate=30"):
        status, said = _refused([*start, more], capsys)
        assert status == 2
        assert "no effect beside matrix=" in said


def test_what_stands_in_the_place_of_the_output_is_refused_before_rendering(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[relight.__module__], "render_view", None)
    folder, file = tmp_path / "d.exr", tmp_path / "file"
    folder.mkdir()
    file.write_text("mine")
    camera = ["--camera", "/room/eye"]
    status, said = _refused([str(room), "-o", str(folder), *camera], capsys)
    assert (status, "a folder of this name" in said) == (6, True)
    status, said = _refused([str(room), "-o", str(file / "a.exr"), *camera], capsys)
    assert (status, "not a folder" in said) == (6, True)
    views = _views(tmp_path, "a")
    status, said = _refused([str(room), "-o", str(file), "--views", str(views)], capsys)
    assert (status, "not a folder" in said) == (6, True)
    (tmp_path / "out" / "a.exr").mkdir(parents=True)
    status, said = _refused([str(room), "-o", str(tmp_path / "out"), "--views", str(views)], capsys)
    assert (status, "a folder of this name" in said) == (6, True)
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    "options", [{"camera": "/room/nobody"}, {"views": Path("bad.json")}], ids=["camera", "views"]
)
def test_what_cannot_be_read_is_refused_before_all_meshes_and_maps_are(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    monkeypatch.setattr(sys.modules[relight.__module__], "render_scene_from_stage", pytest.fail)
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text("{")
    with pytest.raises(UsdBrdfError, match=r"nobody|bad\.json"):
        relight(room, tmp_path / "out.exr", RelightOptions(**options))


@pytest.mark.parametrize("exposure", [None, 1.0])
def test_displayed_views_have_one_exposure_and_leave_nothing_beside(
    room: Path, tmp_path: Path, exposure: float | None
) -> None:
    options = RelightOptions(
        views=_views(tmp_path, "a", "b"), samples=16, denoise="none", format="png"
    )
    found = relight(room, tmp_path / "out", replace(options, exposure=exposure))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]
    expected = math.log2(0.8 / (float((_FLOOR * _LAMP).mean()) * _FORM))
    assert found["exposure"] == pytest.approx(expected if exposure is None else 1.0, abs=0.3)


def test_output_inside_the_asset_and_unknown_formats_are_refused(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _refused([str(room), "-o", str(room / "a.exr")], capsys)[0] == 2
    assert _refused([str(room), "-o", str(tmp_path / "a.gif")], capsys)[0] == 2


def test_a_missing_renderer_names_the_extra(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(UsdBrdfError, match=r"usdbrdf\[render\]") as refused:
        relight(room, tmp_path / "a.exr", RelightOptions(camera="/room/eye"))
    assert refused.value.exit_code == 4


def test_the_renderer_is_imported_only_when_something_is_rendered() -> None:
    code = "import sys, usdbrdf.cli; sys.exit(any(m in sys.modules for m in ('mitsuba', 'drjit')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.fault("R10")
@pytest.mark.parametrize("many", [False, True])
def test_a_picture_never_takes_the_place_of_a_photograph(
    room: Path, tmp_path: Path, many: bool
) -> None:
    """Nor that of what lights the scene, also by another way to its folder."""
    photograph, sky = tmp_path / "scan" / "0000.exr", tmp_path / "scan" / "sky.exr"
    photograph.parent.mkdir()
    (tmp_path / "way").symlink_to("scan")
    for file in (photograph, sky):
        file.write_text("the only one")
    where = Sdf.Layer.CreateNew(str(room / "layers" / "photographs.usdc"))
    where.ImportFromString(
        '#usda 1.0\nover "room" {\n over "eye" {\n'
        "  asset image.timeSamples = { 1: @../../scan/0000.exr@ }\n }\n}\n"
    )
    where.Save()
    options = RelightOptions(lights=sky, camera="/room/eye")
    outputs = [tmp_path / "way" / file.name for file in (photograph, sky)]
    if many:
        options = replace(options, views=_views(tmp_path, "0000"), camera=None)
        outputs = [tmp_path / "way"]
    for output, which in zip(
        outputs, ("one of the capture's photographs", "the file of --lights"), strict=False
    ):
        with pytest.raises(OwnershipConflict, match=rf"this is {which}.*\[relight.output\]"):
            relight(room, output, options)
    assert {file.read_text() for file in (photograph, sky)} == {"the only one"}
