"""The light that dielectrics scatter below their surface, where it grazes and where it does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.physics.surfaces import quad, room, world_of
from usdbrdf.job.task import TaskRun
from usdbrdf.material.refined_irradiance import Lobes, let_through_surfaces
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.environment import Environment, Sun
from usdbrdf.transport.let_through import share_let_through
from usdbrdf.transport.lit_scene import LitScene

RGB = np.array([1.0, 2.0, 3.0])


def _lobes(count: int, psi: float) -> Lobes:
    return Lobes(
        phi=np.full(count, 0.1, np.float32),
        psi=np.full((count, 3), psi, np.float32),
        conducts=np.zeros(count, np.bool_),
    )


def _differs(folder: Path, lit: LitScene, light: np.ndarray, lobes: Lobes) -> np.ndarray:
    run = TaskRun(folder, "fit", folder / "work")
    return let_through_surfaces(run, replace(lit, lobe=DIELECTRIC), light, lobes, seed=3)


def test_in_uniform_light_it_is_all_the_same(tmp_path: Path):
    world = world_of(room((0, 0, 0), (4, 3, 2.5)))
    light = world.per_object([tuple(RGB)] * 6)
    found = _differs(tmp_path, world.lit(light), light, _lobes(6, 0.5))
    relative = found / (np.pi * RGB)
    np.testing.assert_allclose(relative.mean(axis=0), 0, atol=0.003)
    assert np.abs(relative).max() < 0.03  # of 64 rays


@pytest.mark.parametrize("degrees", [0.0, 60.0, 80.0])
def test_a_small_lamp_counts_by_the_angle_of_its_light(tmp_path: Path, degrees: float):
    # A square of 0.2 that looks at the floor's middle from 5 away.
    angle = np.radians(degrees)
    towards = np.array([np.sin(angle), 0, np.cos(angle)])
    right, up = np.array([0.0, 0.2, 0]), 0.2 * np.array([np.cos(angle), 0, -np.sin(angle)])
    lamp = quad(5 * towards - (right + up) / 2, right, up)
    # Beside much that is dark: it is bright surfaces that rays are sent to.
    dark = quad((-9, -9, -1), (18, 0, 0), (0, 18, 0))
    world = world_of([quad((-0.05, -0.05, 0), (0.1, 0, 0), (0, 0.1, 0)), lamp, dark])
    light = world.per_object([(0, 0, 0), tuple(100 * RGB), (0, 0, 0)])
    lobes = _lobes(3, 0.5)
    floor = world.texels.object_index() == 0
    found = _differs(tmp_path, world.lit(light), light, lobes)[floor].mean(axis=0)
    solid_angle = 0.04 / 25
    share = share_let_through(lobes.phi[:1], lobes.psi[:1], np.cos([angle]))
    expected = 100 * RGB * solid_angle * np.cos(angle) * (share - 1)
    np.testing.assert_allclose(found, expected, rtol=0.02)
    assert (expected > 0).all() == (degrees == 0)


def test_the_sun_counts_by_its_angle(tmp_path: Path):
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))])
    sun = Sun(np.array([np.sin(1.3), 0, np.cos(1.3)]), RGB)
    sky = Environment(np.zeros((2, 4, 3), np.float32), z_up=True).under(sun)
    black, lobes = world.per_object([(0, 0, 0)]), _lobes(1, 0.8)
    found = _differs(tmp_path, world.lit(black, environment=sky), black, lobes)
    share = share_let_through(lobes.phi, lobes.psi, np.cos([1.3]))
    expected = np.tile(RGB * np.cos(1.3) * (share - 1), (len(found), 1))
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.parametrize(("kind", "psi"), [(PAPER, 0.5), (DIELECTRIC, 0.0)])
def test_where_nothing_is_kept_nothing_is_traced(tmp_path: Path, monkeypatch, kind, psi):
    world = world_of(room((0, 0, 0), (4, 3, 2.5)))
    light = world.per_object([tuple(RGB)] * 6)
    monkeypatch.setattr(f"{let_through_surfaces.__module__}.irradiance_at", None)
    run, lit = TaskRun(tmp_path, "fit", tmp_path / "work"), replace(world.lit(light), lobe=kind)
    assert not let_through_surfaces(run, lit, light, _lobes(6, psi), seed=3).any()
