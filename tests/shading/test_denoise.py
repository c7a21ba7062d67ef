"""The lightmap filter takes noise away and leaves the light and its contact shadows."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.surfaces import World, box, quad, room, world_of
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.memory import give_back_freed, resident_bytes
from usdbrdf.options import Sampling
from usdbrdf.shading.shaded import denoised_irradiance
from usdbrdf.transport.denoise import chosen_filter, denoise_lightmaps, denoise_picture
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels

SIDE = 1.28  # m
TEXELS = 64  # of the floor, along each side: 2 cm
LEG = (0.62, 0.68)  # m, in x and y: three texels of the floor lie below it
CONTACT = 0.045  # m
RUNS = 4  # with random numbers of their own, so that what is common to all is the filter's


class Floor(NamedTuple):
    """S of the floor's texels, the channels' mean: traced and filtered (RUNS, T), converged (T,);
    distance (T,) from the leg, in metres."""

    traced: np.ndarray
    filtered: np.ndarray
    converged: np.ndarray
    distance: np.ndarray

    def depth(self, values: np.ndarray, near: float, far: float) -> float:
        """How much darker the floor is between two distances from the leg than away from it."""
        ring = (self.distance > near) & (self.distance < far)
        away = (self.distance > 0.3) & (self.distance < 0.5)
        return float(1 - values[..., ring].mean() / values[..., away].mean())


@pytest.fixture(scope="module")
def floor() -> Floor:
    """A leg of 6 x 6 cm on a floor, below a lamp of 70 x 70 cm that outshines all else."""
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    ground = quad((0, 0, 0), (SIDE, 0, 0), (0, SIDE, 0), (TEXELS, TEXELS))
    surroundings = [ground, *room((0, 0, 0), (SIDE, SIDE, 1.5))[1:]]
    leg = box((LEG[0], LEG[0], 0), (LEG[1], LEG[1], 0.7))
    world = world_of([*surroundings, *leg, *box((0.2, 0.2, 1.4), (0.9, 0.9, 1.45))])
    lit = world.per_object([(0.1,) * 3] * 6 + [(0.02,) * 3] * 6 + [(30, 30, 30)] * 6)
    traced = [_irradiance(world, lit, Sampling(seed=seed)) for seed in range(RUNS)]
    converged = _irradiance(world, lit, Sampling(standard_error=0.0, max_rays=4096, seed=977))
    filtered = [denoised_irradiance(world.texels, values) for values in traced]
    own = world.texels.of_object(0)
    place = world.texels.position[own, :2].astype(np.float64)
    outside = np.maximum(LEG[0] - place, place - LEG[1]).max(axis=1)
    runs = (np.stack(values)[:, own].mean(axis=-1) for values in (traced, filtered))
    return Floor(*runs, converged[own].mean(axis=-1), outside)


def _irradiance(world: World, lit: np.ndarray, sampling: Sampling) -> np.ndarray:
    """S (T, 3) on the floor, 0 elsewhere."""
    texels = world.texels
    order, tile = tiles_of_texels(texels)
    on_floor = texels.object_index()[order] == 0
    order, tile = order[on_floor], tile[on_floor]
    found = np.zeros_like(lit)
    found[order] = irradiance_at(
        world.rays, world.texture(lit), world.lights(lit), black_environment(),
        texels.position[order], texels.normal[order], tile, sampling, world.size,
    ).mean  # fmt: skip
    return found


def test_the_noise_falls_and_the_mean_stays(floor: Floor):
    seen = floor.distance > 0
    traced, filtered = (
        values[:, seen] / floor.converged[seen] - 1 for values in (floor.traced, floor.filtered)
    )
    assert np.sqrt((filtered**2).mean()) < 0.65 * np.sqrt((traced**2).mean())
    assert abs(filtered.mean()) < 0.002
    # Of every run: the filter's own change, whatever the noise.
    change = floor.filtered[:, seen].sum(axis=1) / floor.traced[:, seen].sum(axis=1) - 1
    assert np.abs(change).max() < 0.002


def test_the_contact_shadow_of_a_thin_leg_keeps_its_depth(floor: Floor):
    depth = floor.depth(floor.converged, 0, CONTACT)
    assert depth > 0.1
    assert floor.depth(floor.filtered, 0, CONTACT) == pytest.approx(depth, rel=0.05)
    # Texel by texel from the leg outwards: the shadow is not smeared.
    for ring in range(4):
        near, far = 0.02 * ring, 0.02 * (ring + 1)
        truth = floor.depth(floor.converged, near, far)
        assert floor.depth(floor.filtered, near, far) == pytest.approx(truth, abs=0.015)


def _digest() -> str:
    noise = np.random.default_rng(5)
    found = hashlib.sha256()
    sizes = (1, 1), (3, 2), (40, 33), (210, 300)
    pictures = (noise.gamma(2, size=(*size, 3)).astype(np.float32) for size in sizes)
    for filtered in denoise_lightmaps(pictures):
        found.update(filtered.tobytes())
    return found.hexdigest()


def test_the_filter_gives_the_same_bits_in_every_run_and_on_any_number_of_threads():
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    here = _digest()
    assert _digest() == here
    for threads in ("1", "2"):
        script = "from tests.shading.test_denoise import _digest; print(_digest())"
        child = subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "OIDN_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        )
        assert child.stdout.strip() == here, threads


def test_a_failure_of_the_filter_ends_it_with_what_to_do(monkeypatch):
    pyoidn = pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    said = iter([None, "out of memory"])
    monkeypatch.setattr(pyoidn.Device, "get_error", lambda _: next(said))
    filtered = denoise_lightmaps([np.ones((4, 5, 3), np.float32)] * 3)
    next(filtered)
    with pytest.raises(EnvironmentFailure, match=r"5 x 4 pixels: out of memory.*--denoise none"):
        next(filtered)


def test_a_picture_is_filtered_along_its_edges():
    # As the library's own call does, whose filter is set up elsewhere.
    pyoidn = pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    rng = np.random.default_rng(8)
    albedo = np.full((40, 50, 3), 0.2, np.float32)
    albedo[:, 20:] = 0.8
    normal = np.tile(np.float32([0, 0, 1]), (40, 50, 1))
    radiance = (albedo * rng.gamma(4, 0.25, (40, 50, 1))).astype(np.float32)
    filtered = denoise_picture(radiance, albedo, normal)
    assert np.abs(filtered / albedo - 1).mean() < 0.1 * np.abs(radiance / albedo - 1).mean()
    expected = pyoidn.denoise(radiance, albedo, normal, hdr=True, clean_aux=True)
    np.testing.assert_array_equal(filtered, np.maximum(expected, 0))


def test_an_interrupt_on_the_way_is_not_swallowed():
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")

    def pictures():
        yield np.ones((4, 4, 3), np.float32)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(denoise_lightmaps(pictures()))


def test_the_filter_gives_its_memory_back():
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    picture = np.ones((1200, 1200, 3), np.float32)
    held = []
    for _ in range(3):
        (filtered,) = denoise_lightmaps([picture])
        del filtered
        give_back_freed()
        held.append(resident_bytes())
    assert held[-1] < held[0] + picture.nbytes
    with_filter = denoise_lightmaps([picture])
    next(with_filter)
    assert resident_bytes() > held[-1] + 10 * picture.nbytes


def test_auto_is_the_filter_where_it_is_installed():
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    assert [chosen_filter(wanted) for wanted in ("auto", "none", "oidn")] == [
        "oidn",
        "none",
        "oidn",
    ]


@pytest.mark.fault("R15")
def test_without_the_package_auto_is_none_and_oidn_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert [chosen_filter(wanted) for wanted in ("auto", "none")] == ["none", "none"]
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[denoise\].*\[shading.denoise\]"):
        chosen_filter("oidn")
