"""The variant set ``lights``: the same light from surfaces or from UsdLux, never from both."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from tests.synthetic_asset import SUN_DIRECTION, SUN_IRRADIANCE, sky_of
from usdbrdf.asset.layers.lights_layer import (
    DAYLIGHT,
    EMISSIVE,
    LIGHTS,
    USDLUX,
    Lamp,
    write_lights_layer,
)
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.render_scene import render_scene_from_stage, sky_of_picture
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.model.light import DistantLight, LampShape, SkyLight
from usdbrdf.validation.validate import validate

RADIANCE = np.array([8.0, 4.0, 2.0])
TIME = Usd.TimeCode.EarliestTime()


@pytest.fixture(params=[(1.0, "Z"), (0.01, "Y")], ids=["metres", "centimetres"])
def lit(tmp_path, synthetic, request):
    """An asset whose lamp shines with the radiance that its lights have."""
    unit, up_axis = request.param
    scan = synthetic.make_scan(tmp_path / "capture", unit=unit, up_axis=up_axis)
    built = synthetic.build(tmp_path / "room", scan)
    emission = np.tile(np.float32(RADIANCE), (4, 4, 1))
    write_exr(built.asset.folder / "textures/lamp.emission.exr", emission)
    return built


def opened(built, variant):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    stage.SetEditTarget(stage.GetSessionLayer())
    assert stage.GetDefaultPrim().GetVariantSet(LIGHTS).SetVariantSelection(variant)
    return stage


def irradiance_of_triangles(surfaces, point):
    """On a floor at the point, by the midpoints of many small triangles; no occlusion."""
    total = np.zeros(3)
    for surface in surfaces:
        corners = surface.points[surface.triangles]
        for _ in range(4):
            a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            parts = ([a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca])
            corners = np.concatenate([np.stack(part, axis=1) for part in parts])
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        total += gathered(corners.mean(axis=1), cross, surface.material.emission[0, 0], point)
    return total


def irradiance_of_lights(lights, point):
    total = np.zeros(3)
    grid = (np.arange(40) + 0.5) / 20 - 1
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    for light in lights:
        assert light.kind == "rectangle"
        pose = light.world_from_here
        spots = np.column_stack([x, y, 0 * x, 1 + 0 * x]) @ pose.T
        normal = np.cross(pose[:3, 0], pose[:3, 1]) * 4 / len(x)
        total += gathered(spots[:, :3], normal[None], light.emission[0, 0], point)
    return total


def gathered(spots, area_vectors, radiance, point):
    """Sum of L cos cos' dA / r^2 over spots that face a floor."""
    away = spots - point
    distance = np.linalg.norm(away, axis=1)
    facing = np.maximum(-(away * area_vectors).sum(axis=1) / distance, 0)
    cosine = np.maximum(away[:, 2] / distance, 0)
    return (facing * cosine / distance**2).sum() * radiance


@pytest.mark.parametrize("point", [(0.0, 0.0, 1.2), (1.5, -1.0, 0.0)])
def test_both_variants_light_the_floor_alike(lit, point):
    glowing = render_scene_from_stage(opened(lit, EMISSIVE), TIME, pytest.fail)
    assert not glowing.lights
    emitters = [s for s in glowing.surfaces if s.material.emits]
    assert len(emitters) == 1
    expected = irradiance_of_triangles(emitters, np.array(point))
    assert expected.min() > 0.01

    replaced = render_scene_from_stage(opened(lit, USDLUX), TIME, pytest.fail)
    assert not any(s.material.emits for s in replaced.surfaces)
    found = irradiance_of_lights(replaced.lights, np.array(point))
    assert found == pytest.approx(expected, rel=0.02)


def test_glowing_surfaces_are_the_default(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    variants = stage.GetDefaultPrim().GetVariantSet(LIGHTS)
    assert variants.GetVariantNames() == [EMISSIVE, USDLUX]
    assert variants.GetVariantSelection() == EMISSIVE
    assert not [prim for prim in stage.TraverseAll() if prim.HasAPI(UsdLux.LightAPI)]


def test_radiance_is_intensity_times_exposure_times_colour(built):
    stage = opened(built, USDLUX)
    lights = [UsdLux.LightAPI(p) for p in stage.TraverseAll() if p.HasAPI(UsdLux.LightAPI)]
    assert len(lights) == 6
    for light in lights:
        assert str(light.GetPath()).startswith("/room/lights/lamp/")
        assert light.GetNormalizeAttr().Get() is False
        scale = light.GetIntensityAttr().Get() * 2 ** light.GetExposureAttr().Get()
        assert np.array(light.GetColorAttr().Get()) * scale == pytest.approx(RADIANCE)


@pytest.mark.parametrize("look", ["lit", "irradiance", "shaded"])
def test_the_looks_switch_in_either_variant(built, look):
    for variant in (EMISSIVE, USDLUX):
        stage = opened(built, variant)
        stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection(look)
        (chair,) = (
            stage.GetPrimAtPath("/room/geo/Stuhl_No_1/Stuhl_No_1")
            .GetRelationship("material:binding")
            .GetTargets()
        )
        expected = "mtl/Stuhl_No_1" if look == "shaded" else f"looks/{look}"
        assert chair == f"/room/geo/Stuhl_No_1/{expected}"
        # A map of the lamp is a map still: only the lamp's own material is switched off.
        emits = [
            s.name
            for s in render_scene_from_stage(stage, TIME, lambda _: None).surfaces
            if s.material.emits
        ]
        assert ("/room/geo/lamp/lamp" in emits) == (look != "shaded" or variant == EMISSIVE)


def test_a_muted_layer_leaves_the_lamps_on(built):
    stage = opened(built, USDLUX)
    layers = [layer for layer in stage.GetUsedLayers() if layer.GetDisplayName() == "lights.usda"]
    stage.MuteLayer(layers[0].identifier)
    found = render_scene_from_stage(stage, TIME, pytest.fail)
    assert not found.lights
    assert any(surface.material.emits for surface in found.surfaces)


def test_both_variants_validate(built):
    assert [str(found) for found in validate(built.asset.root_layer)] == []
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    edits.GetPrimAtPath("/room").variantSelections[LIGHTS] = USDLUX
    edits.Save()
    assert [str(found) for found in validate(built.asset.root_layer)] == []


@pytest.mark.parametrize(("up_axis", "unit"), [("Z", 1.0), ("Y", 0.01)])
def test_light_from_outside_is_a_dome_and_a_sun(tmp_path, synthetic, up_axis, unit):
    scan = synthetic.make_scan(tmp_path / "capture", up_axis=up_axis, unit=unit)
    built = synthetic.build(tmp_path / "out" / "room", scan)
    built.outside = sky_of(built.asset)
    built.write_layer("shading")
    stage = opened(built, USDLUX)
    found = render_scene_from_stage(stage, TIME, pytest.fail).lights
    (sky,) = (light for light in found if isinstance(light, SkyLight))
    (sun,) = (light for light in found if isinstance(light, DistantLight))
    np.testing.assert_allclose(sun.towards, -np.array(SUN_DIRECTION), atol=1e-6)
    np.testing.assert_allclose(sun.irradiance, SUN_IRRADIANCE, rtol=1e-5)
    assert sun.half_angle == pytest.approx(0.00465, rel=1e-4)
    picture = read_exr(built.asset.folder / built.asset.sky)
    np.testing.assert_array_equal(sky.image, picture)
    turned = sky_of_picture(picture, up_axis)
    np.testing.assert_allclose(sky.world_from_here, turned.world_from_here, atol=1e-6)
    off = render_scene_from_stage(opened(built, EMISSIVE), TIME, pytest.fail).lights
    assert not [light for light in off if isinstance(light, (SkyLight, DistantLight))]
    # What transport takes is the same.
    maps = AssetMaps(open_measured(built.asset))
    environment = maps.environment("estimate")
    assert environment.z_up == (up_axis == "Z")
    np.testing.assert_array_equal(environment.image, picture)
    np.testing.assert_allclose(environment.sun.irradiance, SUN_IRRADIANCE, rtol=1e-6)
    np.testing.assert_allclose(environment.sun.direction, SUN_DIRECTION, rtol=1e-6)
    assert not maps.environment("none").image.any()
    assert [str(found) for found in validate(built.asset.root_layer)] == []


@pytest.mark.parametrize("with_lamp", [False, True])
def test_the_light_from_outside_is_on(built, with_lamp):
    built.outside = sky_of(built.asset)
    lamps = [ball_lamp(built)] if with_lamp else []
    write_lights_layer(
        built.asset.lights_layer, built.draft("shading"), lamps, built.outside, np.eye(4)
    )
    layer = Sdf.Layer.FindOrOpen(str(built.asset.lights_layer))
    shown = DAYLIGHT if with_lamp else USDLUX
    assert layer.GetPrimAtPath("/room").variantSelections[LIGHTS] == shown
    assert _kinds(opened(built, shown)) == {"DomeLight", "DistantLight"}
    # The lamp glows beside it, and is a light in the third variant.
    assert ("SphereLight" in _kinds(opened(built, USDLUX))) == with_lamp
    assert not _kinds(opened(built, EMISSIVE))


def _kinds(stage: Usd.Stage) -> set[str]:
    return {prim.GetTypeName() for prim in stage.TraverseAll() if prim.HasAPI(UsdLux.LightAPI)}


def test_a_ball_is_hidden_inside_its_light(built):
    lamp = ball_lamp(built)
    write_lights_layer(built.asset.lights_layer, built.draft("shading"), [lamp], None, np.eye(4))
    stage = opened(built, USDLUX)
    (light,) = (p for p in stage.TraverseAll() if p.HasAPI(UsdLux.LightAPI))
    assert light.GetTypeName() == "SphereLight"
    imageable = UsdGeom.Imageable(stage.GetPrimAtPath("/room/geo/lamp/lamp"))
    assert imageable.ComputeVisibility() == UsdGeom.Tokens.invisible
    stage = opened(built, EMISSIVE)
    imageable = UsdGeom.Imageable(stage.GetPrimAtPath("/room/geo/lamp/lamp"))
    assert imageable.ComputeVisibility() == UsdGeom.Tokens.inherited


def test_an_asset_whose_scan_knew_no_lights_gets_a_name_that_no_input_has(built):
    scan = Sdf.Layer.FindOrOpen(str(built.asset.layer("scan")))
    data = scan.customLayerData
    del data["usdbrdf"]["scopes"]["lights"]
    scan.customLayerData = data
    scan.Save()
    built.write_lights()
    stage = opened(built, USDLUX)
    found = [str(p.GetPath()) for p in stage.TraverseAll() if p.HasAPI(UsdLux.LightAPI)]
    assert found
    assert all(path.startswith("/room/usdbrdf_lights/") for path in found)


def test_lights_stand_in_the_world_whatever_the_root_does(built):
    root = np.array([[0, -2.0, 0, 1], [2.0, 0, 0, 2], [0, 0, 2.0, 3], [0, 0, 0, 1]])
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    prim = edits.GetPrimAtPath("/room")
    types = Sdf.ValueTypeNames
    op = Sdf.AttributeSpec(prim, "xformOp:transform", types.Matrix4d)
    op.default = Gf.Matrix4d(root.T.tolist())
    order = Sdf.AttributeSpec(prim, "xformOpOrder", types.TokenArray, Sdf.VariabilityUniform)
    order.default = ["xformOp:transform"]
    edits.Save()
    write_lights_layer(
        built.asset.lights_layer, built.draft("shading"), [ball_lamp(built)], None, root
    )
    (light,) = render_scene_from_stage(opened(built, USDLUX), TIME, pytest.fail).lights
    assert light.world_from_here[:3, 3] == pytest.approx([1.0, 2.0, 2.5])
    scale = abs(np.linalg.det(light.world_from_here[:3, :3])) ** (1 / 3)
    assert scale == pytest.approx(0.2)


def ball_lamp(built):
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 2.5
    shape = LampShape(
        kind="sphere", size=(0.4, 0.4), world_from_light=pose, radiance=tuple(RADIANCE)
    )
    return Lamp(prim_path=built.prims[2], identifier="lamp", shapes=(shape,))
