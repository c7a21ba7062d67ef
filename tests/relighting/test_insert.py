"""Placing models: by numbers, and by letting them fall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.relighting.scenes import MATTE, cube, looking, material, photograph, plate
from usdbrdf.asset.readers.render_scene import RenderScene
from usdbrdf.errors import UsageError
from usdbrdf.model.light import SkyLight
from usdbrdf.model.material import constant_map, preview_material, with_corner_colours
from usdbrdf.options import Insert
from usdbrdf.relighting.relit_scene import placed, with_material
from usdbrdf.relighting.render import VARIANTS, mitsuba_variant

_STUFF = material()


def _fallen(*scene: Any, up_axis: str = "Z", side: float = 1.0, **how: Any) -> np.ndarray:
    """Bounds (2, 3) of a cube that was let fall."""
    (found,) = placed(
        [cube(_STUFF, side=side)],
        Insert(model=Path("cube.obj"), **how),
        RenderScene(surfaces=(), lights=(), up_axis=up_axis, metres_per_unit=1.0),
        scene,
        2.0,
    )
    return found.bounds


def _shelf(half: float, z: float) -> Any:
    return plate(_STUFF, half=half, z=z)


def test_a_cube_rests_exactly_on_the_floor() -> None:
    low, high = _fallen(plate(_STUFF), drop=(3.0, -2.0))
    assert low == pytest.approx([2.5, -2.5, 0.0], abs=1e-5)
    assert high == pytest.approx([3.5, -1.5, 1.0], abs=1e-5)


def test_what_is_smaller_than_the_model_holds_it_too() -> None:
    # A pedestal under its middle, which no corner of the cube would meet.
    assert _fallen(plate(_STUFF), _shelf(0.1, 0.7), drop=(0, 0))[0][2] == pytest.approx(
        0.7, abs=1e-5
    )
    # One corner on a table: it rests on the table.
    table = _shelf(0.6, 0.4)
    assert _fallen(plate(_STUFF), table, drop=(1, 1))[0][2] == pytest.approx(0.4, abs=1e-5)


def test_it_falls_from_below_the_ceiling_and_from_where_it_is_told() -> None:
    room = (plate(_STUFF), _shelf(0.5, 1.0), _shelf(9.0, 2.5))
    assert _fallen(*room, drop=(0, 0))[0][2] == pytest.approx(1.0, abs=1e-5)
    assert _fallen(*room, drop=(0, 0, 0.9))[0][2] == pytest.approx(0.0, abs=1e-5)
    assert _fallen(*room, drop=(0, 0, 9))[0][2] == pytest.approx(2.5, abs=1e-5)


def test_in_a_y_up_world_it_falls_along_y() -> None:
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    floor = plate(_STUFF, z=0.25).moved(turn)  # now at y = 0.25
    low, _ = _fallen(floor, up_axis="Y", drop=(2.0, 5.0))
    assert low == pytest.approx([1.5, 0.25, 4.5], abs=1e-5)


def test_over_nothing_it_is_refused() -> None:
    with pytest.raises(UsageError, match="nothing lies below"):
        _fallen(_shelf(1.0, 0.0), drop=(7, 7))


def test_numbers_are_in_units_of_the_stage() -> None:
    (found,) = placed(
        [cube(_STUFF)],
        Insert(model=Path("a.ply"), at=(100.0, 0, 50), scale=0.5, rotate_deg=90),
        RenderScene(surfaces=(), lights=(), up_axis="Z", metres_per_unit=0.01),
        (),
        0.0,
    )
    assert found.bounds == pytest.approx(np.array([[0.75, -0.25, 0.25], [1.25, 0.25, 0.75]]))
    # Counter-clockwise from above: +x goes to +y.
    before, after = cube(_STUFF).points, found.points
    assert after[:, 1] == pytest.approx(0.5 * before[:, 0])


def test_what_is_said_about_the_material_replaces_the_models() -> None:
    given = Insert(model=Path("a.ply"), color=(0.1, 0.2, 0.3), roughness=0.25, ior=2.0)
    found = with_material(cube(_STUFF), given).material
    assert found.diffuse.ravel() == pytest.approx([0.1, 0.2, 0.3])
    assert found.f0.ravel() == pytest.approx([1 / 9] * 3)
    assert found.roughness.ravel() == pytest.approx([0.25])
    metal = Insert(model=Path("a.ply"), color=(0.9, 0.6, 0.2), metallic=1.0)
    found = with_material(cube(_STUFF), metal).material
    assert found.f0.ravel() == pytest.approx([0.9, 0.6, 0.2])
    assert not found.diffuse.any()


_GOLD = np.array([0.9, 0.6, 0.2], np.float32)


def _metal() -> Any:
    return preview_material(
        diffuse=constant_map(*_GOLD),
        metallic=constant_map(1.0)[..., :1],
        roughness=constant_map(0.3)[..., :1],
        emission=constant_map(0.0),
    )


def test_an_ior_alone_makes_a_dielectric_of_a_metal() -> None:
    found = with_material(cube(_metal()), Insert(model=Path("a.glb"), ior=1.5)).material
    assert found.diffuse.ravel() == pytest.approx(_GOLD)
    assert found.f0.ravel() == pytest.approx([0.04] * 3)


@pytest.mark.parametrize("given", [{"ior": 1.5}, {"metallic": 1.0}, {"metallic": 0.25}])
def test_colours_of_corners_stand_in_place_of_the_map(given: dict[str, float]) -> None:
    """Whoever multiplies the two, and whoever takes the corners' alone, has the same."""
    plain = cube(_metal())
    colours = np.tile(_GOLD / 2, (len(plain.triangles), 3, 1))
    coloured = with_corner_colours(plain, colours, 1.0, constant_map(0.04))
    found = with_material(coloured, Insert(model=Path("a.glb"), **given))
    assert found.material.diffuse.ravel() == pytest.approx([1, 1, 1])
    assert found.corner_colour is not None
    assert found.corner_colour == pytest.approx(colours * (1 - given.get("metallic", 0)))


def test_a_colour_alone_leaves_a_metal_a_metal() -> None:
    given = Insert(model=Path("a.glb"), color=(0.5, 0.6, 0.7))
    found = with_material(cube(_metal()), given).material
    assert not found.diffuse.any()
    assert found.f0.ravel() == pytest.approx([0.5, 0.6, 0.7])


@pytest.mark.parametrize("variant", VARIANTS)
def test_metal_takes_the_colours_of_the_corners(variant: str) -> None:
    mi = mitsuba_variant(variant)
    if mi.variant() != variant:
        pytest.skip("no usable LLVM library")
    stuff = replace(material(1.0), **MATTE)
    plain = plate(stuff)
    coloured = replace(plain, corner_colour=np.tile(_GOLD, (len(plain.triangles), 3, 1)))
    given = Insert(model=Path("a.ply"), metallic=1.0, roughness=0.1)
    found = with_material(coloured, given)
    assert found.corner_colour is not None
    assert found.corner_f0 is not None
    assert not found.corner_colour.any()
    assert found.corner_f0.reshape(-1, 3) == pytest.approx(np.tile(_GOLD, (6, 1)))
    # Under an even sky, seen from above, a smooth metal shows its colour.
    alike = with_material(plain, replace(given, color=tuple(float(c) for c in _GOLD)))
    sky = SkyLight(image=np.ones((2, 4, 3), np.float32), world_from_here=np.eye(3))
    eye = looking((0, 0, 2), (0, 0, 0))
    seen, one = (photograph(mi, [item], eye, lights=[sky]) for item in (found, alike))
    assert seen.mean(axis=(0, 1)) == pytest.approx(_GOLD, rel=0.1)
    assert seen == pytest.approx(one, rel=1e-3)
