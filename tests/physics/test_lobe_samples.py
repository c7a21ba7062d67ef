"""The mixture of lobe, light and cosine samples integrates any roughness without bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from tests.physics.chi2 import assert_same_mean
from tests.physics.surfaces import World, box, quad, room, world_of
from usdbrdf.transport.brdf import half_vector, lobe
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.lit_scene import SurfacePoints
from usdbrdf.transport.lobe_radiance import LobeSamples, Mixture, non_diffuse, trace_lobe_samples
from usdbrdf.transport.rays import Hits, RayScene

PHIS = (0.0, 0.02, 0.1, 0.3, 0.7, 1.0)
RGB = np.array([3.0, 2.0, 1.0])
REPEAT = 8192
MIXTURE = Mixture()
UP = np.array([0.0, 0.0, 1.0])


def _points(position: np.ndarray, to_camera: np.ndarray, repeat: int = REPEAT) -> SurfacePoints:
    """The same point of a horizontal surface many times: every copy draws its own shift."""

    def copies(vector: np.ndarray) -> np.ndarray:
        return np.tile(np.asarray(vector, np.float32), (repeat, 1))

    zero = np.zeros(repeat, np.float32)
    return SurfacePoints(
        face=zero.astype(np.int32), u=zero, v=zero,
        position=copies(position), normal=copies(UP), to_camera=copies(to_camera),
    )  # fmt: skip


def _towards(degrees: float) -> np.ndarray:
    return np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])


def _assert_albedo(
    world: World,
    lit: np.ndarray,
    lights: Lights,
    position: np.ndarray,
    degrees: float,
    *,
    environment: Environment | None = None,
    visible=None,
    radiance: np.ndarray = RGB,
    group: int = 4,
) -> None:
    """base and base + slope equal L times the directional albedo at psi = 0 and 1."""
    scene = replace(world.lit(lit, environment=environment), lights=lights)
    points = _points(position, _towards(degrees))
    samples = trace_lobe_samples(scene, points, Mixture(), 0, group=group)
    wanted = [
        [
            directional_albedo(np.radians(degrees), phi, psi, steps=300, visible=visible) * radiance
            for psi in (0.0, 1.0)
        ]
        for phi in PHIS
    ]
    # Of every group one point: they are all right on the mean, not only together.
    base, slope = (part[1 % group :: group] for part in _of_groups(samples, PHIS, REPEAT))
    # (point, channel, phi) of each psi -> (point, phi, psi, channel).
    found = np.stack([base, base + slope], axis=-1).transpose(0, 2, 3, 1).astype(np.float64)
    # slack: the quadrature, halving its step moves it so little even where a mask cuts it.
    slack = 1e-3 if visible is None else 4e-3
    assert_same_mean(found, wanted, slack=slack)


def _of_groups(
    samples: LobeSamples, phis: Sequence[float], groups: int
) -> tuple[np.ndarray, np.ndarray]:
    return non_diffuse(samples, np.tile(np.array(phis, np.float32), (groups, 1)))


@pytest.mark.parametrize("degrees", [10, 45, 75])
def test_a_uniform_environment(degrees: float):
    # L_nd = L * directional albedo. The only triangle of the scene lies under the surface.
    world = world_of([quad((-1, -1, -2), (2, 0, 0), (0, 2, 0))])
    lit = world.per_object([(0, 0, 0)])
    sky = Environment(image=np.tile(RGB.astype(np.float32), (4, 8, 1)), z_up=True)
    _assert_albedo(world, lit, world.lights(lit), np.zeros(3), degrees, environment=sky)


@pytest.mark.parametrize("degrees", [10, 75])
@pytest.mark.parametrize("aims", ["nowhere", "one wall", "a box"])
def test_a_furnace(degrees: float, aims: str):
    # Radiance L from everywhere; whatever the aimed samples aim at must not show.
    world = world_of(room((-2, -2, 0), (2, 2, 2.5)) + box((0.5, 0.4, 0.6), (1.0, 0.9, 1.2)))
    lit = world.per_object([tuple(RGB)] * 12)
    bright = {"nowhere": [], "one wall": [5], "a box": range(6, 12)}[aims]
    lights = world.lights(
        world.per_object([(100.0 if i in bright else 1.0,) * 3 for i in range(12)])
    )
    assert (len(lights.face) > 0) == (aims != "nowhere")
    _assert_albedo(world, lit, lights, np.zeros(3), degrees)


def test_what_cannot_count_is_not_traced(monkeypatch: pytest.MonkeyPatch):
    # A box is the light: of the points that are aimed at most lie on sides that face away. In a
    # furnace all other samples bring something, whatever they are for.
    sides = box((0.5, 0.4, 0.6), (1.0, 0.9, 1.2))
    world = world_of(room((-2, -2, 0), (2, 2, 2.5)) + sides)
    lit = world.lit(world.per_object([tuple(RGB)] * 12))
    lights = world.lights(world.per_object([(100.0 * (i >= 6),) * 3 for i in range(12)]))
    aimed = []

    def closest(rays: RayScene, origins: np.ndarray, directions: np.ndarray) -> Hits:
        aimed.append(directions.any(axis=1))
        return original(rays, origins, directions)

    original = RayScene.closest
    monkeypatch.setattr(RayScene, "closest", closest)
    points = _points(np.zeros(3), _towards(75), repeat=512)
    samples = trace_lobe_samples(replace(lit, lights=lights), points, Mixture(), 0)
    traced = aimed[0].reshape(samples.cos_in.shape)
    assert 0.5 < traced.mean() < 0.9
    assert not samples.weighted[~traced].any()
    # Of a ray to a side that faces the point another side may be in the way.
    assert samples.weighted[traced].any(axis=1).mean() > 0.97


@pytest.mark.parametrize("degrees", [10, 45])
def test_half_of_the_sky_behind_a_wall(degrees: float):
    # A black wall, 2 km wide and high, 1 m away at x = -1: hides the directions with w_x < 0 but
    # those that pass over it or beside it (1e-3 of them).
    world = world_of([quad((-1, -1000, -1), (0, 2000, 0), (0, 0, 1000))])
    lit = world.per_object([(0, 0, 0)])
    sky = Environment(image=np.tile(RGB.astype(np.float32), (4, 8, 1)), z_up=True)

    def visible(w: np.ndarray) -> np.ndarray:
        t = -1 / np.minimum(w[..., 0], -1e-12)
        hit = (w[..., 0] < 0) & (np.abs(t * w[..., 1]) < 1000) & (t * w[..., 2] < 999)
        return ~hit

    # The lift off the surface is 1e-5 of this scene's size: give it that of the room.
    small = World(scene=world.scene, texels=world.texels)
    small.__dict__["size"] = 1.0
    _assert_albedo(
        small, lit, small.lights(lit), np.zeros(3), degrees, environment=sky, visible=visible
    )


@pytest.mark.parametrize("degrees", [10, 45])
@pytest.mark.parametrize("aimed", [True, False])
def test_a_lamp_half_hidden_by_a_blocker(degrees: float, aimed: bool):
    # Lamp: [-1, 1] x [-1, 1] at z = 2, looking down. Blocker, black: [0, 1] x [-1, 1] at z = 1.
    # Seen is where the ray to z = 2 lands on the lamp and, at half that distance, beside the
    # blocker. The lamp is reached by aimed samples or, aimed elsewhere, by the lobes alone.
    lamp = quad((-1, -1, 2), (0, 2, 0), (2, 0, 0))
    blocker = quad((0, -1, 1), (1, 0, 0), (0, 2, 0))
    decoy = quad((5, 5, 0.5), (0, 0, 0.5), (0, 1, 0))
    world = world_of([lamp, blocker, decoy, quad((-20, -20, -1), (40, 0, 0), (0, 40, 0))])
    lit = world.per_object([tuple(RGB), (0, 0, 0), (0, 0, 0), (0, 0, 0)])
    bright = 0 if aimed else 2
    lights = world.lights(world.per_object([(100.0 * (i == bright) + 1e-3,) * 3 for i in range(4)]))
    assert len(lights.face) == 2

    def visible(w: np.ndarray) -> np.ndarray:
        t = 2 / np.maximum(w[..., 2], 1e-12)
        x, y = t * w[..., 0], t * w[..., 1]
        on_lamp = (np.abs(x) < 1) & (np.abs(y) < 1) & (w[..., 2] > 0)
        hidden = (x / 2 > 0) & (x / 2 < 1) & (np.abs(y / 2) < 1)
        return on_lamp & ~hidden

    _assert_albedo(world, lit, lights, np.zeros(3), degrees, visible=visible)


def _of_copies(
    seed: int, group: int, stream: np.ndarray | None = None, mixture: Mixture = MIXTURE
) -> np.ndarray:
    """base + slope of 64 copies of a point in a room with a bright ceiling, (64 / group, 3)."""
    world = world_of(room((-2, -2, 0), (2, 2, 2.5)))
    lit = world.per_object([(1, 1, 1)] * 5 + [(9, 9, 9)])
    points = _points(np.zeros(3), _towards(30), repeat=64)
    samples = trace_lobe_samples(world.lit(lit), points, mixture, seed, stream, group=group)
    base, slope = _of_groups(samples, [0.3], 64 // group)
    return (base + slope)[..., 0]


def test_the_samples_of_a_point_depend_on_the_seed_alone():
    np.testing.assert_array_equal(_of_copies(0, 1), _of_copies(0, 1))
    assert (_of_copies(0, 1) != _of_copies(1, 1)).mean() > 0.9
    # Copies of one point do not share their random numbers, but where they are told to.
    assert len(np.unique(_of_copies(0, 1)[:, 0])) == 64
    numbers = 4 * np.repeat([3, 5], 8)[:, None] + np.arange(4)
    shared = _of_copies(0, 4, numbers.ravel())[:, 0]
    np.testing.assert_array_equal(shared, np.repeat(shared[[0, 8]], 8))
    assert shared[0] != shared[8]


def test_points_of_a_group_share_the_work():
    # The mean of 64 points that divide the samples among them, and of 64 that do not.
    few = Mixture(per_lobe=1, lights=1, cosine=1)
    alone = np.array([_of_copies(seed, 1, mixture=few).mean(axis=0) for seed in range(48)])
    together = np.array([_of_copies(seed, 64, mixture=few)[0] for seed in range(48)])
    assert np.mean(together) == pytest.approx(np.mean(alone), rel=0.02)
    assert together.std(axis=0).mean() < 0.5 * alone.std(axis=0).mean()


@pytest.mark.parametrize("phi", [0.0, 0.02, 0.3, 1.0])
def test_sums_in_single_precision_are_those_of_the_lobe(phi: float):
    # Each direction alone, with light such that the sum is f_nd itself.
    rng = np.random.default_rng(5)
    n, w, wo = np.array([0.0, 0, 1]), rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    w[:100] = 1e-3 * w[:100] + wo[:100] * [-1, -1, 1]  # near the mirror direction
    w[:, 2], wo[:, 2] = np.abs(w[:, 2]), np.abs(wo[:, 2])
    w, wo = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (w, wo))
    half = np.array([half_vector(n, a, b) for a, b in zip(w, wo, strict=True)], np.float32)
    samples = LobeSamples(
        cos_in=w[:, 2:].astype(np.float32),
        sin2_half=half[:, :1].copy(),
        cos_half=half[:, 1:].copy(),
        weighted=np.ones((500, 1, 3), np.float32),
        cos_out=wo[:, 2].astype(np.float32),
    )
    base, slope = non_diffuse(samples, np.full((500, 8), phi, np.float32))
    phi = float(np.float32(phi))
    expected = np.array([lobe(n, a, b, phi) for a, b in zip(w, wo, strict=True)])
    # Rounded: sin^2 of the half vector (twice in D), cosines, and some ten operations.
    found = np.stack([base[:, 1, 3], slope[:, 1, 3]], axis=1)
    np.testing.assert_allclose(found[:, 1], expected[:, 1], rtol=2e-6)
    np.testing.assert_allclose(found.sum(axis=1), expected.sum(axis=1), rtol=2e-6)
