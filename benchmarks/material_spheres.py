"""Spheres of fitted materials as Hydra Storm and Cycles show them, literal and matched.

    USDBRDF_BPY_PYTHON=... python benchmarks/material_spheres.py OUT.png

Columns are materials (phi, psi), under one distant light in the dark. Rows: the fitted lobe and the
diffuse term of the paper, evaluated directly; Storm and Cycles with mapping `measured`; both with
`matched`. Printed as JSON, for each renderer and mapping: relative error of the mean radiance of
each sphere, and the mean of its FLIP against the first row.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from blender import in_blender
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layers.looks import surface
from usdbrdf.asset.preview_lobe import preview_surface_from_fit
from usdbrdf.evaluation.metrics import Pair, flip_maps
from usdbrdf.files.colour import to_display_srgb
from usdbrdf.files.images import read_radiance, write_preview_png
from usdbrdf.transport.brdf import lobe

MATERIALS = ((0.05, 0.5), (0.1, 1.0), (0.3, 0.5), (0.3, 1.0), (0.6, 1.0), (1.0, 0.5))
ALBEDO = (0.30, 0.10, 0.06)
SIDE, DISTANCE = 88, 2000.0  # pixels of a square with a sphere of radius 1; its side is 2.2
UNIT = 2.2 / SIDE
IRRADIANCE = np.pi
TO_LIGHT = np.array([-0.45, 0.55, 0.7]) / np.linalg.norm([-0.45, 0.55, 0.7])
WIDTH = SIDE * len(MATERIALS)
SAMPLES = 64


def main(out: Path) -> None:
    rows = {"fitted": fitted()}
    with tempfile.TemporaryDirectory() as temporary:
        for mapping in ("measured", "matched"):
            folder = Path(temporary) / mapping
            folder.mkdir()
            layer = write_stage(folder / "spheres.usda", mapping)
            rows[f"storm {mapping}"] = storm(layer, folder)
            rows[f"cycles {mapping}"] = cycles(layer, folder)
    shown = {
        name: np.clip(to_display_srgb(row, exposure_scale=1.0), 0, 1).astype(np.float32)
        for name, row in rows.items()
    }
    picture = np.concatenate(list(shown.values()))
    write_preview_png(out, (picture * 255 + 0.5).astype(np.uint8))
    names = list(rows)[1:]
    maps = flip_maps([Pair(shown["fitted"], shown[name]) for name in names], "spheres")
    reference = spheres(rows["fitted"])
    found = {}
    for name, error in zip(names, maps, strict=True):
        relative = spheres(rows[name]) / reference - 1
        flip = error.reshape(SIDE, len(MATERIALS), SIDE).mean(axis=(0, 2))
        found[name] = {
            "radiance": np.round(relative.astype(float), 3).tolist(),
            "flip": np.round(flip.astype(float), 4).tolist(),
        }
    print(json.dumps(found, indent=2))


def spheres(row: np.ndarray) -> np.ndarray:
    """Mean radiance of each sphere's square."""
    return np.asarray(row.reshape(SIDE, len(MATERIALS), SIDE, 3).mean(axis=(0, 2, 3)))


def fitted() -> np.ndarray:
    """(SIDE, WIDTH, 3) radiance by equations 2 to 6, four points per pixel and side."""
    fine, view = 4, np.array([0.0, 0.0, 1.0])
    at = (np.arange(SIDE * fine) + 0.5) / fine * UNIT - 1.1
    x, y = np.meshgrid(at, -at)
    z2 = 1 - x**2 - y**2
    inside = z2 > 0
    normals = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], axis=-1)
    squares = []
    for phi, psi in MATERIALS:
        square = np.zeros((*x.shape, 3))
        for i, j in zip(*np.nonzero(inside & (normals @ TO_LIGHT > 0)), strict=True):
            base, slope = lobe(normals[i, j], TO_LIGHT, view, phi)
            cosine = normals[i, j] @ TO_LIGHT
            square[i, j] = (np.array(ALBEDO) / np.pi + base + psi * slope) * cosine * IRRADIANCE
        squares.append(square.reshape(SIDE, fine, SIDE, fine, 3).mean(axis=(1, 3)))
    return np.concatenate(squares, axis=1).astype(np.float32)


def write_stage(path: Path, mapping: str) -> Path:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/all").GetPrim())
    for number, (phi, psi) in enumerate(MATERIALS):
        shown = preview_surface_from_fit(phi, psi, mapping)
        name = f"/all/m{number}"
        shader = surface(stage.GetRootLayer(), name, roughness=shown.roughness, ior=shown.ior)
        colour = [float(c * shown.diffuse) for c in ALBEDO]
        shader.attributes["inputs:diffuseColor"].default = Gf.Vec3f(*colour)
        mesh = sphere(stage, f"/all/s{number}", (number + 0.5 - len(MATERIALS) / 2) * 2.2)
        binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
        binding.Bind(UsdShade.Material.Get(stage, name))
    light = UsdLux.DistantLight.Define(stage, "/all/light")
    light.CreateAngleAttr(0.5)
    light.CreateIntensityAttr(float(IRRADIANCE / (np.pi * np.sin(np.radians(0.25)) ** 2)))
    turn = Gf.Rotation(Gf.Vec3d(0, 0, 1), Gf.Vec3d(*TO_LIGHT.tolist()))
    light.AddTransformOp().Set(Gf.Matrix4d(turn, Gf.Vec3d(0)))
    camera = UsdGeom.Camera.Define(stage, "/all/camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, DISTANCE))
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.5 * DISTANCE, 2 * DISTANCE))
    camera.CreateFocalLengthAttr(DISTANCE)
    camera.CreateHorizontalApertureAttr(2.2 * len(MATERIALS))
    camera.CreateVerticalApertureAttr(2.2)
    stage.Save()
    return path


def sphere(stage: Usd.Stage, path: str, x: float, steps: int = 96) -> UsdGeom.Mesh:
    """A unit sphere of quadrilaterals with smooth normals, its poles on the y axis."""
    theta, azimuth = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, steps + 1), np.linspace(0, 2 * np.pi, 2 * steps + 1)
    )
    normals = np.stack(
        [np.sin(theta) * np.sin(azimuth), np.cos(theta), np.sin(theta) * np.cos(azimuth)], axis=-1
    )
    index = np.arange(normals[..., 0].size).reshape(theta.shape)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = normals.reshape(-1, 3) + np.array([x, 0, 0])
    mesh.CreatePointsAttr(points.astype(np.float32))
    mesh.CreateNormalsAttr(normals.reshape(-1, 3).astype(np.float32))
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateFaceVertexIndicesAttr(np.stack(corners, axis=-1).ravel().astype(np.int32))
    mesh.CreateFaceVertexCountsAttr(np.full(2 * steps * steps, 4, np.int32))
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh


def storm(layer: Path, folder: Path) -> np.ndarray:
    fine = 3
    frame = {"camera": "/all/camera", "time": 1, "width": fine * WIDTH}
    in_blender(
        "storm_views",
        folder,
        {"layer": str(layer), "frames": [frame | {"out": str(folder / "storm.exr")}]},
    )
    found = read_radiance(folder / "storm.exr")[..., :3]
    return np.asarray(found.reshape(SIDE, fine, WIDTH, fine, 3).mean(axis=(1, 3)), np.float32)


def cycles(layer: Path, folder: Path) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = DISTANCE
    optics = [DISTANCE / UNIT] * 2 + [WIDTH / 2, SIDE / 2]
    view = {"world_from_camera": pose.tolist(), "intrinsics": optics, "resolution": [WIDTH, SIDE]}
    job = {
        "layer": str(layer),
        "views": [view],
        "samples": SAMPLES,
        "denoise": False,
        "surroundings": 0.0,
        "bounces": 0,
        "sun": [*TO_LIGHT.tolist(), IRRADIANCE],
        "out": str(folder),
    }
    in_blender("blender_views", folder, job)
    return read_radiance(folder / "view_00.exr")[..., :3]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
