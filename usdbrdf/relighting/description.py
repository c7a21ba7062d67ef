"""A scene in the words of Mitsuba 3's own plug-ins, as plain dictionaries: what its ``load_dict``
takes, but for arrays in the place of pictures and transforms. ``render`` loads them; ``scene_file``
writes them as XML."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import DistantLight, Light, RelitScene, ShapeLight
from usdbrdf.model.material import Surface
from usdbrdf.model.mesh import doubled_areas
from usdbrdf.transport.brdf import BECKMANN
from usdbrdf.transport.renderer_match import matching_factor

Plain = dict[str, Any]

# Share of the samples that go to the lobe where Mitsuba mixes two BSDFs.
_GLOSSY_SHARE = 0.3
# A disc in the sky stands this many scene radii away: its direction then varies by a thousandth.
_SKY_RADII = 1000.0
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_NEAR_M, _FAR_M = 1e-3, 1e6


def integrator(bounces: int) -> Plain:
    """A path tracer that follows ``bounces`` reflections."""
    # Of the vertices of a path the first is what the camera sees.
    return {"type": "path", "max_depth": bounces + 1, "rr_depth": 5}


def extent(scene: RelitScene) -> tuple[Double, float]:
    """Middle (3,) and radius in metres of what is not infinitely far."""
    bounds = [surface.bounds for surface in scene.surfaces]
    shapes = [light for light in scene.lights if isinstance(light, ShapeLight)]
    bounds += [np.stack([light.world_from_here[:3, 3]] * 2) for light in shapes]
    both = np.array(bounds or [np.zeros((2, 3))])
    low, high = both[:, 0].min(axis=0), both[:, 1].max(axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)


def emitter(surface: Surface) -> Plain:
    """What makes a surface glow."""
    material = surface.material
    # Luminance that leaves the surface, up to pi; a map counts with the mean of its texels.
    area = float(doubled_areas(surface.points, surface.triangles).sum()) / 2
    weight = max(area * _mean_luminance(material.emission), 1e-12)
    radiance = texture(material.emission, material.wrap, "radiance")
    return {"type": "area", "radiance": radiance, "sampling_weight": weight}


def corner_attributes(surface: Surface) -> dict[str, Float | None]:
    """Colours of corners, by the names that textures know them by."""
    return {"vertex_colour": surface.corner_colour, "vertex_f0": surface.corner_f0}


def two_of_mitsuba(surface: Surface) -> Plain:
    """(1 - s) * Lambert / (1 - s) + s * GGX / s: the sum of both, sampled by the share s."""
    material, matte = surface.material, 1 / (1 - _GLOSSY_SHARE)
    diffuse = reflectance(surface, "vertex_colour", material.diffuse, matte)
    grey = float(np.clip(material.f0.reshape(-1, 3).mean(axis=0).mean(), 1e-6, 0.98))
    eta = (1 + math.sqrt(grey)) / (1 - math.sqrt(grey))
    # The lobe of renderers is Mitsuba's already.
    phi = float(material.roughness.mean()) ** 2
    matching = 1.0 if material.lobe else matching_factor(phi, grey)
    glossy = matching / grey / _GLOSSY_SHARE
    conductor = {
        "type": "roughconductor",
        "distribution": "beckmann" if material.lobe == BECKMANN else "ggx",
        "alpha": texture(np.maximum(material.roughness**2, 1e-3), material.wrap, "number"),
        "eta": {"type": "rgb", "value": eta},
        "k": {"type": "rgb", "value": 0.0},
        "specular_reflectance": reflectance(surface, "vertex_f0", material.f0, glossy),
    }
    return {
        "type": "blendbsdf",
        "weight": _GLOSSY_SHARE,
        "matte": {"type": "diffuse", "reflectance": diffuse},
        "glossy": conductor,
    }


def reflectance(surface: Surface, attribute: str, image: Float, factor: float = 1.0) -> Plain:
    """The colours of the corners where there are such, else a map."""
    if corner_attributes(surface)[attribute] is not None:
        return {"type": "mesh_attribute", "name": attribute, "scale": factor}
    return texture(image * np.float32(factor), surface.material.wrap)


def texture(image: Float, wrap: str = "clamp", kind: str = "reflectance") -> Plain:
    """A map of 1 or 3 channels as a texture; texels at pixel centres, bilinear.

    kind  "reflectance", "radiance" or "number"
    """
    if image.shape[:2] == (1, 1):
        if kind == "number":
            return {"type": "uniform", "value": float(image[0, 0, 0])}
        # Mitsuba refuses a constant reflectance above 1; as a map it may have any value.
        if kind == "radiance" or image.max() <= 1:
            return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(image[0, 0], 3)]}
    # Mitsuba's v points down the rows of a picture.
    picture = np.ascontiguousarray(image[::-1], np.float32)
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": wrap}


def _mean_luminance(image: Float) -> float:
    return float(image.reshape(-1, 3).mean(axis=0) @ _LUMINANCE)


def light(given: Light, centre: Double, radius: float) -> Plain:
    """A light of a scene of this ``extent``."""
    if isinstance(given, ShapeLight):
        return _shape_light(given)
    if isinstance(given, DistantLight):
        return _distant_light(given, centre, radius)
    power = 4 * math.pi * radius**2 * _mean_luminance(given.image)
    weight = {"sampling_weight": max(power, 1e-12)}
    if given.image.shape[:2] == (1, 1):
        return {"type": "constant", "radiance": texture(given.image, kind="radiance"), **weight}
    pose = np.eye(4)
    pose[:3, :3] = given.world_from_here
    picture = np.ascontiguousarray(given.image, np.float32)
    return {"type": "envmap", "bitmap": picture, "to_world": pose, **weight}


def _shape_light(given: ShapeLight) -> Plain:
    to_world = given.world_from_here
    edges = np.linalg.norm(to_world[:3, :3], axis=0)
    area = {"rectangle": 4.0, "disk": math.pi, "sphere": 4 * math.pi}[given.kind]
    if given.kind == "sphere":  # Mitsuba's takes no rotation and no uneven scale
        to_world = np.diag([*(np.cbrt(edges.prod()),) * 3, 1.0])
        to_world[:3, 3] = given.world_from_here[:3, 3]
    weight = max(area * edges[0] * edges[1] * _mean_luminance(given.emission), 1e-12)
    radiance = texture(given.emission, kind="radiance")
    return _area_light(given.kind, to_world, radiance, float(weight))


def _area_light(kind: str, to_world: Double, radiance: Plain, weight: float) -> Plain:
    """A black shape that shines."""
    return {
        "type": kind,
        "to_world": to_world,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance, "sampling_weight": weight},
    }


def _distant_light(given: DistantLight, centre: Double, radius: float) -> Plain:
    irradiance = np.asarray(given.irradiance, np.float64)
    weight = max(float(irradiance @ _LUMINANCE) * radius**2, 1e-12)
    size = math.pi * math.sin(given.half_angle) ** 2
    if size < 1e-9:
        return {
            "type": "directional",
            "direction": [float(value) for value in given.towards],
            "irradiance": {"type": "rgb", "value": irradiance.tolist()},
            "sampling_weight": weight,
        }
    distance = _SKY_RADII * radius
    # A disc whose front, +z, looks the way that the light travels.
    across = np.cross(np.eye(3)[int(np.argmin(np.abs(given.towards)))], given.towards)
    across /= np.linalg.norm(across)
    scale = distance * math.tan(given.half_angle)
    to_world = np.eye(4)
    to_world[:3, 0] = across * scale
    to_world[:3, 1] = np.cross(given.towards, across) * scale
    to_world[:3, 2] = given.towards
    to_world[:3, 3] = centre - distance * given.towards
    radiance = {"type": "rgb", "value": (irradiance / size).tolist()}
    return _area_light("disk", to_world, radiance, weight)


def square_pixels(camera: Camera) -> tuple[int, float]:
    """Rows of a picture of square pixels, and the row of the principal point in it."""
    fx, fy, _, cy = camera.intrinsics
    height = max(1, round(camera.height * fx / fy))
    return height, cy * height / camera.height


def pinhole(camera: Camera, height: int, cy: float) -> Plain:
    """A sensor of square pixels, ``height`` rows of them with the principal point in row cy."""
    fx, _, cx, _ = camera.intrinsics
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / fx))),
        "principal_point_offset_x": float(0.5 - cx / camera.width),
        "principal_point_offset_y": float(0.5 - cy / height),
        "near_clip": _NEAR_M,
        "far_clip": _FAR_M,
        # Mitsuba's cameras look down +z with x to the left.
        "to_world": camera.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]),
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
