"""Surfaces with their materials, as a path tracer is given them: nothing of the file formats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.upright import usd_up

UNKNOWN_DIFFUSE = 0.5


@dataclass(frozen=True, kw_only=True)
class Material:
    """A diffuse term, a specular lobe and emission; each a map over uv, 1 x 1 where constant.

    The rows of a map run from v = 1 down to v = 0, as they lie in image files.

    diffuse    (H, W, 3) float32, reflectance of the diffuse term
    f0         (H, W, 3) float32, specular reflectance at normal incidence; white at the edge
    roughness  (H, W, 1) float32, as UsdPreviewSurface's: its square is the alpha of GGX
    emission   (H, W, 3) float32, radiance that leaves the front of the surface
    wrap       what the maps are beyond uv of 0 to 1: "clamp", "repeat" or "mirror"
    base, metallic   (H, W, 3) and (H, W, 1) float32, of what diffuse and f0 of a metal were mixed;
               None where there is no metal
    lobe       the kind of specular lobe (``transport.brdf``): 0 the paper's, 1 a dielectric's,
               2 a conductor's, 3 a dielectric's with facets after Beckmann
    clear      light passes as if nothing was there, as through a pane
    normal     (H, W, 3) float32, normals in tangent space, x along u, y along v; None where there
               is no such map
    """

    diffuse: Float
    f0: Float
    roughness: Float
    emission: Float
    wrap: str = "clamp"
    base: Float | None = None
    metallic: Float | None = None
    lobe: int = 0
    clear: bool = False
    normal: Float | None = None

    @property
    def emits(self) -> bool:
        return bool((self.emission > 0).any())

    @property
    def unlit(self) -> Material:
        """The same without emission. What reflects nothing either, as an emitter whose reflectance
        nobody could measure, becomes grey: black would be a claim, and a visible one."""
        unknown = not self.diffuse.any()
        diffuse = constant_map(UNKNOWN_DIFFUSE) if unknown else self.diffuse
        return replace(self, diffuse=diffuse, emission=constant_map(0.0))


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A triangle mesh of one material.

    name            prim path, or file name
    points          (V, 3) float64 metres
    triangles       (F, 3) int32, counter-clockwise seen from the front
    corner_normals  (F, 3, 3) float32 unit vectors
    corner_uv       (F, 3, 2) float32, v up; None where the material has no maps
    corner_colour   (F, 3, 3) float32, reflectance of the diffuse term in place of the diffuse map,
                    which is 1 then; None where that holds
    corner_f0       (F, 3, 3) float32 in place of the map of f0; None where that holds
    two_sided       False if the back is black
    """

    name: str
    points: Double
    triangles: Int
    corner_normals: Float
    corner_uv: Float | None = None
    corner_colour: Float | None = None
    corner_f0: Float | None = None
    material: Material
    two_sided: bool = True

    @property
    def bounds(self) -> Double:
        """(2, 3): least and greatest corner of the triangles."""
        used = self.points[self.triangles].reshape(-1, 3)
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def moved(self, world_from_here: Double) -> Surface:
        """The surface under an affine map (4, 4) of column vectors; a mirroring one keeps the
        front in front."""
        linear = world_from_here[:3, :3]
        points = self.points @ linear.T + world_from_here[:3, 3]
        turned: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("triangles", "corner_normals", "corner_uv", "corner_colour", "corner_f0")
        }
        # The cofactors are the inverse's transpose times the determinant, and are there where a
        # surface is flattened, too.
        cofactors = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
        normals = self.corner_normals @ cofactors.T * (-1 if np.linalg.det(linear) < 0 else 1)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        turned["corner_normals"] = np.asarray(normals / np.maximum(length, 1e-30), np.float32)
        if np.linalg.det(linear) < 0:
            turned = {
                name: None if values is None else np.ascontiguousarray(values[:, [0, 2, 1]])
                for name, values in turned.items()
            }
        return replace(self, points=points, **turned)


def turned_up(model_up: str, scene_up: str) -> Double:
    """(4, 4) rotation about x that brings one up axis, "Y" or "Z", to the other; a model with
    another up is brought to one of these first, as captures are."""
    model_up, first = usd_up(model_up)
    turn = np.eye(4)
    if model_up != scene_up:
        sign = 1.0 if scene_up == "Z" else -1.0
        turn[1:3, 1:3] = [[0.0, -sign], [sign, 0.0]]
    turn[:3, :3] = turn[:3, :3] @ first
    return turn


def constant_map(*value: float) -> Float:
    """A 1 x 1 map; one value alone stands for all of three channels."""
    channels = value * 3 if len(value) == 1 else value
    return np.array(channels, np.float32).reshape(1, 1, -1)


def zoomed(image: Float, height: int, width: int) -> Float:
    """The map at another resolution, nearest texel."""
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    return np.asarray(image[rows][:, columns])


def normal_reflectance(ior: float) -> np.float32:
    """Specular reflectance of a dielectric at normal incidence, against air."""
    return np.float32(((1 - ior) / (1 + ior)) ** 2)


def preview_material(
    *,
    diffuse: Float,
    metallic: Float,
    roughness: Float,
    emission: Float,
    ior: float = 1.5,
    specular: Float | None = None,
    dielectric: Float | None = None,
) -> Material:
    """The material of UsdPreviewSurface's inputs (its specification, "Core Nodes").

    Metallic workflow: F0 = mix(((1 - ior) / (1 + ior))^2, diffuse, metallic), and metal has no
    diffuse term. Specular workflow, where ``specular`` (H, W, 3) is given: F0 is that colour.

    dielectric  (1, 1, 3), in place of what ``ior`` says
    """
    if dielectric is None:
        dielectric = constant_map(float(normal_reflectance(ior)))
    f0 = dielectric if specular is None else specular
    plain = Material(diffuse=diffuse, f0=f0, roughness=roughness, emission=emission)
    # The usual case, and the diffuse map may be large.
    if specular is not None or not metallic.any():
        return plain
    height, width = np.maximum(diffuse.shape[:2], metallic.shape[:2])
    base, metallic = zoomed(diffuse, height, width), zoomed(metallic, height, width)
    mixed = np.asarray(dielectric + metallic * (base - dielectric), np.float32)
    diffuse = np.asarray(base * (1 - metallic), np.float32)
    return replace(plain, diffuse=diffuse, f0=mixed, base=base, metallic=metallic)


def with_corner_colours(
    surface: Surface, colours: Float, metallic: float, dielectric: Float
) -> Surface:
    """The surface in base colours (F, 3, 3) of its corners, in place of its map of them; what is
    metal of it, a share ``metallic``, reflects them in its lobe, and the rest diffusely, of which
    ``dielectric`` (1, 1, 3) is F0."""
    material = replace(surface.material, diffuse=constant_map(1.0))
    if not metallic:
        return replace(surface, material=material, corner_colour=colours, corner_f0=None)
    f0 = np.asarray(dielectric + np.float32(metallic) * (colours - dielectric), np.float32)
    mean = constant_map(*(float(value) for value in f0.reshape(-1, 3).mean(axis=0)))
    return replace(
        surface,
        corner_colour=colours * np.float32(1 - metallic),
        corner_f0=f0,
        material=replace(material, f0=mean),
    )


def corner_base_colours(surface: Surface) -> Float | None:
    """What ``with_corner_colours`` was given."""
    metallic = surface.material.metallic
    if surface.corner_f0 is None or surface.corner_colour is None or metallic is None:
        return surface.corner_colour
    share = metallic.flat[0]
    return surface.corner_f0 if share == 1 else surface.corner_colour / np.float32(1 - share)
