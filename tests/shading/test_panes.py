"""Panes are known by what shows through them, and light passes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import quad, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.files.images import write_exr
from usdbrdf.job.task import TaskRun
from usdbrdf.material.refined_irradiance import Lobes, let_through_surfaces, refined_irradiance
from usdbrdf.model.texels import Coverage, CoverageMap
from usdbrdf.shading.asked import Shining, irradiance_of_texels
from usdbrdf.shading.panes import Through, beside_panes, find_panes, what_shows_through
from usdbrdf.shading.surroundings import surroundings_from_frames
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.environment import Environment, black_environment, directions_of_pixels
from usdbrdf.transport.lit_scene import TexturedScene, lit_scene

FLOOR, CEILING, PANE = 0, 1, 2
HEIGHT = 0.6  # of the pane, metres
# Of what is behind it, a clear and a tinted pane let this through.
TINT = np.array([0.9, 0.7, 0.4])


def _pattern(position, seed):
    """Radiance (R, 3) of patterns some decimetres wide, from 0.1 to 1.6."""
    waves = np.random.default_rng(seed).normal(0, 7, (5, 2))
    phase = np.sin(position[:, :2] @ waves.T + np.arange(5)).sum(axis=1)
    return np.exp(0.6 * np.clip(phase, -2, 2))[:, None] * np.array([0.5, 0.4, 0.3])


def _sky(direction):
    across = np.sin(9 * direction[:, 0] + 2) + np.sin(11 * direction[:, 1] + 7 * direction[:, 0])
    return np.exp(0.5 * across)[:, None] * np.array([3.0, 4.0, 5.0])


def _world(floor=True):
    """A pane between floor and ceiling; the floor may lie beside it only."""
    place = (-2.0, -2.0, 0.0) if floor else (5.0, -2.0, 0.0)
    parts = [
        quad(place, (4, 0, 0), (0, 4, 0), (160, 160)),
        quad((-3, -3, 2.5), (0, 6, 0), (6, 0, 0), (160, 160)),
        quad((-0.7, -0.7, HEIGHT), (1.4, 0, 0), (0, 1.4, 0), (80, 80)),
    ]
    world = world_of(parts)
    surface = TexturedScene(world.scene, world.texels, world.rays)
    owner, position = world.texels.object_index(), world.texels.position
    lit = np.where((owner == FLOOR)[:, None], _pattern(position, 1), _pattern(position, 2))
    kind = np.where(owner == PANE, np.int8(Coverage.FILLED), np.int8(Coverage.MEASURED))
    return surface, lit.astype(np.float32), CoverageMap(kind)


def _photographed(folder, shown, count, floor=True):
    """Frames that show on the pane what ``shown`` says of rays' points on it and directions."""
    eyes = [
        np.array([0.5 * np.cos(2.4 * i), 0.5 * np.sin(2.4 * i), 1.7 + 0.05 * i])
        for i in range(count)
    ]
    frames = frames_at([look_at(eye, np.array([0.05, 0.02, 0.0])) for eye in eyes], size=128)
    frames = replace(
        frames,
        image_paths=tuple(folder / f"{i}.exr" for i in range(count)),
        saturation_radiance=np.full(count, 100.0),
    )
    for i, path in enumerate(frames.image_paths):
        origin, towards = frames.camera(i).rays(frames.camera(i).pixels())
        on_floor, on_pane = (
            origin + towards * ((height - origin[:, 2]) / towards[:, 2])[:, None]
            for height in (0.0, HEIGHT)
        )
        picture = _pattern(on_floor, 1) if floor else _sky(towards)
        inside = (np.abs(on_pane[:, :2]) < 0.7).all(axis=1)
        picture[inside] = shown(on_pane[inside], towards[inside])
        write_exr(path, picture.reshape(128, 128, 3).astype(np.float32))
    return frames


def _mirrored(on_pane, towards):
    """The ceiling, in a flat mirror."""
    up = towards * [1, 1, -1]
    return _pattern(on_pane + up * ((2.5 - HEIGHT) / up[:, 2:]), 2)


SHOWN = {
    "tinted pane": (lambda p, d: TINT * _sky(d), True),
    "pane that mirrors": (lambda p, d: _sky(d) + 0.08 * _mirrored(p, d), True),
    "metal that shines alike": (lambda p, d: 0.06 * _sky(d), False),
    "textured board": (lambda p, d: 9 * _pattern(p, 3), False),
    "plain board": (lambda p, d: np.full((len(p), 3), 9.0), False),
    "mirror": (_mirrored, False),
    "glossy board": (lambda p, d: 9 * _pattern(p, 3) + 3 * _mirrored(p, d), False),
}


@pytest.mark.parametrize("what", SHOWN)
def test_a_pane_is_known_from_a_few_frames_by_what_is_outside(tmp_path, what):
    shown, is_pane = SHOWN[what]
    surface, lit, coverage = _world(floor=False)
    frames = _photographed(tmp_path, shown, count=5, floor=False)
    told = what_shows_through(surface, lit, coverage, frames, True)[PANE]
    assert told.is_pane == is_pane, told
    if is_pane or "alike" in what:
        assert told.slope > 0.5, told
    run = TaskRun(tmp_path, "shade", tmp_path / "work")
    found = find_panes(run, surface, lit, coverage, frames, True)
    assert found == ((PANE,) if is_pane else ())


@pytest.mark.parametrize(
    ("slope", "error", "explained", "mirrored", "above", "is_pane"),
    [
        (0.47, 0.13, 0.32, 0.05, 1.9, True),  # few frames show the outside, and roughly
        (0.47, 0.2, 0.32, 0.05, 1.9, False),  # it may be by chance
        (0.09, 0.01, 0.05, 0.0, 0.7, False),  # clear, but of no pane
        (0.7, 0.06, 0.63, 0.51, 0.5, False),  # a dark front, in which the window is seen
        (0.47, 0.13, 0.32, 0.05, 0.1, False),  # no brighter than it would mirror
    ],
)
def test_a_pane_follows_what_is_behind_it_beyond_chance(
    slope, error, explained, mirrored, above, is_pane
):
    assert Through(slope, error, explained, mirrored, above).is_pane == is_pane


def test_frames_show_the_sky_through_a_pane(tmp_path):
    surface, _, _ = _world(floor=False)
    frames = _photographed(tmp_path, lambda p, d: _sky(d), count=8, floor=False)
    seen = surroundings_from_frames(replace(surface, panes=(PANE,)).light_rays, frames, True)
    before = surroundings_from_frames(surface.rays, frames, True)
    through = seen.coverage.measured & ~before.coverage.observed
    assert through.sum() > 500
    rows = directions_of_pixels(256, 512, True).reshape(-1, 3)[through]
    np.testing.assert_allclose(seen.radiance[through], _sky(rows), rtol=0.1)


def test_light_passes_a_pane_as_if_it_was_not_there():
    """Under a sky brighter on one side, a pane over a floor that is lit by nothing else."""
    floor = quad((-2, -2, 0), (4, 0, 0), (0, 4, 0), (24, 24))
    side = quad((2, -2, 0), (0, 4, 0), (0, 0, 1.5), (24, 8))
    pane = quad((-1.5, -1.5, 0.5), (3, 0, 0), (0, 3, 0), (24, 24))
    up = directions_of_pixels(64, 128, True)
    sky = Environment((1 + np.clip(up[..., :1], 0, 1) * [3.0, 2.0, 1.0]).astype(np.float32), True)
    index = np.arange(24 * 24)

    def irradiance(parts, panes=(), shown=0.0):
        world = world_of(parts)
        surface = TexturedScene(world.scene, world.texels, world.rays, panes)
        owner = world.texels.object_index()
        lit = np.where((owner == 2)[:, None], np.float32(shown), np.float32(0.2))
        lit = np.repeat(lit, 3, axis=1)
        lit, coverage = beside_panes(surface, lit, CoverageMap.of(owner >= 0, owner < 0))
        assert coverage.measured[owner != 2].all()
        assert not coverage.shown[surface.of_panes()].any()
        shining = Shining.of(surface, lit, sky)
        return irradiance_of_texels(surface, shining, sky, index, 1)

    bare = irradiance([floor, side])
    passed = irradiance([floor, side, pane], (2,), shown=9.0)
    opaque = irradiance([floor, side, pane])
    error = np.abs(passed / bare - 1)
    assert np.median(error) < 0.02
    assert passed.sum() == pytest.approx(bare.sum(), rel=0.005)
    assert opaque.sum() < 0.7 * bare.sum()


def test_panes_are_no_lights_whatever_they_are_taken_to_send(tmp_path):
    """What hides is taken to reflect the sky above it, and refining is told what frames saw."""
    floor = quad((-2, -2, 0), (4, 0, 0), (0, 4, 0), (24, 24))
    pane = quad((-0.7, -0.7, 0.5), (0, 1.4, 0), (1.4, 0, 0), (8, 8))
    world, index = world_of([floor, pane]), np.arange(24 * 24)
    shown = np.zeros((len(world.texels), 3), np.float32)
    shown[24 * 24 :] = 9.0
    lobes = Lobes(np.full(2, 0.3, np.float32), np.full((2, 3), 0.3, np.float32), np.zeros(2, bool))

    def received(panes):
        surface = TexturedScene(world.scene, world.texels, world.rays, panes)
        dark, run = black_environment(), TaskRun(tmp_path, "fit", tmp_path / f"work{len(panes)}")
        lit = lit_scene(surface, 0 * shown, np.zeros(len(shown), np.bool_), dark)
        lit = replace(lit, lobe=DIELECTRIC)
        traced = irradiance_of_texels(surface, Shining.of(surface, shown, dark), dark, index, 1)
        refined = refined_irradiance(run, lit, 0 * shown, shown, lobes, "none", 0)
        through = let_through_surfaces(run, lit, shown, lobes, 0)
        return [np.abs(one[index]).sum() for one in (traced, refined, through)]

    assert min(received(())) > 0
    assert max(received((1,))) == 0


def test_the_tree_without_panes_is_built_once_however_often_a_scene_is_changed():
    surface, _, _ = _world()
    assert surface.light_rays is surface.rays
    without = replace(surface, panes=(PANE,))
    assert without.light_rays is replace(without).light_rays
    assert without.light_rays is not replace(surface, panes=(CEILING,)).light_rays
