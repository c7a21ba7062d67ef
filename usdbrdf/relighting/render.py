"""A scene and a camera -> mean radiance per pixel, by Mitsuba 3 (extra ``render``), imported only
here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera

# Older ones abort the process while they compile Mitsuba's kernels.
_MIN_LLVM = 17
VARIANTS = ("llvm_ad_rgb", "scalar_rgb")


def mitsuba_variant(variant: str | None = None) -> Any:
    """The module ``mitsuba`` with its variant set: llvm_ad_rgb where a usable LLVM library is
    found (environment variable DRJIT_LIBLLVM_PATH), else scalar_rgb; or as asked."""
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise EnvironmentFailure(
            "relight needs Mitsuba 3, which is not installed. Run: pip install 'usdbrdf[render]'. "
            "[relight.mitsuba]"
        ) from error
    if variant is None:
        usable = drjit.has_backend(drjit.JitBackend.LLVM)
        usable = usable and drjit.detail.llvm_version()[0] >= _MIN_LLVM
        variant = VARIANTS[0] if usable else VARIANTS[1]
    mitsuba.set_variant(variant)
    # Its log goes to stdout, which belongs to --json.
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


# Paths of one pass: bounds the memory of the vectorised path tracer, some 200 bytes a path, and
# gives the bar something to count.
_PATHS_PER_PASS = 1 << 22
_NEAR_M, _FAR_M = 1e-3, 1e6


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """(H, W, 3) float32 each.

    radiance  mean over each pixel's square
    albedo    of the first surface, in [0, 1], and its shading normal: what a denoiser looks at
    """

    radiance: Float
    albedo: Float
    normal: Float


def render_view(
    mi: Any, scene: Any, camera: Camera, *, samples: int, seed: tuple[int, ...], label: str
) -> Rendered:
    """``samples`` paths per pixel; equal seeds give equal noise."""
    fx, fy, _, cy = camera.intrinsics
    # Mitsuba's pixels are square: others are rendered so, and their rows gathered afterwards.
    height = max(1, round(camera.height * fx / fy))
    stretch = height / camera.height
    sensor = pinhole(mi, camera, height, cy * stretch)
    integrator = mi.load_dict(
        {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "path": scene.integrator()}
    )
    at_a_time = max(1, min(samples, _PATHS_PER_PASS // (camera.width * height)))
    counts = [at_a_time] * (samples // at_a_time)
    if samples % at_a_time:
        counts.append(samples % at_a_time)
    states = np.random.SeedSequence(seed).generate_state(len(counts))
    total = np.zeros((height, camera.width, 9))
    for count, state in progress(
        list(zip(counts, states, strict=True)), total=len(counts), label=label, unit="passes"
    ):
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=int(state))
        total += count * np.array(image, np.float64)[..., -9:]
    mean = _rows_gathered(total / samples, camera.height)
    if not np.isfinite(mean).all():
        raise EnvironmentFailure(
            f"{label}: the renderer returned values that are not finite. Look for extreme "
            "materials or lights in the stage. [relight.nonfinite]"
        )
    radiance, albedo, normal = np.split(mean.astype(np.float32), 3, axis=2)
    return Rendered(
        radiance=np.ascontiguousarray(np.maximum(radiance, 0)),
        albedo=np.ascontiguousarray(np.clip(albedo, 0, 1)),
        normal=np.ascontiguousarray(np.clip(normal, -1, 1)),
    )


def pinhole(mi: Any, camera: Camera, height: int, cy: float) -> Any:
    """A sensor of square pixels, ``height`` rows of them with the principal point in row cy."""
    fx, _, cx, _ = camera.intrinsics
    # Mitsuba's cameras look down +z with x to the left.
    pose = camera.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / fx))),
            "principal_point_offset_x": float(0.5 - cx / camera.width),
            "principal_point_offset_y": float(0.5 - cy / height),
            "near_clip": _NEAR_M,
            "far_clip": _FAR_M,
            "to_world": mi.ScalarTransform4f(pose),
            "sampler": {"type": "multijitter"},
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )


def _rows_gathered(image: Double, height: int) -> Double:
    """The picture with ``height`` rows, each the mean over its share of the given ones."""
    given = len(image)
    if given == height:
        return image
    edges = np.arange(height + 1) * given / height
    starts, stops = edges[:-1, None], edges[1:, None]
    rows = np.arange(given)[None]
    overlap = np.clip(np.minimum(stops, rows + 1) - np.maximum(starts, rows), 0, 1)
    weights = overlap / overlap.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("or,rwc->owc", weights, image))
