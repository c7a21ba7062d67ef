"""Surfaces with materials, lights and a camera -> mean radiance per pixel, by Mitsuba 3 (extra
``render``), imported only here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import RelitScene
from usdbrdf.model.material import Surface
from usdbrdf.relighting import description, lobe_plugin
from usdbrdf.transport.brdf import CONDUCTOR

# Older ones abort the process while they compile Mitsuba's kernels.
_MIN_LLVM = 17
VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
# Paths of one pass: bounds the memory of the vectorised path tracer, some 200 bytes a path, and
# gives the bar something to count.
_PATHS_PER_PASS = 1 << 22


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


def mitsuba_scene(mi: Any, scene: RelitScene, *, bounces: int) -> Any:
    """A loaded scene whose integrator follows ``bounces`` reflections; black where nothing is."""
    reflects = any(s.material.diffuse.any() or s.material.f0.any() for s in scene.surfaces)
    # Where all only glow, as before materials are fitted, no light is looked for: Mitsuba compiles
    # that for every glowing mesh, minutes for hundreds.
    seen_alone = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
    integrator = description.integrator(bounces) if reflects else seen_alone
    parts: dict[str, Any] = {"type": "scene", "integrator": integrator}
    # A clear pane would only hide the lights behind it from the rays that look for them.
    for i, surface in enumerate(s for s in scene.surfaces if not s.material.clear):
        parts[f"surface_{i}"] = _mesh(mi, surface)
    extent = description.extent(scene)
    for i, light in enumerate(scene.lights):
        parts[f"light_{i}"] = _loadable(mi, description.light(light, *extent))
    return mi.load_dict(parts, optimize=False)


def _loadable(mi: Any, plain: Mapping[str, Any]) -> dict[str, Any]:
    """What ``load_dict`` takes, of a description."""

    def loadable(name: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return _loadable(mi, value)
        if isinstance(value, np.ndarray):
            return mi.Bitmap(value) if name == "bitmap" else mi.ScalarTransform4f(value)
        return value

    return {name: loadable(name, value) for name, value in plain.items()}


def _mesh(mi: Any, surface: Surface) -> Any:
    # Scalar variants know no plug-ins in Python.
    scalar = mi.variant().startswith("scalar")
    bsdf = description.two_of_mitsuba(surface) if scalar else _fitted_lobe(mi, surface)
    props = mi.Properties()
    twosided = {"type": "twosided", "bsdf": bsdf} if surface.two_sided else bsdf
    props["bsdf"] = mi.load_dict(_loadable(mi, twosided))
    if surface.material.emits:
        props["emitter"] = mi.load_dict(_loadable(mi, description.emitter(surface)))
    return mesh_of_surface(mi, surface, props)


def mesh_of_surface(mi: Any, surface: Surface, props: Any) -> Any:
    """A mesh with these properties. Every triangle corner is a vertex: normals and uv differ from
    face to face."""
    count = len(surface.triangles)
    mesh = mi.Mesh(
        "surface",
        3 * count,
        count,
        props=props,
        has_vertex_normals=True,
        has_vertex_texcoords=surface.corner_uv is not None,
    )
    for name, values in description.corner_attributes(surface).items():
        if values is not None:
            mesh.add_attribute(name, 3, _flat(values))
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = _flat(surface.points[surface.triangles])
    buffers["vertex_normals"] = _flat(surface.corner_normals)
    if surface.corner_uv is not None:
        buffers["vertex_texcoords"] = _flat(surface.corner_uv)
    buffers["faces"] = np.arange(3 * count, dtype=np.uint32)
    buffers.update()
    return mesh


def _flat(values: Any) -> Float:
    return np.ascontiguousarray(values, np.float32).ravel()


def _fitted_lobe(mi: Any, surface: Surface) -> dict[str, Any]:
    lobe_plugin.register(mi)
    material = surface.material
    return {
        "type": lobe_plugin.NAME,
        "diffuse": description.reflectance(surface, "vertex_colour", material.diffuse),
        "f0": description.reflectance(surface, "vertex_f0", material.f0),
        "phi": description.texture(material.roughness**2, material.wrap, "number"),
        "lobe": CONDUCTOR if material.lobe and material.metallic is not None else material.lobe,
    }


def render_view(
    mi: Any, scene: Any, camera: Camera, *, samples: int, seed: tuple[int, ...], label: str
) -> tuple[Float, ...]:
    """``samples`` paths per pixel; equal seeds give equal noise. (H, W, 3) float32 each: radiance,
    the mean over each pixel's square; and what a denoiser looks at: albedo of the first surface, in
    [0, 1], and its shading normal."""
    # Mitsuba's pixels are square: others are rendered so, and their rows gathered afterwards.
    height, cy = description.square_pixels(camera)
    sensor = pinhole(mi, camera, height, cy)
    integrator = mi.load_dict(
        {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "path": scene.integrator()}
    )
    at_a_time = max(1, min(samples, _PATHS_PER_PASS // (camera.width * height)))
    counts = [min(at_a_time, samples - done) for done in range(0, samples, at_a_time)]
    states = np.random.SeedSequence(seed).generate_state(len(counts))
    total = np.zeros((height, camera.width, 9))
    passes = list(zip(counts, states, strict=True))
    for count, state in progress(passes, total=len(passes), label=label, unit="passes"):
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=int(state))
        total += count * np.array(image, np.float64)[..., -9:]
    mean = _rows_gathered(total / samples, camera.height)
    if not np.isfinite(mean).all():
        raise EnvironmentFailure(
            f"{label}: the renderer returned values that are not finite. Look for extreme "
            "materials or lights in the stage. [relight.nonfinite]"
        )
    radiance, albedo, normal = np.split(mean.astype(np.float32), 3, axis=2)
    bounded = np.maximum(radiance, 0), np.clip(albedo, 0, 1), np.clip(normal, -1, 1)
    return tuple(np.ascontiguousarray(each) for each in bounded)


def pinhole(mi: Any, camera: Camera, height: int, cy: float) -> Any:
    """A sensor of square pixels, see ``description.pinhole``."""
    return mi.load_dict(_loadable(mi, description.pinhole(camera, height, cy)))


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
