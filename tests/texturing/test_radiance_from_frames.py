"""All frames of a small capture into the statistics of every texel."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, world_of
from tests.scenes import RADIANCE, ROOM, camera_at, look_at, ring_of_poses, room_mesh
from usdbrdf import kernel
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.geometry.unwrap import pack_triangles_singly
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.exposures import Probes
from usdbrdf.texturing.observe import FrameSamples, Observation, samples_from_frames, spread_order
from usdbrdf.texturing.psquare import quantile
from usdbrdf.transport.lit_scene import TexturedScene

SATURATION = 4.0
WIDTH, HEIGHT = 48, 36
LENS = np.array([28.0, 28.0, 24.0, 18.0])


class Room(NamedTuple):
    world: World
    names: tuple[str, ...]
    frames: Frames


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Room:
    """Twelve frames of the furnished room, half of them look up; the lamp saturates in all."""
    folder: Path = tmp_path_factory.mktemp("frames")
    points, triangles, owner, names = room_mesh(subdivisions=2)
    world = world_of([_part(points[triangles[owner == i]]) for i in range(len(names))])
    middle = np.array([ROOM[0] / 2, ROOM[1] / 2, 1.2])
    up = [look_at(pose[:3, 3], middle + np.array([0.3, 0.1, 1.2])) for pose in ring_of_poses(6)]
    poses = np.array([*ring_of_poses(6), *up])
    shown = np.array([RADIANCE[name] for name in names], np.float32)
    for i, pose in enumerate(poses):
        camera = camera_at(pose, LENS, WIDTH, HEIGHT)
        hits = world.rays.closest(*camera.rays(camera.pixels()))
        image = shown[world.scene.face_object[hits.face]].reshape(HEIGHT, WIDTH, 3)
        write_exr(folder / f"{i}.exr", np.minimum(image, np.float32(SATURATION)))
    frames = Frames(
        image_paths=tuple(folder / f"{i}.exr" for i in range(len(poses))),
        world_from_camera=poses,
        intrinsics=np.tile(LENS, (len(poses), 1)),
        resolution=np.tile(np.array([WIDTH, HEIGHT], np.int32), (len(poses), 1)),
        exposure_time=np.ones(len(poses)),
        saturation_radiance=np.full(len(poses), SATURATION),
        noise_floor_radiance=np.full(len(poses), 1e-3),
    )
    return Room(world, names, frames)


def _part(corners: np.ndarray) -> Part:
    """Triangles (F, 3, 3) as an object, each in a cell of its own of the atlas."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    uv, size = pack_triangles_singly(corners, 0.04)
    return Part(
        points=corners.reshape(-1, 3).astype(np.float64),
        triangles=np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        uv=uv.astype(np.float64),
        normals=np.repeat(normal[:, None], 3, axis=1),
        size=size,
    )


def _empty(world: World, part: slice | None = None) -> Observation:
    count = len(world.texels)
    return Observation.empty(part or slice(0, count), Probes.empty(count, 12, part))


def _observe(
    world: World, frames: Frames, observed: Observation, start: int = 0, part: slice | None = None
) -> list[int]:
    read, order = partial(read_frame, frames), range(start, len(frames))
    surface = TexturedScene(world.scene, world.texels, world.rays)
    done = []
    for some in samples_from_frames(surface, frames, read, order, part):
        observed.add(some, 0.5)
        done.append(some.frame)
    return done


def test_every_object_gets_the_radiance_it_was_drawn_with(room: Room):
    world = room.world
    observed = _empty(world)
    assert _observe(world, room.frames, observed) == list(range(12))
    found = quantile(observed.quantiles, 0.5)
    owner = world.texels.object_index()
    lamp = owner == room.names.index("lamp")
    for index, name in enumerate(room.names):
        seen = (owner == index) & (observed.quantiles.samples > 0)
        if name == "lamp":
            assert not seen.any()
            continue
        assert seen.sum() > 200
        expected = np.tile(np.array([RADIANCE[name]], np.float32), (seen.sum(), 1))
        np.testing.assert_allclose(found[seen], expected, rtol=1e-5)
        np.testing.assert_allclose(observed.quantiles.mean[seen], expected, rtol=1e-5)
    # The lamp is known to be at least as bright as the sensor's limit, and nothing else is.
    assert (observed.clipped[~lamp] == 0).all()
    assert (observed.clipped[lamp] > 0).sum() > 100
    np.testing.assert_array_equal(
        observed.lower_bound, np.where(observed.clipped > 0, np.float32(SATURATION), 0)
    )


def test_statistics_of_some_texels_are_those_of_all(room: Room):
    count = len(room.world.texels)
    whole = _empty(room.world)
    _observe(room.world, room.frames, whole)
    for part in (slice(0, 1000), slice(1000, 1003), slice(1003, count)):
        own = _empty(room.world, part)
        _observe(room.world, room.frames, own, part=part)
        for name, values in whole.of(part).arrays().items():
            np.testing.assert_array_equal(own.arrays()[name], values)


def test_frames_before_which_no_texel_lies_are_not_read(room: Room):
    owner = room.world.texels.object_index()
    lamp = np.flatnonzero(owner == room.names.index("lamp"))
    part = slice(int(lamp[0]), int(lamp[-1]) + 1)
    read = []

    def noted(i: int) -> FramePixels:
        read.append(i)
        return read_frame(room.frames, i)

    surface = TexturedScene(room.world.scene, room.world.texels, room.world.rays)
    found = list(samples_from_frames(surface, room.frames, noted, range(12), part))
    assert [some.frame for some in found] == list(range(12))
    assert 0 < len(read) < 12
    for some in found:
        assert some.frame in read or not len(some.texel) + len(some.clipped) + len(some.dark)


def test_what_is_black_is_known_to_be_dark(room: Room, tmp_path: Path):
    """Not as bright as what lies around it, nor as its noise in the frames exposed shortest."""
    owner = room.world.scene.face_object
    box = room.names.index("box")
    floors = np.where(np.arange(12) % 2, 0.01, 0.2)
    noise = np.random.default_rng(0)
    for i in range(12):
        camera = room.frames.camera(i)
        hits = room.world.rays.closest(*camera.rays(camera.pixels()))
        image = read_exr(room.frames.image_paths[i])
        black = (owner[hits.face] == box).reshape(HEIGHT, WIDTH)
        image[black] = floors[i] * noise.uniform(0, 0.6, (int(black.sum()), 3))
        write_exr(tmp_path / f"{i}.exr", image)
    paths = tuple(tmp_path / f"{i}.exr" for i in range(12))
    frames = replace(room.frames, image_paths=paths, noise_floor_radiance=floors)
    observed = _empty(room.world)
    _observe(room.world, frames, observed)
    assert (observed.dark > 0).sum() > 300
    found = observed.measured(0.5)
    own = room.world.texels.object_index() == box
    told = own & (found["count"] > 0)
    np.testing.assert_array_equal(told, own & (observed.dark > 0))
    assert (found["median"][told] < 0.2).all()
    well = told & (observed.weight > 3 * 0.01**-2)
    assert well.sum() > 100
    np.testing.assert_allclose(found["mean"][well].mean(), 0.003, rtol=0.15)
    # Measured by the frames exposed longest, whatever others were too dark for.
    wall = (observed.quantiles.samples > 0) & (observed.dark > 0)
    np.testing.assert_array_equal(found["median"][wall], quantile(observed.quantiles, 0.5)[wall])


def test_going_on_from_a_saved_state_changes_no_bit(room: Room):
    whole = _empty(room.world)
    _observe(room.world, room.frames, whole)
    head = replace(room.frames, image_paths=room.frames.image_paths[:5])
    first = _empty(room.world)
    assert _observe(room.world, head, first) == list(range(5))
    saved = {name: values.copy() for name, values in first.arrays().items()}
    second = _empty(room.world)
    second.restore(saved)
    assert _observe(room.world, room.frames, second, start=5) == list(range(5, 12))
    for name, values in whole.arrays().items():
        np.testing.assert_array_equal(second.arrays()[name], values)


def test_texels_in_groups_get_what_they_get_together(room: Room):
    world, count = room.world, len(room.world.texels)
    whole = _empty(world)
    _observe(world, room.frames, whole)
    for part in (slice(0, 333), slice(333, count // 2), slice(count // 2, count)):
        own = _empty(world, part)
        assert len(_observe(world, room.frames, own, part=part)) == 12
        every = whole.probes.every
        probed = slice(-(-part.start // every), -(-part.stop // every))
        for name, values in whole.arrays().items():
            expected = values[probed if name == "probes" else part]
            np.testing.assert_array_equal(own.arrays()[name], expected)


@pytest.mark.fault("R13")
def test_the_number_of_threads_changes_no_bit(room: Room, monkeypatch: pytest.MonkeyPatch):
    many = _empty(room.world)
    _observe(room.world, room.frames, many)
    one = _empty(room.world)
    monkeypatch.setattr(kernel, "num_threads", lambda: 13)
    _observe(room.world, room.frames, one)
    for name, values in many.arrays().items():
        np.testing.assert_array_equal(one.arrays()[name], values)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8, 54, 90, 400, 401])
def test_a_film_is_read_so_that_neighbours_do_not_follow_each_other(count: int):
    order = spread_order(count)
    assert sorted(order) == list(range(count))
    apart = np.abs(np.diff(order)) if count > 3 else np.array([count])
    assert apart.min() >= 0.2 * count


def _frame_of(texel: list[int], radiance: list[float], *, glimpses: bool) -> FrameSamples:
    none, colours = np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    own = np.array(texel, np.int32), np.repeat(np.array(radiance, np.float32)[:, None], 3, axis=1)
    sampled, glimpsed = ((none, colours), own) if glimpses else (own, (none, colours))
    return FrameSamples(0, *sampled, none, 9.0, none, colours, 0.1, *glimpsed)


def test_a_sample_is_worth_more_than_all_glimpses():
    """Texel 10 is only glimpsed, 11 sampled before and after, 12 only sampled, 13 not at all."""
    part = slice(10, 14)
    observed, plain = (Observation.empty(part, Probes.empty(20, 9, part)) for _ in range(2))
    for k in range(5):
        observed.add(_frame_of([10, 11], [1.0 + k, 50.0], glimpses=True), 0.5)
    saved = {name: values.copy() for name, values in observed.arrays().items()}
    observed = Observation.empty(part, Probes.empty(20, 9, part))
    observed.restore(saved)
    for k in range(6):
        sampled = _frame_of([11, 12], [2.0 + k, 3.0 + k], glimpses=False)
        observed.add(sampled, 0.5)
        plain.add(sampled, 0.5)
        observed.add(_frame_of([11, 12], [80.0, 80.0], glimpses=True), 0.5)
    found, alone = observed.measured(0.5), plain.measured(0.5)
    assert found["glimpsed"].tolist() == [True, False, False, False]
    assert found["count"].tolist() == [0, 6, 6, 0]
    np.testing.assert_allclose(found["median"][0], 3.0)
    np.testing.assert_allclose(found["mean"][0], 3.0)
    assert np.isnan(found["spread"][0]).all()
    for name in ("median", "mean", "spread", "count"):
        np.testing.assert_array_equal(found[name][1:3], alone[name][1:3])
    assert np.isnan(found["median"][3]).all()
