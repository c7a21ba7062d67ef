"""One asset of a scene in two lightings: what is in it for each, what they share, what later runs
do, and what is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdShade

import usdbrdf
from tests.delivery.packing import packed
from tests.json_schemas import checked
from tests.scenes import edited, make_capture, poses_down_and_up
from usdbrdf.asset.adopt import adopt
from usdbrdf.asset.advice import read_advice
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_edited, open_measured
from usdbrdf.asset.readers.scene import aov_path, read_fit, read_shading
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.files.colour import from_working_space, to_display_srgb8
from usdbrdf.files.images import read_exr, write_exr, write_preview_png
from usdbrdf.job.progress import set_quiet
from usdbrdf.page import report
from usdbrdf.page.report import page_data

COARSE = ["-q", "--texel-size", "0.3", "--standard-error", "0.1", "--rays", "64"]
COARSE += ["--environment", "none", "--denoise", "none"]
# By day the lamp shines; by night it is dark and the box does.
DAY = {"ceiling": (0.125, 0.125, 0.125)}
NIGHT = {"lamp": (0.25, 0.2, 0.15), "box": (6.0, 6.0, 6.0), "ceiling": (0.1, 0.1, 0.1)}
LIGHTINGS = ("day", "night")


@pytest.fixture(autouse=True)
def _quiet():
    set_quiet(True)
    yield
    set_quiet(False)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("lightings")


@pytest.fixture(scope="module")
def captures(base) -> list[Path]:
    made = {
        name: make_capture(
            base / name, subdivisions=2, poses=poses_down_and_up(6, 6), radiance=radiance
        )
        for name, radiance in zip(LIGHTINGS, (DAY, NIGHT), strict=True)
    }
    return [capture.folder for capture in made.values()]


def _convert(captures: list[Path], folder: Path, *more: str) -> int:
    return main(["convert", *map(str, captures), "-o", str(folder), *COARSE, *more])


@pytest.fixture(scope="module")
def asset(base, captures) -> Asset:
    set_quiet(True)
    assert _convert(captures, base / "made" / "room") == 0
    return Asset.made(base / "made" / "room")


def _colour(stage: Usd.Stage, name: str) -> list[str]:
    """The prims that the diffuse and the emissive colour of an object's material come from."""
    prim = stage.GetPrimAtPath(f"/room/geo/{name}/{name}")
    surface = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
    inputs = [surface.GetInput(f"{kind}Color") for kind in ("diffuse", "emissive")]
    return [str(own.GetValueProducingAttributes()[0].GetPrim().GetName()) for own in inputs]


def test_each_lighting_has_layers_and_maps_of_its_own(asset):
    assert asset.lightings == LIGHTINGS
    layers = {path.name for path in (asset.folder / "layers").iterdir()}
    each = {f"{role}.{name}.usda" for name in LIGHTINGS
            for role in ("texturing", "shading", "lights", "material")}  # fmt: skip
    shared = {"scan.usdc", "texturing_uv.usdc", "texturing.usda", "shading.usda", "material.usda"}
    shared |= {"contents.usda", "photographs.usdc"}
    steps = {name for name in each | {f"{role}.usda" for role in ROLES} if "lights." not in name}
    interfaces = {name.replace(".usda", ".interface.usda") for name in steps}
    assert layers == each | shared | interfaces
    light = Usd.Stage.Open(str(asset.root_layer), Usd.Stage.LoadNone)
    full = Usd.Stage.Open(str(asset.root_layer))
    for name in LIGHTINGS:
        chosen = []
        for stage in (light, full):
            stage.SetEditTarget(stage.GetSessionLayer())
            sets = stage.GetDefaultPrim().GetVariantSets()
            assert list(sets.GetVariantSet("lighting").GetVariantNames()) == sorted(LIGHTINGS)
            sets.SetSelection("lighting", name)
            known = {each: sets.GetVariantSet(each) for each in ("look", "lights")}
            chosen.append(
                {k: (v.GetVariantNames(), v.GetVariantSelection()) for k, v in known.items()}
            )
        assert chosen[0] == chosen[1], name
    for name, wall in zip(LIGHTINGS, (0.25, 0.25), strict=True):
        stage = open_edited(asset.in_lighting(name))
        file = aov_path(stage, "/room/geo/floor/floor", "lit")
        assert file == asset.folder / "textures" / name / "floor.lit.exr"
        shown = read_exr(file)[..., 0]
        assert np.median(shown) == pytest.approx(wall, rel=0.02)
        assert (asset.folder / "previews" / name / "lit.png").is_file()


def test_the_root_layer_opens_in_the_first_and_others_can_be_chosen(asset):
    stage = open_edited(asset)
    choice = stage.GetDefaultPrim().GetVariantSet("lighting")
    assert choice.GetVariantNames() == [*LIGHTINGS]
    assert choice.GetVariantSelection() == "day"
    assert read_shading(stage, "/room/geo/lamp/lamp").radiance[0] == pytest.approx(8, rel=0.01)
    choice.SetVariantSelection("night")
    assert read_shading(stage, "/room/geo/box/box").radiance[0] == pytest.approx(6, rel=0.01)
    assert not read_shading(stage, "/room/geo/lamp/lamp").emitter


def test_all_lightings_show_one_base_colour_and_one_lobe(asset):
    found = []
    for name in LIGHTINGS:
        stage = open_edited(asset.in_lighting(name))
        files = [aov_path(stage, f"/room/geo/{o}/{o}", "base_color") for o in ("floor", "lamp")]
        lobes = [stage.GetAttributeAtPath(f"/room/geo/floor/floor.usdBrdf:fit:{n}").Get()
                 for n in ("phi", "psi")]  # fmt: skip
        found.append((files, lobes))
        assert _colour(stage, "floor") == ["BaseColorTexture", "PreviewSurface"]
    assert found[0] == found[1]
    assert found[0][0][0] == asset.folder / "textures" / "floor.base_color.exr"


def test_a_lamp_has_the_colour_that_it_shows_when_it_is_dark(asset):
    day, night = (AssetMaps(open_measured(asset.in_lighting(name))) for name in LIGHTINGS)
    names = [obj.label for obj in day.scene.objects]
    lamp, box = (day.texels.of_object(names.index(name)) for name in ("lamp", "box"))
    assert day.emissive[lamp].all()
    assert night.emissive[box].all()
    base_color = day.map("base_color")
    for own, dark in ((lamp, night), (box, day)):
        seen = dark.coverage.measured[own]
        expected = np.pi * dark.map("diffuse") / dark.map("refined_irradiance")
        expected = np.clip(expected, 0, 1)[own][seen]
        assert expected.max() > 0
        # But for what pixels mix where the light is uneven.
        off = np.abs(base_color[own][seen] - expected)
        assert np.percentile(off, 75) < 0.02 * expected.max() + 2e-3
    # Its emission is all that leaves it, where it shines.
    for name, shines, dark in (("day", "lamp", "box"), ("night", "box", "lamp")):
        stage = open_edited(asset.in_lighting(name))
        assert _colour(stage, shines) == ["PreviewSurface", "EmissionTexture"]
        assert _colour(stage, dark) == ["BaseColorTexture", "PreviewSurface"]


def test_frames_are_those_of_the_lighting(asset, captures):
    for name, capture in zip(LIGHTINGS, captures, strict=True):
        maps = AssetMaps(open_measured(asset.in_lighting(name)))
        assert {path.parents[1] for path in maps.frames.image_paths} == {capture}
    assert len(maps.all_frames) == 24
    assert maps.own_frames == range(12, 24)
    stage = open_edited(asset)
    assert stage.GetEndTimeCode() == 24


def test_what_is_printed_of_several_lightings_is_as_its_schema_says(asset, captures, capsys):
    assert _convert(captures, asset.folder, "--json") == 0
    told = checked(capsys.readouterr().out, "run")
    assert [*told["steps"]["texture"]["lightings"]] == [*LIGHTINGS]


def _files(stage: Usd.Stage) -> set[Path]:
    return {Path(layer.realPath) for layer in stage.GetUsedLayers() if not layer.anonymous}


def test_the_root_tells_before_it_is_loaded_which_layers_its_payload_opens(asset):
    root, loads = str(asset.root_layer), set()
    light = Usd.Stage.Open(root, Usd.Stage.LoadNone)
    told = light.GetDefaultPrim().GetAssetInfoByKey("payloadAssetDependencies")
    for name in LIGHTINGS:
        stages = [Usd.Stage.Open(root, load) for load in (Usd.Stage.LoadAll, Usd.Stage.LoadNone)]
        for stage in stages:
            stage.SetEditTarget(stage.GetSessionLayer())
            stage.GetDefaultPrim().GetVariantSet("lighting").SetVariantSelection(name)
        loads |= _files(stages[0]) - _files(stages[1])
    assert {Path(path.resolvedPath) for path in told} == loads


def test_a_package_of_the_whole_shows_each_lighting(asset, tmp_path):
    output = packed(SimpleNamespace(asset=asset), tmp_path, whole=True)
    packages = [Usd.Stage.Open(str(output)), Usd.Stage.Open(str(output), Usd.Stage.LoadNone)]
    for name in LIGHTINGS:
        here = open_edited(asset.in_lighting(name))
        for stage in packages:
            stage.SetEditTarget(stage.GetSessionLayer())
            choice = stage.GetDefaultPrim().GetVariantSet("lighting")
            assert choice.GetVariantNames() == [*LIGHTINGS]
            choice.SetVariantSelection(name)
            sets = [one.GetDefaultPrim().GetVariantSet("lights") for one in (stage, here)]
            assert sets[0].GetVariantNames() == sets[1].GetVariantNames()
        there = packages[0]
        assert {p.GetPath() for p in there.Traverse()} == {p.GetPath() for p in here.Traverse()}
        for prim in there.Traverse():
            for attribute in prim.GetAttributes():
                value = attribute.Get()
                if isinstance(value, Sdf.AssetPath) and value.path:
                    assert value.resolvedPath.startswith(f"{output}["), attribute.GetPath()
        for obj in ("lamp", "box"):
            path = f"/room/geo/{obj}/{obj}"
            assert read_shading(there, path).radiance == read_shading(here, path).radiance
            assert _colour(there, obj) == _colour(here, obj)


def test_the_asset_keeps_all_rules(asset, capsys):
    capsys.readouterr()
    assert main(["validate", str(asset.folder)]) == 0
    assert "error" not in capsys.readouterr().out


def test_each_lighting_is_read_by_its_own_encoding(base):
    """Three captures of one scene in one light: as radiance, as that in ACEScg, and as 8-bit
    photographs, whose unit is that of the others as they were exposed alike."""
    radiance = {"lamp": (0.75, 0.5, 0.6)}
    folders = [base / "encodings" / name for name in ("radiance", "acescg", "photographs")]
    plain, wide, bytes_ = (
        make_capture(f, subdivisions=2, poses=poses_down_and_up(6, 6), radiance=radiance)
        for f in folders
    )
    for i in range(12):
        pixels = read_exr(plain.image(i))
        in_ap1 = from_working_space(pixels, "lin_ap1_scene")
        write_exr(wide.image(i), in_ap1, half=False)
        shown = to_display_srgb8(pixels, exposure_scale=1.0)
        write_preview_png(bytes_.image(i).with_suffix(".png"), shown)
        bytes_.image(i).unlink()
    with edited(wide.manifest) as document:
        document["encoding"] = "lin_ap1_scene"
    with edited(bytes_.manifest) as document:
        for frame in document["frames"]:
            frame["file_path"] = frame["file_path"].replace(".exr", ".png")
            del frame["saturation_radiance"], frame["noise_floor_radiance"]
    out = base / "encodings" / "out"
    assert main(["ingest", "-q", *map(str, folders), "-o", str(out), "--assume-srgb"]) == 0
    assert main(["texture", "-q", str(out), "--texel-size", "0.3"]) == 0
    maps = [AssetMaps(open_measured(Asset.at(out).in_lighting(folder.name))) for folder in folders]
    known, *others = (one.map("lit") for one in maps)
    assert [one.frames.radiometric for one in maps] == [True, True, False]
    assert [one.frames.encoding for one in maps[:2]] == ["lin_rec709_scene", "lin_ap1_scene"]
    seen = np.logical_and.reduce([one.coverage.measured for one in maps])
    assert np.count_nonzero(seen) > 150
    np.testing.assert_allclose(others[0][seen], known[seen], rtol=2e-3, atol=2e-4)
    # Half a code of sRGB is at most so much of a radiance above 1/20.
    np.testing.assert_allclose(others[1][seen], known[seen], rtol=0.011, atol=2e-4)


def test_a_second_run_does_only_what_is_missing_and_of_one_lighting_alone(asset, captures):
    again = usdbrdf.convert(captures, asset.folder, _options())
    assert [name for name, result in again.items() if result.reran] == []
    assert again["shade"].summary["lightings"]["day"]["emitters"] == ["lamp"]
    textures = asset.folder / "textures"
    lost = textures / "night" / "floor.albedo.exr"
    content = lost.read_bytes()
    lost.unlink()
    before = {path: path.stat().st_ino for path in (textures / "day").iterdir()}
    after = usdbrdf.convert(captures, asset.folder, _options())
    assert [name for name, result in after.items() if result.reran] == ["shade"]
    assert lost.read_bytes() == content
    assert {path: path.stat().st_ino for path in (textures / "day").iterdir()} == before


def _options() -> usdbrdf.ConvertOptions:
    shade = usdbrdf.ShadeOptions(
        sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64),
        environment="none",
        denoise="none",
    )
    return usdbrdf.ConvertOptions(
        texture=usdbrdf.TextureOptions(texel_size=0.3),
        shade=shade,
        fit=usdbrdf.FitOptions(environment="none"),
    )


def test_views_are_evaluated_in_the_lighting_that_is_named(asset, captures, tmp_path):
    places = [tmp_path / name for name in LIGHTINGS]
    for name, capture, place in zip(LIGHTINGS, captures, places, strict=True):
        given = ["--views", str(capture / "transforms.json"), "--lighting", name]
        rays = ["--samples-per-pixel", "1", "--rays", "8", "--environment", "none"]
        assert main(["evaluate", str(asset.folder), *given, *rays, "-q", "-o", str(place)]) == 0
        found = json.loads((place / "evaluation.json").read_text())
        assert found["lighting"] == name
        # The radiance of objects is a number, so L_d shows the frames but for edges.
        assert found["summary"]["l2_shown"]["baseline"] < 0.2
    _page_of_the_night(asset, *places)
    with pytest.raises(UsageError, match=r"the asset has day, night. \[asset.lighting\]"):
        asset.in_lighting("dawn")


def _page_of_the_night(asset, by_day, by_night):
    """What the page tells is of one lighting throughout."""
    asked = partial(usdbrdf.ReportOptions, lighting="night", environment="none")
    with pytest.raises(
        InputRefused, match=r"lighting 'day', not in 'night'.*\[report.evaluation\]"
    ):
        page_data(asset, asked(evaluation=by_day))
    data = page_data(asset, asked(evaluation=by_night))
    assert data["capture"]["lighting"] == "night"
    assert data["capture"]["frames"] == len(data["rows"]) == 12
    assert any("Photographs measured" in told for told in data["findings"])
    assert any("standard error of" in told for told in data["findings"])
    lamps = {row["id"]: row["radiance"] for row in data["objects"] if row["status"] == "lamp"}
    assert list(lamps) == ["box"]
    assert lamps["box"]["mean"][0] == pytest.approx(6, rel=0.01)


def test_target_frames_are_counted_in_the_lighting_that_is_shown(asset, monkeypatch):
    maps = AssetMaps(open_measured(asset.in_lighting("night")))
    fit = read_fit(maps.stage, "/room/geo/floor/floor")
    for stored, shown in ((15, 3), (3, -1), (-1, -1)):
        changed = replace(fit, target_frame=stored)
        monkeypatch.setattr(report, "read_fit", lambda *_, changed=changed: changed)
        assert report._in_own_frames(maps, "/room/geo/floor/floor").target_frame == shown


def test_lightings_of_one_asset_are_compared(asset, tmp_path):
    options = usdbrdf.CompareOptions(lighting="day", other_lighting="night")
    found = usdbrdf.compare(asset.folder, asset.folder, tmp_path / "compared", options)
    assert found["lightings"] == ["day", "night"]
    # One base colour for both, but S and L_d of each.
    assert found["diffuse"]["albedo"]["nrmse"] == 0
    assert found["lit"]["relit_a"] != found["lit"]["relit_b"]


def test_an_adopted_edit_of_one_lighting_is_none_of_the_others(asset, tmp_path):
    folder = tmp_path / "room"
    shutil.copytree(asset.folder, folder)
    copy, name = Asset.made(folder), "/room/geo/floor/floor.usdBrdf:shading:raysPerTexel"
    edited = copy.in_lighting("night").layer("shading")
    layer = Sdf.Layer.OpenAsAnonymous(str(edited))
    layer.GetAttributeAtPath(name).default = 7777.0
    layer.Export(str(edited))
    (adopted,) = adopt(copy, [edited])
    shutil.copyfile(asset.in_lighting("night").layer("shading"), edited)
    edits = Sdf.Layer.OpenAsAnonymous(str(copy.edits_layer))
    edits.subLayerPaths.append(f"./{adopted.name}")
    edits.Export(str(copy.edits_layer))
    stages = [open_edited(copy.in_lighting(lighting)) for lighting in LIGHTINGS]
    stages.append(open_edited(asset.in_lighting("day")))
    day, night, before = (stage.GetAttributeAtPath(name).Get() for stage in stages)
    assert (day, night) == (before, 7777.0)


def test_advice_is_of_the_lighting_that_the_asset_opens_in(asset):
    told = usdbrdf.advise(asset.folder, usdbrdf.AdviseOptions(poses=1))
    place, atlas = measured_atlas(asset.folder, None)
    place = place.in_lighting(atlas.lighting)
    assert told["layer"] == str(place.advice_layer)
    assert read_advice(place) == (told["poses"], True)
    place.advice_layer.unlink()


def test_other_lightings_need_another_folder(base, asset, captures):
    with pytest.raises(OwnershipConflict, match=r"has the lightings day, night.*lightings\]"):
        usdbrdf.convert(captures[0], asset.folder, _options())
    other = base / "dusk"
    shutil.copytree(captures[1], other)
    with pytest.raises(OwnershipConflict, match=r"\[ownership.lightings\]"):
        usdbrdf.convert([captures[0], other], asset.folder, _options())


def test_one_frame_of_one_lighting_is_not_fitted(base, captures):
    options = usdbrdf.ConvertOptions(fit=usdbrdf.FitOptions(method="paper"))
    with pytest.raises(UsageError, match=r"--fit paper.*\[usage.option\]"):
        usdbrdf.convert(captures, base / "none", options)
    assert not (base / "none").exists()


def test_a_single_capture_knows_nothing_of_lightings(base, captures):
    with usdbrdf.working_on(base / "single") as single:
        usdbrdf.ingest(captures[0], single, usdbrdf.IngestOptions())
    assert single.lightings == ()
    assert single.in_each_lighting == (single,)
    assert "ighting" not in (single.folder / "layers" / "texturing.usda").read_text()
    stage = open_edited(single)
    camera = stage.GetPrimAtPath("/single/cameras/capture")
    assert not camera.GetAttribute("usdBrdf:capture:lighting").HasAuthoredValue()
    with pytest.raises(UsageError, match="the asset has but one lighting"):
        single.in_lighting("day")
