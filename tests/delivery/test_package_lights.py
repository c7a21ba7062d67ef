"""Lamps shine in every package: by lights where it can hold them, else by their material."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd

from tests.delivery.packing import edit, extracted, packed, surfaces_of
from tests.synthetic_asset import sky_of
from usdbrdf.asset.layers.lights_layer import write_lights_layer
from usdbrdf.asset.readers.surfaces import paths_of
from usdbrdf.delivery.package import lights_of, stage_in_look
from usdbrdf.files.images import read_exr

LIGHTS_SELECTED = 'over "room" ( variants = { string lights = "usdlux" } ) {}'


def test_lights_that_the_artist_selected_travel(room, tmp_path):
    edit(room, LIGHTS_SELECTED)
    stage = extracted(packed(room, tmp_path), tmp_path / "x")
    assert len(lights_of(stage)) == 6
    assert not surfaces_of(stage)["/room/geo/lamp/lamp"].material.emits


def test_lamps_glow_where_the_package_holds_no_lights(room, tmp_path, capsys):
    here = surfaces_of(stage_in_look(room.asset))["/room/geo/lamp/lamp"].material.emission
    edit(room, LIGHTS_SELECTED)
    stage = extracted(packed(room, tmp_path, profile="arkit"), tmp_path / "x")
    there = surfaces_of(stage)["/room/geo/lamp/lamp"].material.emission
    assert there.max() == pytest.approx(8, rel=1e-3)
    assert there == pytest.approx(here, abs=0.05)
    assert lights_of(stage) == []
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("with_lamp", [True, False])
@pytest.mark.parametrize(("name", "options"), [("ar.usdz", {"profile": "arkit"}), ("room.glb", {})])
def test_light_from_outside_that_a_package_cannot_hold_is_told(
    room, tmp_path, capsys, name, options, with_lamp
):
    if name.endswith(".glb"):
        pytest.importorskip("PIL", reason="Pillow is not installed")
    room.outside = sky_of(room.asset)
    if with_lamp:
        room.write_layer("shading")
    else:
        write_lights_layer(
            room.asset.lights_layer, room.draft("shading"), [], room.outside, np.eye(4)
        )
    edit(room, LIGHTS_SELECTED)
    packed(room, tmp_path, name, **options)
    told = capsys.readouterr().err
    assert "left out: </room/lights/sky> (DomeLight), </room/lights/sun> (DistantLight)." in told
    assert told.count("\n") == 1
    usdz = extracted(packed(room, tmp_path), tmp_path / "x")
    kinds = {light.GetTypeName() for light in lights_of(usdz)}
    assert kinds >= {"DomeLight", "DistantLight"}
    (dome,) = (light for light in lights_of(usdz) if light.GetTypeName() == "DomeLight")
    picture = read_exr(Path(dome.GetAttribute("inputs:texture:file").Get().resolvedPath))
    np.testing.assert_array_equal(picture, read_exr(room.asset.folder / room.asset.sky))


def test_of_a_night_nothing_is_told(room, tmp_path, capsys):
    room.outside = sky_of(room.asset)
    room.write_layer("shading")
    edit(room, 'over "room" ( variants = { string lights = "emissive" } ) {}')
    packed(room, tmp_path, "ar.usdz", profile="arkit")
    assert capsys.readouterr().err == ""


def test_the_lights_of_another_asset_are_replaced_too(room, tmp_path, capsys):
    """As props, twice: one an instance, whose own opinion selects the lights."""
    edit(
        room,
        """over "room" {
        def "near" ( references = </other>
            variants = { string lights = "usdlux" } ) {}
        def "far" ( references = </other>
            instanceable = true
            variants = { string lights = "usdlux" } ) {} }
        class "other" ( variantSets = "lights" ) {
        variantSet "lights" = { "emissive" {} "usdlux" { def SphereLight "bulb" {} } } }""",
    )
    assert len(lights_of(Usd.Stage.Open(str(packed(room, tmp_path))))) == 2
    packed(room, tmp_path, "ar.usdz", profile="arkit")
    assert capsys.readouterr().err == ""  # no light was there to be left out


@pytest.mark.parametrize(("name", "options"), [("ar.usdz", {"profile": "arkit"}), ("room.glb", {})])
def test_the_artists_own_lights_are_told(room, tmp_path, capsys, name, options):
    if name.endswith(".glb"):
        pytest.importorskip("PIL", reason="Pillow is not installed")
    edit(room, 'over "room" { def SphereLight "key" {} def Sphere "ball" {} }')
    packed(room, tmp_path, name, **options)
    told = capsys.readouterr().err
    assert "left out: </room/key> (SphereLight)" in told
    assert "anon:" not in told
    ball = f"{room.asset.root_layer}: only meshes are taken; left out: </room/ball> (Sphere)."
    assert (ball in told) == name.endswith(".glb")


def test_a_sentence_names_the_first_prims_and_counts_the_rest():
    stage = Usd.Stage.CreateInMemory()
    prims = [stage.DefinePrim(f"/a{i}", "Sphere") for i in range(7)]
    assert paths_of(prims[:2]) == "</a0> (Sphere), </a1> (Sphere)"
    assert paths_of(prims).endswith(", </a4> (Sphere) and 2 more")
