"""What single texels tell without their lobes, and what patterns are told of: surfaces without any
contrast, on which blurring and restoring change nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.material import refine
from usdbrdf.material.refine import _diffuse_of_means, _reflection, _Told, _with_hidden
from usdbrdf.material.refined_irradiance import Lobes
from usdbrdf.material.refined_means import Lighting
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading.base_color import Reflection
from usdbrdf.texturing.robust_mean import RobustMean

SIDE = 12
PLAIN, METAL, LAMP, CLIPS, DARK = range(5)
# L_d as it was seen, and what is left of it without lobes, relative to it.
LIT = np.array([0.5, 0.4, 20.0, 9.0, 1e-5])
LEFT = np.array([0.8, 0.7, 0.6, np.nan, np.nan])
VARIANCE = np.array([0.04, 0.01, 0.01, 0.0, 0.0])
UNEVEN = np.array([1.2, 1.0, 1.0, 1.0, 1.0])
FOOTPRINT = np.float32([1.5, 0.2, 0.8])


@pytest.fixture(scope="module")
def world() -> World:
    return world_of([quad((2 * k, 0, 0), (1, 0, 0), (0, 1, 0), (SIDE, SIDE)) for k in range(5)])


def _grey(values: Any) -> Any:
    return np.repeat(np.asarray(values, np.float32)[:, None], 3, axis=1)


def _lobes(world: World) -> Lobes:
    return Lobes(np.full(5, 0.3, np.float32), _grey(np.full(5, 0.5)), np.arange(5) == METAL)


def _before(world: World, irradiance: Any = None) -> Any:
    owner = world.texels.object_index()
    count = len(owner)
    return SimpleNamespace(
        lit=_grey(LIT[owner]),
        emission=_grey(np.where(owner == LAMP, 25.0, 0.0)),
        emissive=owner == LAMP,
        coverage=CoverageMap.of(owner != CLIPS, owner == CLIPS),
        irradiance=_grey(np.full(count, 2.0)) if irradiance is None else irradiance,
        samples=np.where(owner == PLAIN, 30, 6).astype(np.float32),
    )


def _means(world: World) -> RobustMean:
    owner = world.texels.object_index()
    return RobustMean(
        _grey(LEFT[owner]), VARIANCE[owner].astype(np.float32), np.tile(FOOTPRINT, (len(owner), 1)),
        _grey(UNEVEN[owner]),
    )  # fmt: skip


def _of_objects(world: World, values: Any) -> Any:
    """What an object's texels, which are all alike, have in common."""
    owner = world.texels.object_index()
    first = np.array([values[owner == k][0] for k in range(5)])
    np.testing.assert_allclose(values, first[owner], rtol=1e-5)
    return first


def test_what_each_kind_of_surface_shows_without_its_lobe(world: World):
    lighting = Lighting("", world.lit(_grey(np.ones(len(world.texels)))), _before(world), range(1))
    told = _diffuse_of_means(lighting, _means(world), _lobes(world))
    mixed, own = (_of_objects(world, part) for part in (told.diffuse, told.in_own_light))
    # The plain one with what its pixels mix; metal without a diffuse part; the lamp as it shines;
    # what clips at least as bright as seen; and of what is too dark there is nothing to take off.
    np.testing.assert_allclose(mixed, _grey([0.5 * 0.8 * 1.2, 0, 25, 9, 1e-5]), rtol=1e-4)
    np.testing.assert_allclose(own, _grey([0.5 * 0.8, 0, 25, 9, 1e-5]), rtol=1e-4)
    error = _of_objects(world, np.where(np.isinf(told.error), 1e9, told.error))
    np.testing.assert_allclose(error, [0.2 / 0.8, 0.1 / 0.7, 1e9, 1e9, 1e9], rtol=1e-5)
    assert told.error.dtype == told.diffuse.dtype == np.float32


def test_errors_are_relative_to_a_thousandth_at_least_and_nothing_is_darker_than_black(
    world: World,
):
    lighting = Lighting("", world.lit(_grey(np.ones(len(world.texels)))), _before(world), range(1))
    means = _means(world)
    plain = world.texels.object_index() == PLAIN
    for left in (5e-4, -0.3):
        means.mean[plain] = left
        told = _diffuse_of_means(lighting, means, _lobes(world))
        np.testing.assert_allclose(told.error[plain], 0.2 / 1e-3, rtol=1e-5)
        wanted = max(left, 0) * 0.5
        np.testing.assert_allclose(told.in_own_light[plain], wanted, rtol=1e-4, atol=1e-9)


def test_in_its_own_light_a_plain_surface_stays_plain_however_unevenly_it_is_lit(world: World):
    """What it shows goes by S, which pixels did not blur."""
    light = _grey(1 + 3 * np.random.default_rng(2).random(len(world.texels)))
    before = _before(world, light)
    before.lit = 0.25 * light
    lighting = Lighting("", world.lit(light), before, range(1))
    means = _means(world)
    plain = world.texels.object_index() == PLAIN
    told = _diffuse_of_means(lighting, means, _lobes(world))
    np.testing.assert_allclose(told.in_own_light[plain], (0.8 * 0.25 * light)[plain], rtol=1e-4)


def test_what_is_known_of_reflection_is_told_with_the_least_that_clipped(world: World):
    before = _before(world)
    before.lit = before.lit * np.float32([1, 0.5, 2])
    told = _Told(before.lit + 1, before.lit + 2, np.arange(len(world.texels), dtype=np.float32))
    lighting = Lighting("", world.lit(before.lit), before, range(1))
    incoming = before.lit + 7
    found = _reflection(lighting, told, incoming)
    assert found.radiance is told.in_own_light
    assert found.irradiance is incoming
    assert found.error is told.error
    np.testing.assert_array_equal(found.emissive, before.emissive)
    np.testing.assert_array_equal(found.known, before.coverage.observed)
    clips = world.texels.object_index() == CLIPS
    np.testing.assert_allclose(found.bound, np.where(clips, 4.5, 0))


def test_what_nobody_measured_sends_what_it_reflects_but_where_it_leaks():
    """Measured; clipped; shining unseen; and unseen, twice beside seen ones."""
    known = np.array([True, True, False, False, False, False])
    bound = np.array([0, 3.0, 0, 0, 0, 0])
    emissive = np.array([False, False, True, False, False, False])
    irradiance, base_color = _grey(np.full(6, np.pi)), _grey([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    sent = _grey([10, 20, 30, 40, 0.02, 0.21])
    one = Reflection(sent, irradiance, np.zeros(6, np.float32), known, emissive, bound)
    beside = np.array([False, False, False, False, True, True])
    found = _with_hidden(base_color, one, sent, beside)
    # The last but one would be 25 times as bright as what is filled in there.
    np.testing.assert_allclose(found, _grey([10, 0.8, 30, 0.6, 0.02, 0.4]), rtol=1e-6)


def test_patterns_are_told_of_what_is_measured_by_the_variance_of_single_samples(
    world: World, monkeypatch: pytest.MonkeyPatch
):
    """Of at most 24 of them; not of lamps and metals."""
    given: list[Any] = []
    groups = [slice(0, 7), slice(7, 9)]

    def at_once(lit: Any, frames: Any, memory: float, need: Any, *, warns: bool) -> Any:
        given.append((lit, frames, memory, need, warns))
        return groups

    def patterns(surface: Any, footprint: Any, steps_by: Any) -> str:
        given.append((surface, footprint))
        steps_by("level")
        return "with patterns"

    monkeypatch.setattr(refine, "texels_at_once", at_once)
    monkeypatch.setattr(refine, "with_patterns", patterns)
    monkeypatch.setattr(refine, "in_passes", lambda *told: given.append(told))
    before, means = _before(world), _means(world)
    diffuse = before.lit * np.float32(0.8)
    lit = world.lit(before.lit)
    frames = SimpleNamespace(at=lambda own: ("frames", own))
    reader: Any = SimpleNamespace(frames=frames)
    lighting, run = Lighting("", lit, before, range(3, 5)), SimpleNamespace(name="fit")
    found = refine._with_patterns(
        run,
        lighting,
        reader,
        _lobes(world),
        diffuse,
        means,
        0.5,
        9,  # type: ignore[arg-type]
    )
    assert found == "with patterns"
    asked, (surface, footprint), (its_run, name, its, _) = given
    its_lit, its_frames, memory, need, warns = asked
    assert (its_lit, its_frames, memory, warns) == (lit, ("frames", range(3, 5)), 0.5, False)
    assert (its_run, name, its) == (run, "patterns", groups)
    assert footprint is means.footprint
    assert surface.values is diffuse
    owner = world.texels.object_index()
    np.testing.assert_array_equal(surface.object, owner)
    # A single sample's: that of the mean, in the square of L_d, times how many there were.
    wanted = np.array([0.04 * 0.5**2 * 24, 0, 0, 0, 0])
    np.testing.assert_allclose(_of_objects(world, surface.variance), wanted, rtol=1e-3)
    # Each place of the atlases that a known texel covers has its number.
    number = np.full(len(owner), -1)
    number[owner == PLAIN] = np.flatnonzero(owner == PLAIN)
    np.testing.assert_array_equal(surface.own[world.texels.pixel], number)
    # Rows beside a group, above and below, count in the memory of each of its texels.
    rows = 2 * refine.ROWS_BESIDE * SIDE
    of_rows = refine.BYTES_OF_EQUATIONS * min(rows, len(owner)) // len(owner)
    assert need.always == 44 + of_rows
    assert (need.grouped, need.result) == (refine.BYTES_OF_EQUATIONS, 28)
    assert (need.after, need.pixel) == (60, 450)
