"""Surfaces with materials, and lights -> a scene of Mitsuba 3."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.light import DistantLight, Light, RelitScene, ShapeLight, SkyLight
from usdbrdf.model.material import Surface
from usdbrdf.model.mesh import doubled_areas
from usdbrdf.relighting import lobe_plugin
from usdbrdf.transport.renderer_match import matching_factor

# Share of the samples that go to the lobe where Mitsuba mixes two BSDFs.
_GLOSSY_SHARE = 0.3


def bsdf(mi: Any, surface: Surface, *, native: bool | None = None) -> dict[str, Any]:
    """The plugin of a surface's material; ``native`` without Python, as scalar variants need."""
    if native is None:
        native = mi.variant().startswith("scalar")
    plugin = _native(mi, surface) if native else _lobe(mi, surface)
    return {"type": "twosided", "bsdf": plugin} if surface.two_sided else plugin


def radiance_texture(mi: Any, image: Float, wrap: str = "clamp") -> dict[str, Any]:
    """A map of radiance for an emitter."""
    if image.shape[:2] == (1, 1):
        return {"type": "rgb", "value": [float(v) for v in image[0, 0]]}
    return colour_texture(mi, image, wrap)


def colour_texture(mi: Any, image: Float, wrap: str = "clamp") -> dict[str, Any]:
    """A map of 1 or 3 channels as a texture; texels at pixel centres, bilinear."""
    # Mitsuba refuses a constant reflectance above 1; as a map it may have any value.
    if image.shape[:2] == (1, 1) and image.max() <= 1:
        return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(image[0, 0], 3)]}
    return {
        "type": "bitmap",
        # Mitsuba's v points down the rows of a picture.
        "bitmap": mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32)),
        "raw": True,
        "wrap_mode": wrap,
    }


def _diffuse(mi: Any, surface: Surface, factor: float = 1.0) -> dict[str, Any]:
    if surface.corner_colour is not None:
        return {"type": "mesh_attribute", "name": "vertex_colour", "scale": factor}
    return colour_texture(mi, surface.material.diffuse * np.float32(factor), surface.material.wrap)


def _f0(mi: Any, surface: Surface, factor: float = 1.0) -> dict[str, Any]:
    if surface.corner_f0 is not None:
        return {"type": "mesh_attribute", "name": "vertex_f0", "scale": factor}
    return colour_texture(mi, surface.material.f0 * np.float32(factor), surface.material.wrap)


def _lobe(mi: Any, surface: Surface) -> dict[str, Any]:
    lobe_plugin.register(mi)
    material = surface.material
    return {
        "type": lobe_plugin.NAME,
        "diffuse": _diffuse(mi, surface),
        "f0": _f0(mi, surface),
        "phi": _grey_texture(mi, material.roughness**2, material.wrap),
    }


def _grey_texture(mi: Any, image: Float, wrap: str) -> dict[str, Any]:
    if image.shape[:2] == (1, 1):
        return {"type": "uniform", "value": float(image[0, 0, 0])}
    return colour_texture(mi, image, wrap)


def _native(mi: Any, surface: Surface) -> dict[str, Any]:
    """(1 - s) * Lambert / (1 - s) + s * GGX / s: the sum of both, sampled by the share s."""
    material = surface.material
    diffuse = {"type": "diffuse", "reflectance": _diffuse(mi, surface, 1 / (1 - _GLOSSY_SHARE))}
    roughness = float(material.roughness.mean())
    f0 = material.f0.reshape(-1, 3).mean(axis=0)
    grey = float(np.clip(f0.mean(), 1e-6, 0.98))
    eta = (1 + math.sqrt(grey)) / (1 - math.sqrt(grey))
    factor = matching_factor(roughness**2, grey)
    conductor = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": _grey_texture(mi, np.maximum(material.roughness**2, 1e-3), material.wrap),
        "eta": {"type": "rgb", "value": eta},
        "k": {"type": "rgb", "value": 0.0},
        "specular_reflectance": _f0(mi, surface, factor / grey / _GLOSSY_SHARE),
    }
    return {"type": "blendbsdf", "weight": _GLOSSY_SHARE, "matte": diffuse, "glossy": conductor}


# A disc in the sky stands this many scene radii away: its direction then varies by a thousandth.
_SKY_RADII = 1000.0
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def mitsuba_scene(mi: Any, scene: RelitScene, *, bounces: int) -> Any:
    """A loaded scene whose integrator follows ``bounces`` reflections; black where nothing is."""
    low, high = _bounds(scene)
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    parts: dict[str, Any] = {
        "type": "scene",
        # Of the vertices of a path the first is what the camera sees.
        "integrator": {"type": "path", "max_depth": bounces + 1, "rr_depth": 5},
    }
    for i, surface in enumerate(scene.surfaces):
        parts[f"surface_{i}"] = _mesh(mi, surface)
    for i, light in enumerate(scene.lights):
        parts[f"light_{i}"] = _light(mi, light, centre, radius)
    return mi.load_dict(parts, optimize=False)


def _bounds(scene: RelitScene) -> tuple[Double, Double]:
    bounds = [surface.bounds for surface in scene.surfaces]
    bounds += [
        np.stack([light.world_from_here[:3, 3]] * 2)
        for light in scene.lights
        if isinstance(light, ShapeLight)
    ]
    both = np.array(bounds or [np.zeros((2, 3))])
    return both[:, 0].min(axis=0), both[:, 1].max(axis=0)


def _mesh(mi: Any, surface: Surface) -> Any:
    """Every triangle corner is a vertex: normals and uv differ from face to face."""
    corners = surface.points[surface.triangles].reshape(-1, 3)
    count = len(surface.triangles)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf(mi, surface))
    if surface.material.emits:
        weight = _power(surface)
        emission = radiance_texture(mi, surface.material.emission, surface.material.wrap)
        area = {"type": "area", "radiance": emission, "sampling_weight": weight}
        props["emitter"] = mi.load_dict(area)
    mesh = mi.Mesh(
        "surface",
        3 * count,
        count,
        props=props,
        has_vertex_normals=True,
        has_vertex_texcoords=surface.corner_uv is not None,
    )
    if surface.corner_colour is not None:
        mesh.add_attribute("vertex_colour", 3, _flat(surface.corner_colour))
    if surface.corner_f0 is not None:
        mesh.add_attribute("vertex_f0", 3, _flat(surface.corner_f0))
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = _flat(corners)
    buffers["vertex_normals"] = _flat(surface.corner_normals)
    if surface.corner_uv is not None:
        buffers["vertex_texcoords"] = _flat(surface.corner_uv)
    buffers["faces"] = np.arange(3 * count, dtype=np.uint32)
    buffers.update()
    return mesh


def _flat(values: Any) -> Float:
    return np.ascontiguousarray(values, np.float32).ravel()


def _power(surface: Surface) -> float:
    """Luminance that leaves the surface, up to pi; a map counts with the mean of its texels."""
    area = float(doubled_areas(surface.points, surface.triangles).sum()) / 2
    return max(area * _mean_luminance(surface.material.emission), 1e-12)


def _mean_luminance(image: Float) -> float:
    return float(image.reshape(-1, 3).mean(axis=0) @ _LUMINANCE)


def _light(mi: Any, light: Light, centre: Double, radius: float) -> dict[str, Any]:
    if isinstance(light, ShapeLight):
        return _shape_light(mi, light)
    if isinstance(light, SkyLight):
        return _sky_light(mi, light, radius)
    return _distant_light(mi, light, centre, radius)


def _shape_light(mi: Any, light: ShapeLight) -> dict[str, Any]:
    to_world = light.world_from_here
    edges = np.linalg.norm(to_world[:3, :3], axis=0)
    area = {"rectangle": 4.0, "disk": math.pi, "sphere": 4 * math.pi}[light.kind]
    if light.kind == "sphere":  # Mitsuba's takes no rotation and no uneven scale
        to_world = np.diag([*(np.cbrt(edges.prod()),) * 3, 1.0])
        to_world[:3, 3] = light.world_from_here[:3, 3]
    weight = max(area * edges[0] * edges[1] * _mean_luminance(light.emission), 1e-12)
    radiance = radiance_texture(mi, light.emission)
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


def _sky_light(mi: Any, light: SkyLight, radius: float) -> dict[str, Any]:
    power = 4 * math.pi * radius**2 * _mean_luminance(light.image)
    weight = {"sampling_weight": max(power, 1e-12)}
    if light.image.shape[:2] == (1, 1):
        return {"type": "constant", "radiance": radiance_texture(mi, light.image), **weight}
    pose = np.eye(4)
    pose[:3, :3] = light.world_from_here
    bitmap = mi.Bitmap(np.ascontiguousarray(light.image, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(pose), **weight}


def _distant_light(mi: Any, light: DistantLight, centre: Double, radius: float) -> dict[str, Any]:
    irradiance = np.asarray(light.irradiance, np.float64)
    weight = max(float(irradiance @ _LUMINANCE) * radius**2, 1e-12)
    towards = [float(value) for value in light.towards]
    size = math.pi * math.sin(light.half_angle) ** 2
    if size < 1e-9:
        return {
            "type": "directional",
            "direction": towards,
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
