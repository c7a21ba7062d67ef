"""What a person asks of objects: which steps follow it, and what the stage says of that."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pxr import UsdShade

import usdbrdf
from tests.scenes import edited, make_capture, poses_down_and_up
from usdbrdf.asset.directives import directives_of
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.render_scene import render_scene_from_stage, time_code
from usdbrdf.asset.readers.scene import read_fit, read_shading
from usdbrdf.asset.review import Judgement, write_review
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import write_exr
from usdbrdf.model.mesh import OF_FIT
from usdbrdf.tasks import outside
from usdbrdf.tasks.shade import shade
from usdbrdf.validation.validate import has_errors, validate

OPTIONS = usdbrdf.ConvertOptions(
    texture=usdbrdf.TextureOptions(texel_size=0.3),
    shade=usdbrdf.ShadeOptions(
        sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64),
        environment="none",
        denoise="none",
    ),
    fit=usdbrdf.FitOptions(environment="none"),
)


def _say(asset: Asset, **words: str) -> None:
    said = {f"/room/geo/{name}/{name}": Judgement(directive=word) for name, word in words.items()}
    write_review(asset, said)


def test_the_steps_do_what_is_asked_and_only_those_that_it_concerns(tmp_path):
    capture = make_capture(tmp_path / "scan", subdivisions=2, poses=poses_down_and_up(6, 4))
    folder = tmp_path / "room"

    def reran() -> list[str]:
        return [k for k, v in usdbrdf.convert(capture.folder, folder, OPTIONS).items() if v.reran]

    assert reran() == ["ingest", "texture", "shade", "fit"]
    asset = Asset.made(folder)
    scan = asset.layer("scan").read_bytes()
    asked = {"floor": "metal", "ceiling": "refit", "walls": "glass", "box": "ignore"}
    _say(asset, **asked)
    assert reran() == ["fit"]
    stage = open_measured(asset)
    fits = {name: read_fit(stage, f"/room/geo/{name}/{name}") for name in capture.names}
    words = {name: fit.directive for name, fit in fits.items()}
    assert words == {
        "floor": "metal",
        "ceiling": "refit",
        "walls": "glass",
        "lamp": "",
        "box": "ignore",
    }
    for name in ("box", "walls"):
        assert (fits[name].num_pixels, fits[name].status) == (0, "undetermined")
    assert [name for name, fit in fits.items() if fit.is_glass] == ["walls"]
    surface = UsdShade.Shader.Get(stage, "/room/geo/walls/mtl/walls/PreviewSurface")
    shown = {n: surface.GetInput(n).Get() for n in ("opacity", "roughness", "ior", "diffuseColor")}
    assert shown == {"opacity": 0, "roughness": 0, "ior": 1.5, "diffuseColor": (0, 0, 0)}
    rendered = render_scene_from_stage(stage, time_code(stage, None), lambda _: None)
    assert [s.name for s in rendered.surfaces if s.material.clear] == ["/room/geo/walls/walls"]
    assert not has_errors(validate(asset.root_layer))
    # The capture says of the lamp that it is none: only what it concerns is made again.
    with edited(capture.folder / "objects.json") as document:
        (lamp,) = [row for row in document["objects"] if row["name"] == "lamp"]
        lamp["directive"] = "not-lamp"
    assert reran() == ["ingest", "shade", "fit"]
    assert asset.layer("scan").read_bytes() == scan
    shading = read_shading(open_measured(asset), "/room/geo/lamp/lamp")
    assert (shading.emitter, shading.directive) == (False, "not-lamp")
    # What a person says afterwards counts before it.
    _say(asset, lamp="lamp", box="lamp")
    assert reran() == ["shade", "fit"]
    stage = open_measured(asset)
    found = {name: read_shading(stage, f"/room/geo/{name}/{name}") for name in ("lamp", "box")}
    assert all(one.emitter and one.directive == "lamp" for one in found.values())
    # One frame cannot tell whether an object is a metal, and gives those who say so one.
    _say(asset, floor="metal")
    for method in ("scaled", "paper"):
        fit = usdbrdf.FitOptions(environment="none", method=method, max_pixels=50)
        usdbrdf.convert(capture.folder, folder, replace(OPTIONS, fit=fit))
        stage = open_measured(asset)
        floor, walls = (read_fit(stage, f"/room/geo/{name}/{name}") for name in ("floor", "walls"))
        assert (floor.directive, floor.model, floor.status) == (
            "metal",
            "conductor",
            "undetermined",
        )
        assert (floor.phi_confidence, floor.psi_confidence) == ("low", "low")
        assert math.isnan(floor.f0_error)
        assert all(0 <= value <= 1 for value in floor.f0)
        assert any(floor.f0)
        assert (walls.directive, walls.is_metal) == ("", False)
        surface = UsdShade.Shader.Get(stage, "/room/geo/floor/mtl/floor/PreviewSurface")
        assert surface.GetInput("metallic").Get() == 1
        assert not has_errors(validate(asset.root_layer))


def test_panes_are_clear_glass_unless_a_person_says_otherwise(tmp_path, monkeypatch):
    """How they are known is tested where that is done; without an outside they are surfaces."""
    monkeypatch.setattr(outside, "find_panes", lambda *_: tuple(map(capture.names.index, panes)))
    capture = make_capture(tmp_path / "scan", subdivisions=2, poses=poses_down_and_up(6, 4))
    panes = ["walls"]
    sky = tmp_path / "sky.exr"
    write_exr(sky, np.ones((8, 16, 3), np.float32))
    folder = tmp_path / "room"
    of_shade = replace(OPTIONS.shade, environment=sky)

    def found(shade, **words):
        fit = replace(OPTIONS.fit, environment=shade.environment)
        usdbrdf.convert(capture.folder, folder, replace(OPTIONS, shade=shade, fit=fit))
        asset = Asset.made(folder)
        if words:
            _say(asset, **words)
            usdbrdf.convert(capture.folder, folder, replace(OPTIONS, shade=shade, fit=fit))
        stage = open_measured(asset)
        assert not has_errors(validate(asset.root_layer))
        path = "/room/geo/walls/walls"
        return stage, read_shading(stage, path), read_fit(stage, path)

    stage, shaded, fitted = found(of_shade)
    assert shaded.lets_through
    assert not read_shading(stage, "/room/geo/box/box").lets_through
    assert (fitted.model, fitted.directive, fitted.num_pixels) == ("transparent", "", 0)
    rendered = render_scene_from_stage(stage, time_code(stage, None), lambda _: None)
    assert [s.name for s in rendered.surfaces if s.material.clear] == ["/room/geo/walls/walls"]
    # One that is brighter than what reaches it is no lamp: the sky behind it is.
    panes.append("lamp")
    path = "/room/geo/lamp/lamp"
    stage = found(replace(of_shade, sampling=replace(of_shade.sampling, seed=1)))[0]
    shaded = read_shading(stage, path)
    assert (shaded.lets_through, shaded.emitter) == (True, False)
    assert not any(aov.name in ("emission", "unexplained") for aov in shaded.aovs)
    assert read_fit(stage, path).is_glass
    panes.remove("lamp")
    # The floor, which the walls' light reached alone, is lit by the sky as well.
    lit_by_sky = read_shading(stage, "/room/geo/floor/floor").escaped_fraction
    assert lit_by_sky > 0.05
    _, shaded, fitted = found(of_shade, walls="refit")
    assert (shaded.lets_through, fitted.is_glass, fitted.directive) == (True, False, "refit")
    stage, shaded, fitted = found(OPTIONS.shade)
    assert (shaded.lets_through, fitted.is_glass) == (False, False)
    assert read_shading(stage, "/room/geo/floor/floor").escaped_fraction < lit_by_sky


def test_panes_are_asked_of_photographs_that_are_those_of_the_capture(tmp_path):
    """Where something is outside; without, the photographs may be gone."""
    capture = make_capture(tmp_path / "scan", subdivisions=1, poses=poses_down_and_up(5, 4))
    sky = tmp_path / "sky.exr"
    write_exr(sky, np.ones((8, 16, 3), np.float32))
    folder = tmp_path / "room"
    usdbrdf.convert(capture.folder, folder, OPTIONS)
    asset = Asset.made(folder)
    for file in capture.folder.glob("frames/*.exr"):
        write_exr(file, np.ones((24, 32, 3), np.float32))
    with pytest.raises(InputRefused, match=r"\[input.changed\]$"):
        shade(asset, replace(OPTIONS.shade, environment=sky))
    for file in capture.folder.glob("frames/*.exr"):
        file.unlink()
    sampling = replace(OPTIONS.shade.sampling, seed=5)
    shade(asset, replace(OPTIONS.shade, sampling=sampling))


def test_a_word_that_is_none_stops_the_step_that_reads_it(built):
    _say(built.asset, Stuhl_No_1="gold")
    with pytest.raises(InputRefused, match=r"'gold' is none of .*\[review.layer\]$"):
        directives_of(built.asset, open_measured(built.asset), OF_FIT)
