"""UsdLux lights in their own units, and which of the lights of two files are left on."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.relighting.scenes import cube, material, plate
from usdbrdf.asset.readers.render_scene import render_scene_from_file
from usdbrdf.files.images import write_exr
from usdbrdf.model.light import DistantLight, Light, RelitScene, ShapeLight, SkyLight
from usdbrdf.model.material import UNKNOWN_DIFFUSE, constant_map
from usdbrdf.relighting.relit_scene import _light_of_file, lit_by_others
from usdbrdf.transport.environment import environment_from_file

_HEADER = '#usda 1.0\n(\n    metersPerUnit = 0.01\n    upAxis = "{up}"\n)\n'


def _lights(tmp_path: Path, text: str, up: str = "Y") -> tuple[Light, ...]:
    file = tmp_path / "lights.usda"
    file.write_text(_HEADER.format(up=up) + text)
    return render_scene_from_file(file, pytest.fail).lights


def test_rect_light_emission_is_radiance(tmp_path: Path) -> None:
    text = """def RectLight "a" {
    float inputs:width = 200
    float inputs:height = 50
    float inputs:intensity = 3
    float inputs:exposure = 2
    color3f inputs:color = (1, 0.5, 0.25)
    NORMALIZE
}
"""
    (light,) = _lights(tmp_path, text.replace("NORMALIZE", ""))
    assert isinstance(light, ShapeLight)
    assert light.emission.ravel() == pytest.approx([12, 6, 3])
    corner = light.world_from_here @ np.array([1, 1, 0, 1])
    assert np.abs(corner[:3]) == pytest.approx([1.0, 0.25, 0])  # half the size, metres
    assert light.world_from_here[:3, 2] @ np.array([0, 0, -1.0]) > 0  # towards -z
    # Normalised: divided by the area in the units of the stage.
    (light,) = _lights(tmp_path, text.replace("NORMALIZE", "bool inputs:normalize = 1"))
    assert isinstance(light, ShapeLight)
    assert light.emission.ravel() == pytest.approx(np.array([12, 6, 3]) / (200 * 50))


def test_sphere_and_disk_areas(tmp_path: Path) -> None:
    text = """def {kind} "a" {{
    float inputs:radius = 3
    bool inputs:normalize = 1
    float inputs:intensity = 1
    double3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}}
"""
    for kind, area in (("SphereLight", 4 * math.pi * 36), ("DiskLight", math.pi * 36)):
        (light,) = _lights(tmp_path, text.format(kind=kind))
        assert isinstance(light, ShapeLight)
        assert light.emission.ravel() == pytest.approx([1 / area] * 3)


def test_distant_light_is_irradiance_when_normalised(tmp_path: Path) -> None:
    text = """def DistantLight "a" {{
    float inputs:angle = 10
    float inputs:intensity = 5
    bool inputs:normalize = {normalize}
}}
"""
    (light,) = _lights(tmp_path, text.format(normalize=1))
    assert isinstance(light, DistantLight)
    assert light.irradiance == pytest.approx([5, 5, 5])
    assert light.towards == pytest.approx([0, 0, -1])
    (light,) = _lights(tmp_path, text.format(normalize=0))
    assert isinstance(light, DistantLight)
    assert light.irradiance == pytest.approx([5 * math.pi * math.sin(math.radians(5)) ** 2] * 3)


def test_dome_with_a_picture(tmp_path: Path) -> None:
    write_exr(tmp_path / "sky.exr", np.full((2, 4, 3), 0.5, np.float32))
    text = (
        'def DomeLight "a" { asset inputs:texture:file = @sky.exr@\nfloat inputs:intensity = 3\n}\n'
    )
    (light,) = _lights(tmp_path, text.replace("{ ", "{\n"))
    assert isinstance(light, SkyLight)
    assert light.image == pytest.approx(np.full((2, 4, 3), 1.5))
    assert light.world_from_here == pytest.approx(np.eye(3))


def test_a_radiance_picture_is_divided_by_the_exposure_that_it_states(tmp_path: Path) -> None:
    """Pixels of 2, which were doubled twice."""
    file = tmp_path / "sky.hdr"
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nEXPOSURE=2\n\n-Y 2 +X 4\n"
    file.write_bytes(head + bytes([128, 128, 128, 130]) * 8)
    _, (light,) = _light_of_file(file, "Y", ())
    assert isinstance(light, SkyLight)
    assert light.image == pytest.approx(np.full((2, 4, 3), 0.5), rel=0.01)


def test_a_radiance_picture_has_the_primaries_that_it_states(tmp_path: Path) -> None:
    """Display P3's green, which BT.709's three make of less red and blue than nothing."""
    file = tmp_path / "sky.hdr"
    primaries = b"PRIMARIES=0.68 0.32 0.265 0.69 0.15 0.06 0.3127 0.329\n"
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n" + primaries + b"\n-Y 2 +X 4\n"
    file.write_bytes(head + bytes([64, 128, 64, 129]) * 8)
    _, (light,) = _light_of_file(file, "Y", ())
    assert isinstance(light, SkyLight)
    # Half white and half green: P3's green in BT.709 is -0.2249, 1.0421, -0.0786.
    expected = 0.5 + 0.5 * np.array([-0.2249, 1.0421, -0.0786])
    assert light.image[0, 0] == pytest.approx(expected, rel=0.02)
    found = environment_from_file(file, "Y").image
    assert found[0, 0] == pytest.approx(expected, rel=0.02)


def test_dark_hidden_and_inactive_lights_are_none(tmp_path: Path) -> None:
    text = """def SphereLight "dark" {
    float inputs:intensity = 0
}
def SphereLight "hidden" {
    token visibility = "invisible"
}
def SphereLight "off" (active = false) {
}
"""
    assert _lights(tmp_path, text) == ()


def test_captured_emitters_are_switched_off_unless_kept() -> None:
    lamp, floor = cube(material(0.0, emission=5.0)), plate(material(0.3), z=-2)
    captured = RelitScene(surfaces=(lamp, floor), lights=())
    sky = SkyLight(image=constant_map(1.0), world_from_here=np.eye(3))
    dark = lit_by_others(captured, [], [sky], keep_emitters=False)
    assert not any(surface.material.emits for surface in dark.surfaces)
    # Nobody measured what a lamp reflects: it is not black then.
    assert dark.surfaces[0].material.diffuse.ravel() == pytest.approx([UNKNOWN_DIFFUSE] * 3)
    both = lit_by_others(captured, [], [sky], keep_emitters=True)
    assert both.surfaces[0].material.emits
    assert both.lights == (sky,)


def test_a_glowing_mesh_replaces_the_object_where_it_stands_and_matte_ones_stay_out() -> None:
    panel, floor = cube(material(0.4)), plate(material(0.3), z=-2)
    captured = RelitScene(surfaces=(panel, floor), lights=())
    same = replace(panel, material=material(0.0, emission=2.0))
    elsewhere = same.moved(np.array([[1.0, 0, 0, 3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    matte = cube(material(0.9), side=5.0)
    found = lit_by_others(captured, [same, elsewhere, matte], [], keep_emitters=False)
    assert found.surfaces == (floor, same, elsewhere)
