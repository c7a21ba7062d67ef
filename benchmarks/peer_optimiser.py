"""Mitsuba's own gradient descent on roughness and specular; used by ``peer.py``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import Lit, Spent, timed
from scipy.ndimage import uniform_filter

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.files.frames import read_frame
from usdbrdf.model.light import RelitScene
from usdbrdf.model.material import Material, Surface, constant_map
from usdbrdf.relighting import render

START = 0.5
_OPTICS = ("to_world", "x_fov", "principal_point_offset_x", "principal_point_offset_y")


class Settings(NamedTuple):
    frames_per_step: int = 8
    paths_per_pixel: int = 1
    learning_rate: float = 0.03
    steps_per_check: int = 15
    full_rate_checks: int = 3
    least_change: float = 0.01
    most_checks: int = 12
    limit_s: float = 900.0


class Check(NamedTuple):
    """After some steps: time so far, phi and psi by label (their means over these steps), and
    whether they have converged."""

    spent: Spent
    values: dict[str, tuple[float, float]]
    converged: bool


class Course(NamedTuple):
    """Time that compiling took, and what was found without it."""

    compiling: Spent
    checks: list[Check]


class Targets(NamedTuple):
    """All frames, equal in size: camera of each, radiance (N, H, W, 3), and weight (N, H, W, 1) of
    squared errors."""

    sensors: list[Any]
    radiance: np.ndarray
    weight: np.ndarray


def optimised(
    mi: Any, asset: Path, lit: Lit, diffuse: str, labels: list[str], settings: Settings
) -> Course:
    """Until it has converged or a limit is reached. Before, uncounted, scene and frames are loaded,
    and one step that is thrown away compiles the kernels.

    diffuse  name of the map (T, 3) that stands for the diffuse radiance, "lit" or "diffuse"
    """
    targets = targets_of(mi, asset, lit, labels)
    scene = scene_of(mi, lit, lit.atlas.light)
    cameras = Cameras(mi, targets, settings.frames_per_step)
    if diffuse != "lit":
        other = scene_of(mi, lit, lit.atlas.map(diffuse))
        targets = targets._replace(
            radiance=targets.radiance + difference(mi, targets, scene, other)
        )
    descent = Descent(mi, scene, targets, cameras, lit, labels, settings)
    _, compiling = timed(descent.step)
    descent.restart()
    cpu, wall = time.process_time(), time.perf_counter()
    checks: list[Check] = []
    means: list[np.ndarray] = []
    while True:
        if len(checks) == settings.full_rate_checks:
            descent.adam.set_learning_rate(settings.learning_rate / 3)
        means.append(np.mean([descent.step() for _ in range(settings.steps_per_check)], axis=0))
        spent = Spent(time.process_time() - cpu, time.perf_counter() - wall)
        converged = len(means) > 1 and np.abs(means[-1] - means[-2]).mean() < settings.least_change
        values = {
            n: (float(a), float(b)) for n, a, b in zip(descent.names, *means[-1], strict=True)
        }
        checks.append(Check(spent, values, bool(converged)))
        steps = len(checks) * settings.steps_per_check
        print(f"peer: {steps} steps, {spent.cpu:.0f} CPU seconds", file=sys.stderr)
        late = spent.wall > settings.limit_s or len(checks) >= settings.most_checks
        if converged or late:
            return Course(compiling, checks)


class Cameras:
    """Several frames side by side as one picture: Mitsuba traces its kernels once for all."""

    def __init__(self, mi: Any, targets: Targets, count: int) -> None:
        height, width = targets.radiance.shape[1:3]
        film = {
            "type": "hdrfilm",
            "width": count * width,
            "height": height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        own = {f"camera_{i}": targets.sensors[i] for i in range(count)}
        # Copies: what a sensor hands out changes with it.
        self.optics = [
            {name: type(value)(value) for name, value in mi.traverse(sensor) if name in _OPTICS}
            for sensor in targets.sensors
        ]
        self.sensor = mi.load_dict(
            {"type": "batch", "film": film, "sampler": {"type": "multijitter"}, **own}
        )
        self.params = mi.traverse(self.sensor)

    def at(self, frames: np.ndarray) -> Any:
        """The sensor that sees these frames."""
        for i, frame in enumerate(frames):
            for name, value in self.optics[frame].items():
                self.params[f"camera_{i}.{name}"] = value
        self.params.update()
        return self.sensor


def in_a_row(pictures: np.ndarray) -> np.ndarray:
    """(n, H, W, C) as (H, n W, C)."""
    return np.concatenate(list(pictures), axis=1)


class Descent:
    """Adam on the mean relative squared error of some frames, other ones in each step."""

    def __init__(
        self,
        mi: Any,
        scene: Any,
        targets: Targets,
        cameras: Cameras,
        lit: Lit,
        labels: list[str],
        settings: Settings,
    ) -> None:
        self.mi, self.scene, self.targets, self.cameras = mi, scene, targets, cameras
        self.settings = settings
        self.params = mi.traverse(scene)
        self.integrator = mi.load_dict({"type": "prb", "max_depth": 2, "rr_depth": 5})
        objects = lit.atlas.scene.objects
        self.numbers = [i for i, obj in enumerate(objects) if obj.label in labels]
        self.names = [objects[i].label for i in self.numbers]
        self.restart()

    def restart(self) -> None:
        import drjit as dr

        self.rng = np.random.default_rng(0)
        self.batches = batches(len(self.targets.radiance), self.settings.frames_per_step, self.rng)
        self.adam = self.mi.ad.Adam(lr=self.settings.learning_rate)
        for name in ("phi", "psi"):
            self.adam[name] = dr.full(self.mi.Float, START, len(self.numbers))

    def step(self) -> np.ndarray:
        """(2, objects): phi and psi after it."""
        import drjit as dr

        mi, adam, frames = self.mi, self.adam, next(self.batches)
        for place, i in enumerate(self.numbers):
            self.params[f"surface_{i}.bsdf.phi.value"] = dr.gather(mi.Float, adam["phi"], place)
            f0 = 0.08 * dr.gather(mi.Float, adam["psi"], place)
            self.params[f"surface_{i}.bsdf.f0.value"] = mi.Color3f(f0)
        self.params.update()
        image = mi.render(
            self.scene, self.params, sensor=self.cameras.at(frames), integrator=self.integrator,
            spp=self.settings.paths_per_pixel,
            seed=int(self.rng.integers(1 << 30)), seed_grad=int(self.rng.integers(1 << 30)),
        )  # fmt: skip
        radiance, weight = (
            mi.TensorXf(in_a_row(values[frames]))
            for values in (self.targets.radiance, self.targets.weight)
        )
        error = dr.square(image - radiance) * weight
        dr.backward(dr.sum(error, axis=None) / len(frames))
        adam.step()
        adam["phi"] = dr.clip(adam["phi"], 0.02, 1)
        adam["psi"] = dr.clip(adam["psi"], 0, 1)
        return np.array([np.array(adam["phi"]), np.array(adam["psi"])])


def batches(count: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Frames in random order, all once before any comes again (but for a rest)."""
    while True:
        order = rng.permutation(count)
        for start in range(0, count - size + 1, size):
            yield order[start : start + size]


def difference(mi: Any, targets: Targets, lit: Any, diffuse: Any) -> np.ndarray:
    """(N, H, W, 3): what the frames would show more if surfaces showed the emission of ``lit``
    instead of that of ``diffuse``.

    What a surface emits also lights the others. So the optimised scene has L_d as emission, and
    with this added to the frames it is as if cameras saw the diffuse radiance in its place.
    """
    seen = mi.load_dict({"type": "prb", "max_depth": 1})

    def picture(scene: Any, sensor: Any) -> np.ndarray:
        return np.array(mi.render(scene, sensor=sensor, integrator=seen, spp=64, seed=0))

    return np.stack([picture(lit, one) - picture(diffuse, one) for one in targets.sensors])


def scene_of(mi: Any, lit: Lit, radiance: np.ndarray) -> Any:
    """Every object with the lobe, phi and psi to be changed, and emission: ``radiance`` (T, 3),
    lamps what shading found."""
    scene, texels = lit.atlas.scene, lit.atlas.texels
    emission = lit.atlas.map_where_present("emission", 3)
    shines = (emission > 0).any(axis=1, keepdims=True)
    radiance = np.where(shines, emission, radiance).astype(np.float32)
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
    return render.mitsuba_scene(mi, relit, bounces=1)


def targets_of(mi: Any, asset: Path, lit: Lit, labels: list[str]) -> Targets:
    """All frames. Pixels of other objects than ``labels`` and on outlines have no weight."""
    frames = frames_from_stage(open_measured(Asset.at(asset)))
    fitted = np.array([obj.label in labels for obj in lit.atlas.scene.objects])
    sensors, radiances, weights = [], [], []
    for k in range(len(frames)):
        pixels = read_frame(frames, k)
        height, width = pixels.valid.shape
        camera = frames.camera(k)
        rays = camera.rays(camera.pixels())
        owner = lit.scene.owner(lit.scene.rays.closest(*rays).face).reshape(height, width)
        good = pixels.valid & (owner >= 0) & fitted[owner] & ~outlines(owner)
        radiance = np.where(good[..., None], np.nan_to_num(pixels.radiance), 0).astype(np.float32)
        # The level around a pixel: its own noise in its own weight would make lobes too weak.
        share = np.maximum(uniform_filter(good.astype(np.float32), 5), 1e-3)
        level = (uniform_filter(radiance.mean(axis=2), 5) / share)[..., None]
        floor = 0.1 * float(np.median(level[good])) if good.any() else 1.0
        weight = good[..., None] / (level + floor) ** 2 / max(int(good.sum()), 1)
        sensors.append(render.pinhole(mi, camera, height, camera.intrinsics[3]))
        radiances.append(radiance)
        weights.append(weight.astype(np.float32))
    return Targets(sensors, np.stack(radiances), np.stack(weights))


def outlines(owner: np.ndarray) -> np.ndarray:
    """(H, W) bool: a neighbour belongs to another object."""
    edge = np.zeros(owner.shape, np.bool_)
    across, down = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
