"""Groups of texels that fit into memory."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.memory import GIB
from usdbrdf.model.capture import Frames
from usdbrdf.texturing import passes
from usdbrdf.texturing.passes import (
    OF_TEXTURING,
    BytesPerTexel,
    by_parts,
    groups_of_texels,
    shares_of,
    smallest_groups,
)


@pytest.fixture(autouse=True)
def _small_process(monkeypatch):
    monkeypatch.setattr(passes, "resident_bytes", lambda: 0)


@pytest.fixture(scope="module")
def square() -> World:
    return world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(1000, 1200))])


def _frames(width: int = 64, height: int = 48) -> Frames:
    return Frames(
        image_paths=(Path("0.exr"),),
        world_from_camera=np.eye(4)[None],
        intrinsics=np.array([[50.0, 50, 32, 24]]),
        resolution=np.array([[width, height]], np.int32),
        exposure_time=np.ones(1),
        saturation_radiance=np.ones(1),
        noise_floor_radiance=np.zeros(1),
    )


def _groups(world: World, memory: float | None, need: BytesPerTexel = OF_TEXTURING) -> list[slice]:
    return groups_of_texels(world.texels, world.scene, _frames(), memory, need)


def test_one_group_where_memory_suffices(square: World):
    assert _groups(square, 4.0) == [slice(0, 1_200_000)]


def test_less_memory_makes_more_groups_that_hold_every_texel_once(square: World):
    counts = []
    for memory in (1.0, 0.85, 0.78, 0.74, 0.722):
        groups = _groups(square, memory, OF_TEXTURING._replace(after=50))
        assert groups[0].start == 0
        assert groups[-1].stop == 1_200_000
        assert all(a.stop == b.start for a, b in pairwise(groups))
        counts.append(len(groups))
    assert counts == sorted(counts)
    assert counts[0] == 1
    assert counts[-1] >= 4


def test_the_maps_of_all_groups_must_fit_as_well(square: World):
    assert len(_groups(square, 0.93)) == 1
    for need in (OF_TEXTURING._replace(after=400), OF_TEXTURING._replace(always=400)):
        with pytest.raises(EnvironmentFailure, match=r"need \d\.\d GiB"):
            _groups(square, 0.93, need)


def test_what_the_process_holds_already_counts(square: World, monkeypatch):
    need = OF_TEXTURING._replace(after=50)
    assert len(_groups(square, 0.93, need)) == 1
    monkeypatch.setattr(passes, "resident_bytes", lambda: int(0.72 * GIB))
    assert len(_groups(square, 0.93, need)) == 2


def test_too_little_memory_is_refused_with_what_is_needed(square: World):
    with pytest.raises(EnvironmentFailure, match=r"need 0.\d GiB, the limit is 0.5.*--memory"):
        _groups(square, 0.5)


@pytest.mark.parametrize(
    ("count", "passes"), [(1, 1), (700_000, 3), (3_000_000, 12), (80_000_000, 12)]
)
def test_the_smallest_groups_are_worth_their_passes(count: int, passes: int):
    groups = smallest_groups(range(count))
    assert len(groups) == passes
    assert groups[-1].stop == count


def test_the_machines_memory_is_the_default(square: World, monkeypatch):
    monkeypatch.setattr(passes, "machine_bytes", lambda: 1.2 * GIB)
    assert _groups(square, None) == _groups(square, 0.9)
    monkeypatch.setattr(passes, "machine_bytes", lambda: 0.5 * GIB)
    with pytest.raises(EnvironmentFailure, match=r"limit is 0\.4"):
        _groups(square, None)


def test_parts_make_the_whole():
    whole = {
        "count": np.arange(10, dtype=np.int32),
        "mean": np.random.default_rng(1).random((10, 3), np.float32),
    }
    parts = [slice(0, 4), slice(4, 5), slice(5, 10)]
    found = by_parts(parts, lambda part: {name: a[part] for name, a in whole.items()})
    for name, values in whole.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


@pytest.mark.parametrize(
    ("workers", "count"), [(1, 1), (2, 2), (3, 3), (400, 13), (1, 10)], ids=str
)
def test_shares_are_even_about_as_large_as_is_worth_it_and_none_too_large(
    monkeypatch, workers: int, count: int
):
    if count == 10:
        monkeypatch.setattr(passes, "_LARGEST_SHARE", 5000)
    shares = shares_of(slice(1000, 51_000), workers)
    assert len(shares) == count
    assert [shares[0].start, shares[-1].stop] == [1000, 51_000]
    assert all(one.stop == other.start for one, other in pairwise(shares))
    sizes = [share.stop - share.start for share in shares]
    assert max(sizes) - min(sizes) <= 1
