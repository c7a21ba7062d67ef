"""Mitsuba's own gradient descent on roughness and specular; used by ``peer.py``."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import Lit, Spent

from usdbrdf.geometry.cameras import camera_rays, pixel_centres
from usdbrdf.relighting import mitsuba_scene, render
from usdbrdf.relighting.surfaces import Material, RelitScene, Surface, constant_map
from usdbrdf.relighting.views import View
from usdbrdf.scan.frame_reading import read_frame
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.read import frames_from_stage, open_measured

START = 0.5


class Settings(NamedTuple):
    frames_per_step: int = 4
    paths_per_pixel: int = 16
    learning_rate: float = 0.03
    least_change: float = 0.01
    most_epochs: int = 12
    limit_s: float = 900.0


class Epoch(NamedTuple):
    """After an epoch: time so far, phi and psi by label (their means over the epoch), converged."""

    spent: Spent
    values: dict[str, tuple[float, float]]
    converged: bool


class Target(NamedTuple):
    """A frame: its camera, radiance (H, W, 3), and weight (H, W, 1) of the squared error."""

    sensor: Any
    radiance: Any
    weight: Any


def optimised(mi: Any, asset: Path, lit: Lit, labels: list[str], settings: Settings) -> list[Epoch]:
    """Epochs until it has converged or a limit is reached. Time counts from the first kernel on,
    its compilation included; scene and frames are loaded before."""
    import drjit as dr

    targets = targets_of(mi, asset, lit, labels)
    scene = scene_of(mi, lit)
    integrator = mi.load_dict({"type": "prb", "max_depth": 2, "rr_depth": 5})
    params = mi.traverse(scene)
    numbers = [i for i, obj in enumerate(lit.atlas.scene.objects) if obj.label in labels]
    names = [lit.atlas.scene.objects[i].label for i in numbers]
    adam = mi.ad.Adam(lr=settings.learning_rate)
    for name in ("phi", "psi"):
        adam[name] = dr.full(mi.Float, START, len(numbers))
    rng = np.random.default_rng(0)
    cpu, wall = time.process_time(), time.perf_counter()
    epochs: list[Epoch] = []
    means: list[np.ndarray] = []
    while True:
        history = []
        if len(epochs) == settings.most_epochs // 2:
            adam.set_learning_rate(settings.learning_rate / 5)
        for batch in batches(len(targets), settings.frames_per_step, rng):
            step(mi, scene, integrator, params, adam, numbers, [targets[i] for i in batch],
                 settings.paths_per_pixel, rng)  # fmt: skip
            history.append(np.array([np.array(adam["phi"]), np.array(adam["psi"])]))
            if time.perf_counter() - wall > settings.limit_s:
                break
        means.append(np.mean(history, axis=0))
        spent = Spent(time.process_time() - cpu, time.perf_counter() - wall)
        converged = len(means) > 1 and np.abs(means[-1] - means[-2]).mean() < settings.least_change
        values = {n: (float(a), float(b)) for n, a, b in zip(names, *means[-1], strict=True)}
        epochs.append(Epoch(spent, values, bool(converged)))
        print(f"peer: epoch {len(epochs)}, {spent.cpu:.0f} CPU seconds", file=sys.stderr)
        late = spent.wall > settings.limit_s or len(epochs) >= settings.most_epochs
        if converged or late:
            return epochs


def batches(count: int, size: int, rng: np.random.Generator) -> list[np.ndarray]:
    return np.array_split(rng.permutation(count), max(1, count // size))


def step(
    mi: Any,
    scene: Any,
    integrator: Any,
    params: Any,
    adam: Any,
    numbers: list[int],
    targets: list[Target],
    paths: int,
    rng: np.random.Generator,
) -> None:
    """One step of Adam on the mean relative squared error of some frames."""
    import drjit as dr

    for target in targets:
        for place, i in enumerate(numbers):
            params[f"surface_{i}.bsdf.phi.value"] = dr.gather(mi.Float, adam["phi"], place)
            f0 = 0.08 * dr.gather(mi.Float, adam["psi"], place)
            params[f"surface_{i}.bsdf.f0.value"] = mi.Color3f(f0)
        params.update()
        image = mi.render(
            scene, params, sensor=target.sensor, integrator=integrator, spp=paths,
            seed=int(rng.integers(1 << 30)), seed_grad=int(rng.integers(1 << 30)),
        )  # fmt: skip
        error = dr.square(image - target.radiance) * target.weight
        dr.backward(dr.sum(error, axis=None) / len(targets))
    adam.step()
    adam["phi"] = dr.clip(adam["phi"], 0.02, 1)
    adam["psi"] = dr.clip(adam["psi"], 0, 1)


def scene_of(mi: Any, lit: Lit) -> Any:
    """Every object with the lobe, phi and psi to be changed, and its L_d as emission."""
    scene, texels = lit.atlas.scene, lit.atlas.texels
    emission = lit.atlas.map_where_present("emission", 3)
    shines = (emission > 0).any(axis=1, keepdims=True)
    radiance = np.where(shines, emission, lit.atlas.map("lit")).astype(np.float32)
    surfaces = []
    for i, obj in enumerate(scene.objects):
        material = Material(
            diffuse=constant_map(0.0),
            f0=constant_map(0.08 * START),
            roughness=constant_map(START**0.5)[..., :1],
            emission=np.ascontiguousarray(texels.image(i, radiance)),
        )
        surfaces.append(
            Surface(
                name=obj.label,
                points=scene.points.astype(np.float64),
                triangles=scene.triangles[obj.faces],
                corner_normals=scene.corner_normals[obj.faces],
                corner_uv=scene.corner_uv[obj.faces],
                material=material,
                two_sided=False,
            )
        )
    relit = RelitScene(surfaces=tuple(surfaces), lights=())
    return mitsuba_scene.mitsuba_scene(mi, relit, bounces=1)


def targets_of(mi: Any, asset: Path, lit: Lit, labels: list[str]) -> list[Target]:
    """All frames. Pixels of other objects than ``labels`` and on outlines have no weight."""
    frames = frames_from_stage(open_measured(Asset.at(asset)))
    fitted = np.array([obj.label in labels for obj in lit.atlas.scene.objects])
    targets = []
    for k in range(len(frames)):
        pixels = read_frame(frames, k)
        height, width = pixels.valid.shape
        pose, lens = frames.world_from_camera[k], frames.intrinsics[k]
        view = View(
            name=str(k), world_from_camera=pose, intrinsics=lens, width=width, height=height
        )
        rays = camera_rays(pose, lens, pixel_centres(width, height))
        owner = lit.scene.owner(lit.scene.rays.closest(*rays).face).reshape(height, width)
        good = pixels.valid & (owner >= 0) & fitted[owner] & ~outlines(owner)
        radiance = np.where(good[..., None], np.nan_to_num(pixels.radiance), 0).astype(np.float32)
        level = radiance.mean(axis=2, keepdims=True)
        floor = 0.1 * float(np.median(level[good])) if good.any() else 1.0
        weight = good[..., None] / (level + floor) ** 2 / max(int(good.sum()), 1)
        sensor = render._sensor(mi, view, height, float(lens[3]))
        targets.append(
            Target(sensor, mi.TensorXf(radiance), mi.TensorXf(weight.astype(np.float32)))
        )
    return targets


def outlines(owner: np.ndarray) -> np.ndarray:
    """(H, W) bool: a neighbour belongs to another object."""
    edge = np.zeros(owner.shape, np.bool_)
    across, down = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
