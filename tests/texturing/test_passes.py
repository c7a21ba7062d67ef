"""Groups of texels that fit into memory."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
    _budget,
    among_workers,
    by_parts,
    bytes_for_frames,
    groups_of_texels,
    in_passes,
    most_texels,
    shares_of,
    smallest_groups,
    with_rows_beside,
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


def test_rows_beside_a_part_are_those_of_its_objects_atlases():
    """Of atlases of 4 x 3 and 5 x 4 pixels, all covered."""
    texels = world_of([
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(4, 3)),
        quad((3, 0, 0), (1, 0, 0), (0, 1, 0), size=(5, 4)),
    ]).texels  # fmt: skip
    assert texels.pixel.tolist() == list(range(32))
    for part, rows, wanted in (
        (slice(5, 6), 0, slice(5, 6)),
        (slice(5, 6), 1, slice(1, 10)),
        (slice(5, 6), 2, slice(0, 12)),
        # From one object into another: rows before are the one's, rows behind the other's.
        (slice(10, 14), 1, slice(6, 19)),
        (slice(12, 32), 1, slice(12, 32)),
        (slice(25, 26), 1, slice(20, 31)),
    ):
        assert with_rows_beside(texels, part, rows) == wanted


NEED = BytesPerTexel(grouped=1000, result=100, after=300, always=20, pixel=7)


def _held(world: World) -> int:
    """Half a GiB, the tables, 200 bytes of each of two triangles and 20 of each texel."""
    tables = [*vars(world.scene).values(), *vars(world.texels).values()]
    own = sum(table.nbytes for table in tables if isinstance(table, np.ndarray))
    return GIB // 2 + own + 2 * 200 + 20 * len(world.texels)


def test_a_budget_is_what_is_held_and_what_each_texel_takes(monkeypatch):
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(8, 8))])
    of_frame = 7 * 64 * 48
    limit, held, after = _budget(world.texels, world.scene, _frames(), 2.0, NEED)
    assert limit == 2 * GIB
    assert held == _held(world) + of_frame + 64 * 100
    assert after == _held(world) + of_frame + 64 * 300
    # Whoever called may hold more already; without a limit three quarters of the machine's count.
    monkeypatch.setattr(passes, "resident_bytes", lambda: 3 * GIB)
    monkeypatch.setattr(passes, "machine_bytes", lambda: 8 * GIB)
    limit, held, after = _budget(world.texels, world.scene, _frames(), None, NEED)
    assert (limit, held) == (6 * GIB, 3 * GIB + of_frame + 64 * 100)
    # Half of what one pass over all texels leaves, or of what is left when all are done.
    for need, more in ((NEED, 64 * 1100), (NEED._replace(after=5000), 64 * 5000)):
        room = bytes_for_frames(world.texels, world.scene, _frames(), 4.0, need)
        assert room == int((GIB - of_frame - more) / 2)
    assert bytes_for_frames(world.texels, world.scene, _frames(), 2.0, NEED) == 0


def test_a_scene_has_so_many_texels_that_six_thousand_bytes_of_each_fit(monkeypatch):
    assert most_texels(1.5) == GIB // 6000
    assert most_texels(0.1) == 1
    monkeypatch.setattr(passes, "machine_bytes", lambda: 2 * GIB)
    assert most_texels(None) == GIB // 6000


def test_groups_are_as_large_as_memory_has_room_for(monkeypatch):
    """Whatever is left beside what is held, and no less than the smallest."""
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(100, 100))])
    monkeypatch.setattr(passes, "_smallest", lambda count: 1000)
    for room, count in ((10_000, 1), (9_999, 2), (5_000, 2), (4_999, 3), (1_000, 10)):
        monkeypatch.setattr(passes, "_budget", lambda *_, room=room: (7000.0 + room, 7000.0, 0.0))
        groups = groups_of_texels(
            world.texels, world.scene, _frames(), 1.0, NEED._replace(grouped=1)
        )
        assert len(groups) == count
    for limit in ((7999.0, 7000.0, 0.0), (9000.0, 7000.0, 9001.0)):
        monkeypatch.setattr(passes, "_budget", lambda *_, limit=limit: limit)
        with pytest.raises(EnvironmentFailure, match=r"10,000 texels and 2 triangles"):
            groups_of_texels(world.texels, world.scene, _frames(), 1.0, NEED._replace(grouped=1))


def test_of_several_passes_each_is_kept_and_a_single_one_is_not(monkeypatch):
    said: list[str] = []
    kept: list[str] = []

    def checkpoint(name: str, compute: Any) -> Any:
        kept.append(name)
        return compute()

    run: Any = SimpleNamespace(name="texture", checkpoint=checkpoint)
    monkeypatch.setattr(passes, "say", said.append)
    rows = np.arange(10)
    groups = [slice(0, 3), slice(3, 10)]
    found = in_passes(run, "means", groups, lambda part: {"row": rows[part]})
    assert found["row"].tolist() == rows.tolist()
    assert kept == ["means-0-3", "means-3-10"]
    assert said == ["texture: 2 passes over the frames, for lack of memory"]
    found = in_passes(run, "means", [slice(0, 10)], lambda part: {"row": rows[part]})
    assert found["row"].tolist() == rows.tolist()
    assert len(kept) == 2
    assert len(said) == 1


def test_shares_are_units_that_are_named_by_their_texels():
    def units(unit: Any, given: Any, pieces: Any, *, label: str, noun: str) -> Any:
        assert (unit, given, label, noun) == ("unit", "given", "bar", "groups of texels")
        assert pieces == {"means-2-5": "first", "means-5-6": "second"}
        return [{"row": np.arange(2, 5)}, {"row": np.arange(5, 6)}]

    run: Any = SimpleNamespace(units=units)
    shares, unit = [slice(2, 5), slice(5, 6)], "unit"
    found = among_workers(
        run,
        "means",
        shares,
        unit,
        "given",
        ["first", "second"],
        "bar",  # type: ignore[arg-type]
    )
    assert found["row"].tolist() == [2, 3, 4, 5]
