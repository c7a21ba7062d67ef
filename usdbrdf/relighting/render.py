"""Surfaces with materials, lights and a camera -> mean radiance per pixel, by Mitsuba 3 (extra
``render``), imported only here."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import DistantLight, Light, RelitScene, ShapeLight
from usdbrdf.model.material import Surface
from usdbrdf.model.mesh import doubled_areas
from usdbrdf.relighting import lobe_plugin
from usdbrdf.transport.brdf import CONDUCTOR
from usdbrdf.transport.renderer_match import matching_factor

# Older ones abort the process while they compile Mitsuba's kernels.
_MIN_LLVM = 17
VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
# Share of the samples that go to the lobe where Mitsuba mixes two BSDFs.
_GLOSSY_SHARE = 0.3
# A disc in the sky stands this many scene radii away: its direction then varies by a thousandth.
_SKY_RADII = 1000.0
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# Paths of one pass: bounds the memory of the vectorised path tracer, some 200 bytes a path, and
# gives the bar something to count.
_PATHS_PER_PASS = 1 << 22
_NEAR_M, _FAR_M = 1e-3, 1e6


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
    bounds = [surface.bounds for surface in scene.surfaces]
    shapes = [light for light in scene.lights if isinstance(light, ShapeLight)]
    bounds += [np.stack([light.world_from_here[:3, 3]] * 2) for light in shapes]
    both = np.array(bounds or [np.zeros((2, 3))])
    low, high = both[:, 0].min(axis=0), both[:, 1].max(axis=0)
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    parts: dict[str, Any] = {
        "type": "scene",
        # Of the vertices of a path the first is what the camera sees.
        "integrator": {"type": "path", "max_depth": bounces + 1, "rr_depth": 5},
    }
    # A clear pane would only hide the lights behind it from the rays that look for them.
    for i, surface in enumerate(s for s in scene.surfaces if not s.material.clear):
        parts[f"surface_{i}"] = _mesh(mi, surface)
    for i, light in enumerate(scene.lights):
        parts[f"light_{i}"] = _light(mi, light, centre, radius)
    return mi.load_dict(parts, optimize=False)


def _mesh(mi: Any, surface: Surface) -> Any:
    """Every triangle corner is a vertex: normals and uv differ from face to face."""
    count = len(surface.triangles)
    material = surface.material
    # Scalar variants know no plug-ins in Python.
    scalar = mi.variant().startswith("scalar")
    bsdf = _two_of_mitsuba(mi, surface) if scalar else _fitted_lobe(mi, surface)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf} if surface.two_sided else bsdf)
    if material.emits:
        # Luminance that leaves the surface, up to pi; a map counts with the mean of its texels.
        area = float(doubled_areas(surface.points, surface.triangles).sum()) / 2
        weight = max(area * _mean_luminance(material.emission), 1e-12)
        radiance = _texture(mi, material.emission, material.wrap, "radiance")
        emitter = {"type": "area", "radiance": radiance, "sampling_weight": weight}
        props["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh(
        "surface",
        3 * count,
        count,
        props=props,
        has_vertex_normals=True,
        has_vertex_texcoords=surface.corner_uv is not None,
    )
    for name, values in _corner_attributes(surface).items():
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


def _corner_attributes(surface: Surface) -> dict[str, Float | None]:
    return {"vertex_colour": surface.corner_colour, "vertex_f0": surface.corner_f0}


def _fitted_lobe(mi: Any, surface: Surface) -> dict[str, Any]:
    lobe_plugin.register(mi)
    material = surface.material
    return {
        "type": lobe_plugin.NAME,
        "diffuse": _reflectance(mi, surface, "vertex_colour", material.diffuse),
        "f0": _reflectance(mi, surface, "vertex_f0", material.f0),
        "phi": _texture(mi, material.roughness**2, material.wrap, "number"),
        "lobe": CONDUCTOR if material.lobe and material.metallic is not None else material.lobe,
    }


def _two_of_mitsuba(mi: Any, surface: Surface) -> dict[str, Any]:
    """(1 - s) * Lambert / (1 - s) + s * GGX / s: the sum of both, sampled by the share s."""
    material, matte = surface.material, 1 / (1 - _GLOSSY_SHARE)
    diffuse = _reflectance(mi, surface, "vertex_colour", material.diffuse, matte)
    grey = float(np.clip(material.f0.reshape(-1, 3).mean(axis=0).mean(), 1e-6, 0.98))
    eta = (1 + math.sqrt(grey)) / (1 - math.sqrt(grey))
    # The lobe of renderers is Mitsuba's already.
    phi = float(material.roughness.mean()) ** 2
    matching = 1.0 if material.lobe else matching_factor(phi, grey)
    glossy = matching / grey / _GLOSSY_SHARE
    conductor = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": _texture(mi, np.maximum(material.roughness**2, 1e-3), material.wrap, "number"),
        "eta": {"type": "rgb", "value": eta},
        "k": {"type": "rgb", "value": 0.0},
        "specular_reflectance": _reflectance(mi, surface, "vertex_f0", material.f0, glossy),
    }
    return {
        "type": "blendbsdf",
        "weight": _GLOSSY_SHARE,
        "matte": {"type": "diffuse", "reflectance": diffuse},
        "glossy": conductor,
    }


def _reflectance(
    mi: Any, surface: Surface, attribute: str, image: Float, factor: float = 1.0
) -> dict[str, Any]:
    """The colours of the corners where there are such, else a map."""
    if _corner_attributes(surface)[attribute] is not None:
        return {"type": "mesh_attribute", "name": attribute, "scale": factor}
    return _texture(mi, image * np.float32(factor), surface.material.wrap)


def _texture(
    mi: Any, image: Float, wrap: str = "clamp", kind: str = "reflectance"
) -> dict[str, Any]:
    """A map of 1 or 3 channels as a texture; texels at pixel centres, bilinear.

    kind  "reflectance", "radiance" or "number"
    """
    if image.shape[:2] == (1, 1):
        if kind == "number":
            return {"type": "uniform", "value": float(image[0, 0, 0])}
        # Mitsuba refuses a constant reflectance above 1; as a map it may have any value.
        if kind == "radiance" or image.max() <= 1:
            return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(image[0, 0], 3)]}
    return {
        "type": "bitmap",
        # Mitsuba's v points down the rows of a picture.
        "bitmap": mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32)),
        "raw": True,
        "wrap_mode": wrap,
    }


def _mean_luminance(image: Float) -> float:
    return float(image.reshape(-1, 3).mean(axis=0) @ _LUMINANCE)


def _light(mi: Any, light: Light, centre: Double, radius: float) -> dict[str, Any]:
    if isinstance(light, ShapeLight):
        return _shape_light(mi, light)
    if isinstance(light, DistantLight):
        return _distant_light(mi, light, centre, radius)
    power = 4 * math.pi * radius**2 * _mean_luminance(light.image)
    weight = {"sampling_weight": max(power, 1e-12)}
    if light.image.shape[:2] == (1, 1):
        radiance = _texture(mi, light.image, kind="radiance")
        return {"type": "constant", "radiance": radiance, **weight}
    pose = np.eye(4)
    pose[:3, :3] = light.world_from_here
    bitmap = mi.Bitmap(np.ascontiguousarray(light.image, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(pose), **weight}


def _shape_light(mi: Any, light: ShapeLight) -> dict[str, Any]:
    to_world = light.world_from_here
    edges = np.linalg.norm(to_world[:3, :3], axis=0)
    area = {"rectangle": 4.0, "disk": math.pi, "sphere": 4 * math.pi}[light.kind]
    if light.kind == "sphere":  # Mitsuba's takes no rotation and no uneven scale
        to_world = np.diag([*(np.cbrt(edges.prod()),) * 3, 1.0])
        to_world[:3, 3] = light.world_from_here[:3, 3]
    weight = max(area * edges[0] * edges[1] * _mean_luminance(light.emission), 1e-12)
    radiance = _texture(mi, light.emission, kind="radiance")
    return _area_light(light.kind, mi.ScalarTransform4f(to_world), radiance, float(weight))


def _area_light(
    kind: str, to_world: Any, radiance: dict[str, Any], weight: float
) -> dict[str, Any]:
    """A black shape that shines."""
    return {
        "type": kind,
        "to_world": to_world,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance, "sampling_weight": weight},
    }


def _distant_light(mi: Any, light: DistantLight, centre: Double, radius: float) -> dict[str, Any]:
    irradiance = np.asarray(light.irradiance, np.float64)
    weight = max(float(irradiance @ _LUMINANCE) * radius**2, 1e-12)
    size = math.pi * math.sin(light.half_angle) ** 2
    if size < 1e-9:
        return {
            "type": "directional",
            "direction": [float(value) for value in light.towards],
            "irradiance": {"type": "rgb", "value": irradiance.tolist()},
            "sampling_weight": weight,
        }
    distance = _SKY_RADII * radius
    origin = centre - distance * light.towards
    up = np.eye(3)[int(np.argmin(np.abs(light.towards)))]
    frame = mi.ScalarTransform4f().look_at(
        origin=origin.tolist(), target=centre.tolist(), up=up.tolist()
    )
    scale = distance * math.tan(light.half_angle)
    to_world = frame @ mi.ScalarTransform4f().scale([scale, scale, 1.0])
    radiance = {"type": "rgb", "value": (irradiance / size).tolist()}
    return _area_light("disk", to_world, radiance, weight)


def render_view(
    mi: Any, scene: Any, camera: Camera, *, samples: int, seed: tuple[int, ...], label: str
) -> tuple[Float, ...]:
    """``samples`` paths per pixel; equal seeds give equal noise. (H, W, 3) float32 each: radiance,
    the mean over each pixel's square; and what a denoiser looks at: albedo of the first surface, in
    [0, 1], and its shading normal."""
    fx, fy, _, cy = camera.intrinsics
    # Mitsuba's pixels are square: others are rendered so, and their rows gathered afterwards.
    height = max(1, round(camera.height * fx / fy))
    stretch = height / camera.height
    sensor = pinhole(mi, camera, height, cy * stretch)
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
