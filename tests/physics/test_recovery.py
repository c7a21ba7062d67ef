"""A sphere of known material in a lit box: the fit finds what it was rendered with.

The target frame is rendered here, by NumPy alone: exact sphere, exact box, printed equations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.brdf import f_nd
from tests.physics.surfaces import World, box, room, sphere, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.material.conductor import Conductor
from usdbrdf.material.doubt_of_light import error_by_doubt, with_doubts_of_light
from usdbrdf.material.fit_target import fit_target_frame
from usdbrdf.material.fit_views import (
    SampledObject,
    fit_views,
    metal_if_opaque,
    sampled_object,
    with_what_shows_through,
)
from usdbrdf.material.observations import Follower, Observations
from usdbrdf.material.verdict import LobeEstimate, verdict_on_views
from usdbrdf.model.camera import Camera
from usdbrdf.transport.lit_scene import LitScene, View

CENTRE, RADIUS = np.array([0.0, 0.0, 1.0]), 0.35
LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.6])
# Floor, ceiling, walls at y low, y high, x low, x high.
WALLS = np.array(
    [[0.3, 0.25, 0.2], [0.5, 0.5, 0.5], [0.2, 0.3, 0.4], [0.4, 0.3, 0.2], [0.25] * 3, [0.35] * 3]
)
# The lamp: a box under the ceiling, above the camera's side of the sphere.
LAMP_LOW, LAMP_HIGH = np.array([0.3, -1.3, 2.3]), np.array([0.9, -0.7, 2.5])
LAMP = np.array([30.0, 27.0, 24.0])
SIZE = 56
SPHERE = 12  # index of the object after six walls and the lamp's six sides


class Studio(NamedTuple):
    world: World
    camera: Camera


@pytest.fixture(scope="module")
def studio() -> Studio:
    parts = (
        room(LOW, HIGH) + box(LAMP_LOW, LAMP_HIGH) + [sphere(CENTRE, RADIUS, 64, 128, (256, 128))]
    )
    pose = np.eye(4)
    # From y = -1.6, looking along +y: right = x, up = z.
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
    pose[:3, 3] = [0, -1.6, 1.0]
    focal = 0.42 * SIZE / np.tan(np.arcsin(RADIUS / 1.6))  # the sphere fills 84 % of the height
    return Studio(world_of(parts), camera_at(pose, (focal, focal, SIZE / 2, SIZE / 2), SIZE, SIZE))


def _diffuse(position: np.ndarray) -> np.ndarray:
    """L_d of the sphere: some smooth function of the place."""
    return (0.25 + 0.2 * (position - CENTRE) @ [0.5, 0.2, 1.0])[..., None] * [1.0, 0.8, 0.6]


def _true_radiance(world: World) -> np.ndarray:
    lit = world.per_object([*WALLS, *[LAMP] * 6, (0, 0, 0)])
    own = world.texels.of_object(SPHERE)
    lit[own] = _diffuse(world.texels.position[own].astype(np.float64))
    return lit


def _incident(origin: np.ndarray, w: np.ndarray) -> np.ndarray:
    """L from the box's inside or the lamp, (..., 3), by the slab method. The sphere is convex."""
    with np.errstate(divide="ignore", invalid="ignore"):
        exits = np.maximum((LOW - origin) / w, (HIGH - origin) / w)
        near = np.minimum((LAMP_LOW - origin) / w, (LAMP_HIGH - origin) / w).max(axis=-1)
        far = np.maximum((LAMP_LOW - origin) / w, (LAMP_HIGH - origin) / w).min(axis=-1)
    axis = exits.argmin(axis=-1)
    positive = np.take_along_axis(w, axis[..., None], axis=-1)[..., 0] > 0
    # Axis z: floor 0, ceiling 1; axis y: 2, 3; axis x: 4, 5.
    wall = np.array([4, 2, 0])[axis] + positive
    return np.where(((near < far) & (near > 0))[..., None], LAMP, WALLS[wall])


def _sphere_points(studio: Studio, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the rays through pixels (R, 2) (NaN: past the sphere) and directions."""
    origin, direction = (a.astype(np.float64) for a in studio.camera.rays(pixels))
    b = ((origin - CENTRE) * direction).sum(axis=-1)
    c = ((origin - CENTRE) ** 2).sum(axis=-1) - RADIUS**2
    with np.errstate(invalid="ignore"):
        return -b - np.sqrt(b * b - c), direction


def _centres() -> np.ndarray:
    lens = (1.0, 1.0, 0.0, 0.0)
    return Camera(world_from_camera=np.eye(4), intrinsics=lens, width=SIZE, height=SIZE).pixels()


def _render(studio: Studio, phi: float, psi: float, samples: int = 96) -> np.ndarray:
    """The frame (H, W, 3): each pixel the mean of 3 x 3 points of it, I = L_d + I_nd.

    I_nd by half of the directions from D about the mirror direction and half cosine-distributed,
    balance heuristic, independent random numbers.
    """
    rng = np.random.default_rng(2024)
    centres = _centres()
    offset = (np.arange(3) - 1) / 3
    offsets = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    image = np.zeros((SIZE * SIZE, 3))
    alpha = max(0.001, phi)
    for shift in offsets:
        distance, direction = _sphere_points(studio, centres + shift)
        on = np.isfinite(distance)
        x = studio.camera.eye + distance[on, None] * direction[on]
        n = (x - CENTRE) / RADIUS
        wo = -direction[on]
        t = np.cross(n, [0.3, 0.5, 0.8])
        t /= np.linalg.norm(t, axis=-1, keepdims=True)
        frame = np.stack([t, np.cross(n, t), n], axis=1)  # rows: two tangents and the normal
        u = rng.random((len(x), samples, 2))
        half = samples // 2
        tan = alpha * np.sqrt(u[:, :half, 0] / (1 - u[:, :half, 0]))
        cos_h = 1 / np.sqrt(1 + tan**2)
        radius = np.concatenate([tan * cos_h, np.sqrt(u[:, half:, 0])], axis=1)
        up = np.concatenate([cos_h, np.sqrt(1 - u[:, half:, 0])], axis=1)
        angle = 2 * np.pi * u[..., 1]
        local = np.stack([radius * np.cos(angle), radius * np.sin(angle), up], axis=-1)
        w = local @ frame
        h = w[:, :half]
        w[:, :half] = 2 * (h @ wo[..., None]) * h - wo[:, None]
        both = w + wo[:, None]
        both /= np.linalg.norm(both, axis=-1, keepdims=True)
        nh = (both * n[:, None]).sum(axis=-1)
        wh = (both * w).sum(axis=-1)
        nw = (w * n[:, None]).sum(axis=-1)
        d = alpha**2 / (np.pi * (1 + (alpha**2 - 1) * nh**2) ** 2)
        density = (
            0.5 * d * np.abs(nh) / (4 * np.maximum(wh, 1e-9)) + 0.5 * np.maximum(nw, 0) / np.pi
        )
        value = f_nd(n[:, None], w, wo[:, None], phi, psi) * nw / np.maximum(density, 1e-12)
        light = _incident(x[:, None], w)
        image[on] += _diffuse(x) + (value[..., None] * light).mean(axis=1)
    return (image / len(offsets)).reshape(SIZE, SIZE, 3).astype(np.float32)


def _lit_scene(world: World, radiance: np.ndarray) -> LitScene:
    emission = world.per_object([(0, 0, 0)] * 6 + [(1, 1, 1)] * 6 + [(0, 0, 0)])
    return world.lit(radiance, emission=emission)


def _whole(studio: Studio) -> np.ndarray:
    """(H, W) bool: every corner of the pixel lies on the sphere."""
    corners = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]
    inside = [np.isfinite(_sphere_points(studio, _centres() + c)[0]) for c in corners]
    return np.all(inside, axis=0).reshape(SIZE, SIZE)


@pytest.mark.parametrize(("phi", "psi"), [(0.06, 0.8), (0.12, 0.3), (0.3, 0.5), (0.56, 0.9)])
def test_the_material_of_a_sphere_comes_back(studio: Studio, phi: float, psi: float):
    image = _render(studio, phi, psi)
    view = View(radiance=image, valid=_whole(studio), camera=studio.camera)
    exact = _true_radiance(studio.world)
    lit = _lit_scene(studio.world, exact)
    found, used = fit_target_frame(lit, view, SPHERE, "paper", 800, 0)
    assert found is not None
    assert used > 500
    assert (found.phi, found.psi) == (pytest.approx(phi, abs=0.02), pytest.approx(psi, abs=0.05))
    assert found.evidence > 0.9

    # The sphere's own L_d a tenth too dark: "scaled" has a factor for that, "paper" has not.
    darker = exact.copy()
    darker[studio.world.texels.of_object(SPHERE)] *= np.float32(0.9)
    off = _lit_scene(studio.world, darker)
    scaled, _ = fit_target_frame(off, view, SPHERE, "scaled", 800, 0)
    assert scaled is not None
    assert (scaled.phi, scaled.psi) == (pytest.approx(phi, abs=0.02), pytest.approx(psi, abs=0.05))
    literal, _ = fit_target_frame(off, view, SPHERE, "paper", 800, 0)
    assert literal is not None
    assert literal.cost > 2 * found.cost


OF_VIEWS = 0.12, 0.4


class Views(NamedTuple):
    """What ``fit_views`` needs of nine views on an arc around the sphere."""

    radiance: np.ndarray
    observed: Observations
    smoothing: float
    cameras: list[Camera]

    def sampled(self, lit: LitScene, doubt: LitScene | None = None) -> SampledObject:
        given = self.observed, self.smoothing, self.cameras.__getitem__, SPHERE
        found, used = sampled_object(lit, *given, doubt=doubt)
        assert found is not None
        assert used > 500
        return found


@pytest.fixture(scope="module")
def views(studio: Studio) -> Views:
    # L_d of the sphere, as the fit gets it, is wrong by a factor and a gradient; the lobe shows in
    # how a texel changes from view to view.
    phi, psi = OF_VIEWS
    wrong = _true_radiance(studio.world)
    own = studio.world.texels.of_object(SPHERE)
    wrong[own] *= (0.8 + studio.world.texels.position[own, :1]).astype(np.float32)
    lit = _lit_scene(studio.world, wrong)
    usable = np.zeros(len(wrong), bool)
    usable[own] = True
    angles = np.radians(np.linspace(-60, 60, 9))
    cameras = []
    follower = Follower(lit, usable, len(angles), 0)
    for i, angle in enumerate(angles):
        eye = np.array([1.6 * np.sin(angle), -1.6 * np.cos(angle), 1.0 + 0.3 * np.sin(3 * angle)])
        there = studio._replace(
            camera=replace(studio.camera, world_from_camera=look_at(eye, CENTRE))
        )
        view = View(
            radiance=_render(there, phi, psi, samples=32), valid=_whole(there), camera=there.camera
        )
        follower.add(i, view, np.zeros_like(view.valid), 1e-3)
        cameras.append(view.camera)
    return Views(wrong, follower.chosen(0).of_texels(own), follower.smoothing, cameras)


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_what_shows_through_is_held_against_a_lobe(studio: Studio, views: Views, share: float):
    lit = _lit_scene(studio.world, views.radiance)
    sampled = views.sampled(lit)
    through = np.float32(share) * sampled.behind(SPHERE)
    seen = sampled.samples.radiance + through
    sampled = sampled._replace(samples=replace(sampled.samples, radiance=seen))
    found = LobeEstimate(*OF_VIEWS, 0.01, 0.01, 0.0, 1.0, 0.9)
    held = with_what_shows_through(lit.lobe, lambda: sampled, SPHERE, 0, found)
    assert verdict_on_views(held, True).status == ("undetermined" if share else "measured")
    assert held.contradiction == pytest.approx(through.sum() / seen.sum(), abs=0.1)
    unsure = found._replace(evidence=0.1)  # nothing is asked about what is not measured anyway
    assert with_what_shows_through(lit.lobe, pytest.fail, SPHERE, 0, unsure) == unsure


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_what_shows_through_is_no_metal(studio: Studio, views: Views, share: float):
    """Of light that changes with the view as a mirror's does a pane's may, where what is before it
    looks like what is behind it."""
    lit = _lit_scene(studio.world, views.radiance)
    sampled = views.sampled(lit)
    through = np.float32(share) * sampled.behind(SPHERE)
    seen = sampled.samples.radiance + through
    sampled = sampled._replace(samples=replace(sampled.samples, radiance=seen))
    found = LobeEstimate(0.4, 0.1, 0.01, 0.01, 0.0, 1.0, 0.9)
    metal = Conductor(OF_VIEWS[0], (0.6, 0.6, 0.6), 0.01, 0.02, 2.0)
    held, left = metal_if_opaque(lit.lobe, lambda: sampled, SPHERE, 0, found, metal)
    assert left == (None if share else metal)
    assert held.contradiction == pytest.approx(through.sum() / seen.sum(), abs=0.1)
    if not share:
        assert held == found


def test_many_views_find_the_material_without_knowing_the_diffuse_radiance(
    studio: Studio, views: Views
):
    (phi, psi), lit = OF_VIEWS, _lit_scene(studio.world, views.radiance)
    sampled = views.sampled(lit)
    found, _ = fit_views(lit.lobe, lambda: sampled, 0)
    assert found.phi == pytest.approx(phi, abs=0.04)
    assert found.psi == pytest.approx(psi, abs=0.1)
    assert found.evidence > 0.5


def test_psi_is_known_no_better_than_the_lamp_that_is_mirrored(studio: Studio, views: Views):
    world, lit = studio.world, _lit_scene(studio.world, views.radiance)
    lamp = np.isin(world.texels.object_index(), range(6, 12))[:, None]

    def only(values: np.ndarray) -> LitScene:
        return _lit_scene(world, np.where(lamp, values, 0).astype(np.float32))

    found, _ = fit_views(lit.lobe, lambda: views.sampled(lit), 0)
    off = 0.3
    sampled = views.sampled(lit, only(off * views.radiance))
    error = error_by_doubt(sampled, lit.lobe, found.phi, found.psi, 0, np.ones((3, 1), np.float32))
    # Most of the highlight is the lamp's, at grazing angles whatever psi is.
    assert 0.6 * off * found.psi < error < 1.3 * off * found.psi
    brighter = _lit_scene(world, np.where(lamp, 1 + off, 1) * views.radiance)
    dimmer, _ = fit_views(lit.lobe, lambda: views.sampled(brighter), 0)
    assert found.psi - dimmer.psi == pytest.approx(error / (1 + off), rel=0.15)

    doubted, _ = with_doubts_of_light(lit.lobe, lambda: sampled, 0, found, None)
    psi_error = np.hypot(found.psi_error, error)
    assert doubted == found._replace(psi_error=psi_error, psi_upper=doubted.psi_upper)
    assert doubted.psi_upper > found.psi_upper
    # And of a metal F0, where psi itself is not known.
    metal = Conductor(found.phi, (0.9, 0.8, 0.7), 0.02, 0.03, 1.0)
    _, of_metal = with_doubts_of_light(lit.lobe, lambda: sampled, 0, found, metal)
    assert of_metal is not None
    assert of_metal.f0_error == pytest.approx(0.9 * error / found.psi, rel=0.15)
    assert of_metal.f0 == metal.f0
    # What was seen is not doubted.
    seen = views.sampled(lit)
    assert with_doubts_of_light(lit.lobe, lambda: seen, 0, found, None) == (found, None)


def test_a_sphere_without_specular_gets_none(studio: Studio):
    # psi = 0 keeps the grazing part only: hardly anything but L_d is in the picture.
    image = _render(studio, 0.9, 0.0)
    view = View(radiance=image, valid=_whole(studio), camera=studio.camera)
    lit = _lit_scene(studio.world, _true_radiance(studio.world))
    found, _ = fit_target_frame(lit, view, SPHERE, "paper", 800, 0)
    assert found is not None
    assert found.psi < 0.05


def test_an_object_of_a_few_pixels_is_not_fitted(studio: Studio):
    nothing = np.zeros((SIZE, SIZE), bool)
    nothing[SIZE // 2, SIZE // 2 - 4 : SIZE // 2 + 4] = True
    view = View(radiance=np.ones((SIZE, SIZE, 3), np.float32), valid=nothing, camera=studio.camera)
    lit = _lit_scene(studio.world, _true_radiance(studio.world))
    found, used = fit_target_frame(lit, view, SPHERE, "paper", 800, 0)
    assert found is None
    assert used == 8
