"""What a sample counts for, and what it is relative to, against numbers reckoned by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.progress import set_quiet
from usdbrdf.material import refined_means
from usdbrdf.material.refined_irradiance import Lobes
from usdbrdf.material.refined_means import (
    _let_through,
    bytes_of_refining,
    level_of,
    light_of,
    subsample,
    texels_at_once,
)
from usdbrdf.texturing.passes import BytesPerTexel
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.let_through import share_let_through


@pytest.fixture(scope="module")
def world() -> World:
    """Two squares of a metre, one texel each, that look up."""
    return world_of([quad((x, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1)) for x in (0, 3)])


def grey(*values: float) -> Any:
    return np.repeat(np.array(values, np.float32)[:, None], 3, axis=1)


def test_samples_are_relative_to_what_is_seen_and_at_least_to_a_thousandth_of_the_median():
    lit = np.array([[0, 1, 2], [3, 6, 9], [0, 0, 0], [4, 4, 4], [0, 0, 0.003]], np.float32)
    # Their means are 1, 6, 0, 4, 0.001, the median of these 1.
    np.testing.assert_allclose(level_of(lit), [1, 6, 0.001, 4, 0.001])
    np.testing.assert_allclose(level_of(np.zeros((3, 3), np.float32)), 1e-30)


def test_light_is_what_was_traced_but_on_nothing_less_than_a_thousandth_of_the_median():
    irradiance = np.array([[1, 2, 3], [0, 0.001, 8], [4, 0, 4], [0, 0, 0]], np.float32)
    # The median is of the texels' means, which are 2, 8.001 / 3, 8 / 3 and 0.
    least = 0.001 * (2 + 8 / 3) / 2
    found = light_of(SimpleNamespace(irradiance=irradiance))  # type: ignore[arg-type]
    np.testing.assert_allclose(found, np.maximum(irradiance, least), rtol=1e-6)
    assert found.dtype == np.float32
    dark = SimpleNamespace(irradiance=np.zeros((4, 3), np.float32))
    np.testing.assert_array_equal(light_of(dark), 1)  # type: ignore[arg-type]


def test_of_texels_seen_by_four_and_twenty_frames_none_is_left_out():
    texel = np.arange(4000, dtype=np.int32)
    assert subsample(texel, np.full(4000, 24, np.float32), 0, 0).all()
    more = subsample(texel, np.full(4000, 25, np.float32), 0, 0)
    # 24 of 25, within four deviations.
    assert abs(np.count_nonzero(~more) - 160) < 50
    # Other frames and other seeds choose others, as do one more of either.
    half = np.full(4000, 48, np.float32)
    chosen = [subsample(texel, half, *told) for told in ((3, 1), (4, 1), (3, 2), (4, 0))]
    assert (chosen[0] != chosen[1]).any()
    assert np.array_equal(chosen[0], chosen[3])
    assert np.array_equal(chosen[1], chosen[2])


def test_dielectrics_let_light_through_by_the_angle_that_is_seen_of_them(world: World):
    lit = replace(world.lit(world.per_object([(1, 1, 1), (1, 1, 1)])), lobe=DIELECTRIC)
    one, other = lit.texels.position.astype(np.float64)
    np.testing.assert_allclose(other - one, [3, 0, 0], atol=1e-6)
    phi, psi = np.float32([0.3, 0.3]), grey(0.8, 0.8)
    plain, texel = Lobes(phi, psi, np.zeros(2, bool)), np.int32([0, 1])
    # Four up, straight above either and so three to the side of the other.
    up = np.array((0, 0, 4.0))
    for eye, cosine in ((other + up, (0.8, 1.0)), (one + up, (1.0, 0.8))):
        wanted = share_let_through(phi, psi, np.array(cosine))
        found = _let_through(lit, plain, texel, eye)
        np.testing.assert_allclose(found, wanted, rtol=1e-5)
        assert abs(found[0] / found[1] - 1) > 1e-3
    # Along the face, and below it, as at the lowest angle that samples are taken at.
    lowest = share_let_through(phi, psi, np.full(2, refined_means.MIN_COSINE))
    for eye in ((9.0, 0.5, 0.001), (9.0, 0.5, -3.0)):
        np.testing.assert_allclose(_let_through(lit, plain, texel, np.array(eye)), lowest)
    metal = Lobes(phi, psi, np.array([True, False]))
    found = _let_through(lit, metal, texel, np.array((9.0, 0.5, 0.001)))
    np.testing.assert_allclose(found, [1, lowest[1]])
    # The rows of a texel that is named alone are its own.
    alone = _let_through(lit, plain.take(texel[1:]), texel[1:], other + up)
    np.testing.assert_allclose(alone, share_let_through(phi[:1], psi[:1], np.ones(1)), rtol=1e-5)


def test_lobes_that_are_no_dielectrics_let_all_through(world: World):
    lit = replace(world.lit(world.per_object([(1, 1, 1), (1, 1, 1)])), lobe=PAPER)
    lobes = Lobes(np.float32([0.3, 0.3]), grey(0.8, 0.8), np.zeros(2, bool))
    found = _let_through(lit, lobes, np.int32([1, 0, 1]), np.array((3.0, 0.5, 0.1)))
    np.testing.assert_array_equal(found, [1, 1, 1])


def test_each_lighting_takes_its_own_maps_and_one_light_lies_beside_them(world: World):
    lit = world.lit(world.per_object([(1, 1, 1), (1, 1, 1)]))
    sizes = lit.radiance.pixels.nbytes, lit.radiance.faces.nbytes, lit.emission.pixels.nbytes
    assert min(sizes) > 0
    for count in (1, 2, 3):
        need = bytes_of_refining([lit] * count)
        light = count * sum(sizes) + sizes[0]
        assert need.always == 24 * count + light // 2  # two texels
        assert need[:3] == (202, 40, 218)


def test_where_memory_is_short_the_smallest_groups_are_taken_and_one_is_told(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    lit, need = world.lit(world.per_object([(1, 1, 1), (1, 1, 1)])), BytesPerTexel(1, 1, 1)
    asked: list[tuple[Any, ...]] = []

    def short(*of: Any) -> list[slice]:
        asked.append(of)
        raise EnvironmentFailure("room: too small. Buy more.")

    monkeypatch.setattr(refined_means, "groups_of_texels", short)
    monkeypatch.setattr(refined_means, "smallest_groups", lambda texels: [slice(0, len(texels))])
    frames: Any = object()
    set_quiet(False)
    assert texels_at_once(lit, frames, 0.5, need) == [slice(0, 2)]
    assert "room: too small. Buy more." in capsys.readouterr().err
    assert texels_at_once(lit, frames, 0.5, need, warns=False) == [slice(0, 2)]
    assert not capsys.readouterr().err
    set_quiet(True)
    assert asked == [(lit.texels, lit.scene, frames, 0.5, need)] * 2
