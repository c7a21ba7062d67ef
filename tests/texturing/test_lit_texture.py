"""What becomes of what was measured: fills, bounds, and what a person is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.errors import InputRefused
from usdbrdf.model.texels import CoverageMap
from usdbrdf.texturing.lit_texture import LitTexture, _filled_in
from usdbrdf.texturing.observe import Measured

OWN = 64


@pytest.fixture(scope="module")
def trio() -> World:
    """Three squares beside each other, 64 texels of 1 / 64 m^2 each."""
    return world_of([quad((i, 0, 0), (1, 0, 0), (0, 1, 0)) for i in range(3)])


def _measured(count, clipped, median=None, bound=None) -> Measured:
    number = len(count)
    level = np.full((number, 3), 2.0, np.float32) if median is None else median
    return Measured(
        median=np.where(np.asarray(count)[:, None] > 0, level, np.nan),
        mean=np.where(np.asarray(count)[:, None] > 0, 3 * level, np.nan),
        spread=np.where(np.asarray(count)[:, None] > 0, [0.25] * 3, np.nan).astype(np.float32),
        count=np.asarray(count, np.int32),
        clipped=np.asarray(clipped, np.int32),
        lower_bound=np.zeros(number, np.float32) if bound is None else bound,
        glimpsed=np.zeros(number, bool),
        probes=np.zeros((0, 1), np.float32),
    )  # fmt: skip


def test_what_was_measured_stays_and_the_rest_takes_after_it(trio: World):
    count = np.zeros(3 * OWN, int)
    count[:OWN:2], count[2 * OWN] = 5, 1
    median = np.where(np.arange(3 * OWN)[:, None] < OWN, [0.1, 0.2, 0.4], [7.0, 8, 9])
    found = _filled_in(trio.texels, _measured(count, 0 * count, median.astype(np.float32)))
    np.testing.assert_allclose(found.lit[:OWN], median[:OWN], rtol=1e-5)
    np.testing.assert_allclose(found.mean[:OWN], 3 * median[:OWN], rtol=1e-5)
    np.testing.assert_allclose(found.lit[2 * OWN :], median[2 * OWN :], rtol=1e-5)
    assert found.samples.tolist() == count.tolist()
    np.testing.assert_array_equal(found.spread, np.where(count[:, None] > 0, [0.25] * 3, 0))
    assert found.coverage.measured.tolist() == (count > 0).tolist()
    assert not found.coverage.clipped.any()


def test_what_clips_in_every_frame_is_at_least_as_bright_as_that(trio: World):
    """Of an object that was measured it takes after what was, where that is brighter; one that
    only ever clipped is known by that alone."""
    count, clipped = np.zeros(3 * OWN, int), np.zeros(3 * OWN, int)
    count[: OWN // 2] = 3
    clipped[OWN // 4 : OWN] = 2  # some of it beside samples, which count
    clipped[2 * OWN : 2 * OWN + 40] = 4
    bound = np.where(np.arange(3 * OWN) % 2, 1.5, 6.0).astype(np.float32)
    found = _filled_in(trio.texels, _measured(count, clipped, bound=bound))
    np.testing.assert_allclose(found.lit[: OWN // 2], 2)
    wanted = np.maximum(2, bound[OWN // 2 : OWN, None])
    np.testing.assert_allclose(found.lit[OWN // 2 : OWN], np.tile(wanted, (1, 3)), rtol=1e-5)
    np.testing.assert_allclose(found.mean[:OWN], 6, rtol=1e-5)  # no bounds in what is filled in
    own = slice(2 * OWN, 2 * OWN + 40)
    np.testing.assert_allclose(found.lit[own], np.tile(bound[own, None], (1, 3)), rtol=1e-5)
    rest = found.lit[2 * OWN + 40 :]
    assert (rest > 1.49).all()
    assert (rest < 6.01).all()
    only = (count == 0) & (clipped > 0)
    assert found.coverage.clipped.tolist() == only.tolist()
    assert found.coverage.measured.tolist() == (count > 0).tolist()


def test_a_neighbours_pixels_are_no_bounds_of_an_object(trio: World):
    """A texel or two of many that clip: it takes after the scene, and they alone are bounded."""
    count, clipped = np.zeros(3 * OWN, int), np.zeros(3 * OWN, int)
    count[:OWN] = 3
    clipped[OWN] = 1
    bound = np.full(3 * OWN, 50, np.float32)
    found = _filled_in(trio.texels, _measured(count, clipped, bound=bound))
    np.testing.assert_allclose(found.lit[OWN], 50)
    np.testing.assert_allclose(found.lit[OWN + 1 : 2 * OWN], 2, rtol=1e-5)
    np.testing.assert_allclose(found.mean[OWN : 2 * OWN], 6, rtol=1e-5)


def test_a_thing_too_thin_to_be_measured_is_known_by_glimpses(trio: World):
    """The first is measured, and glimpsed beside that; the second only glimpsed, in part; the third
    clips, as a lamp does, with glimpses of its rim."""
    count, clipped = np.zeros(3 * OWN, int), np.zeros(3 * OWN, int)
    count[: OWN // 2], clipped[2 * OWN : 2 * OWN + 40] = 3, 2
    glimpsed = np.zeros(3 * OWN, bool)
    glimpsed[OWN // 2 : OWN + OWN // 4] = glimpsed[2 * OWN + 40 :] = True
    told = _measured(count, clipped, bound=np.where(clipped > 0, 9, 0).astype(np.float32))
    own = np.where(glimpsed[:, None], np.float32(0.5), told.median)
    told = replace(told, median=own, mean=np.where(glimpsed[:, None], own, told.mean))
    found = _filled_in(trio.texels, replace(told, glimpsed=glimpsed))
    np.testing.assert_allclose(found.lit[:OWN], 2, rtol=1e-5)
    np.testing.assert_allclose(found.lit[OWN : 2 * OWN], 0.5, rtol=1e-5)
    np.testing.assert_allclose(found.mean[OWN : 2 * OWN], 0.5, rtol=1e-5)
    np.testing.assert_allclose(found.lit[2 * OWN :], 9, rtol=1e-5)
    assert np.flatnonzero(found.coverage.glimpsed).tolist() == [*range(OWN, OWN + OWN // 4)]
    assert not (found.coverage.glimpsed & found.coverage.observed).any()
    assert (found.samples[OWN : 2 * OWN] == 0).all()
    assert (found.spread[OWN : 2 * OWN] == 0).all()
    stored = found.coverage.stored()
    assert set(stored.tolist()) == {0, 0.25, 0.5, 1}
    again = CoverageMap.from_stored(np.repeat(stored[:, None], 3, axis=1))
    np.testing.assert_array_equal(again.kind, found.coverage.kind)


def test_a_scan_of_which_nothing_is_seen_is_refused_with_its_texels_size(trio: World):
    none = np.zeros(3 * OWN, int)
    with pytest.raises(InputRefused, match=r"texels of 0\.125 m.*\[texturing.unseen\]"):
        _filled_in(trio.texels, _measured(none, none))
    clipped = none.copy()
    clipped[7] = 1
    assert _filled_in(trio.texels, _measured(none, clipped)).coverage.clipped[7]


def _seen(share: float, **more) -> LitTexture:
    measured = np.arange(1000) < 1000 * share
    maps = np.zeros((1000, 3), np.float32)
    return LitTexture(
        lit=maps, mean=maps, spread=maps, samples=maps[:, 0],
        coverage=CoverageMap.of(measured, ~measured), **more,
    )  # fmt: skip


def test_over_nine_tenths_that_nobody_measured_are_told():
    assert not list(_seen(0.101).doubts())
    (told,) = _seen(0.098).doubts()
    assert told.startswith("90.2 % of the texels")
    assert told.endswith("[texturing.unseen]")


def test_each_contradicting_frame_is_told_with_its_gain():
    one, other = _seen(1, contradicting={"a.exr": 2.5, "b.exr": 0.4}).contradictions()
    assert "a.exr: 2.5 times" in one
    assert "b.exr: 0.4 times" in other
