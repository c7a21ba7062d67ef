"""Somebody else's USD asset, photographed by ourselves, converted, and validated by three.

    python benchmarks/wild_assets.py ASSET.usd OUTPUT [--root DIR] [--frames 20] [--width 160]
        [--height 120] [--texel-size M] [--nvidia nvidia_usd_validate]

The folder that ASSET lies in (or --root, one above it) is copied into OUTPUT/scan and photographed
there: cameras on three rings around the asset, a constant sky and a sun with shadows, albedo from
the asset's own materials (a texture's mean, else displayColor, else grey). `usdbrdf convert` makes
OUTPUT/<name> of it. Printed as JSON: whether the copy is still byte for byte the original; and what
our rules, USD's validators and usd-validation-nvidia find in the result, the errors that the
original has already ("inherited", a count) apart from the others ("ours", all of them).
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Usd, UsdGeom, UsdShade

from usdbrdf.asset.layout import Asset
from usdbrdf.files.colour import to_working_space
from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanGeometry, triangulate
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.usd_files import meshes_from_usd
from usdbrdf.validation.rule import Severity
from usdbrdf.validation.validate import validate

Array = npt.NDArray[Any]

# No surface absorbs a colour wholly, and a channel below the noise floor is no measurement.
GREY, DARKEST = 0.5, 0.02
SKY, SUN = 0.4, np.array([3.0, 2.8, 2.5])  # irradiance on a level surface; on one facing the sun
SATURATION, NOISE_FLOOR, NOISE = 16.0, 1e-4, 0.005
ELEVATIONS_DEG = (-25, 15, 50)
# Of a width of the image; 45 degrees across.
FOCAL = 1.2


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--root", type=Path, help="folder to copy; default: the asset's own")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=120)
    parser.add_argument("--texel-size", type=float, help="metres; default: 1/60 of the asset")
    parser.add_argument("--nvidia", default="nvidia_usd_validate", help="its command")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")
    asset = options.asset.resolve(strict=True)
    root = (options.root or asset.parent).resolve(strict=True)
    if not asset.is_relative_to(root):
        parser.error(f"{asset} is not in {root}. Name a folder above it with --root.")

    scan = options.output / "scan"
    shutil.copytree(root, scan / "asset")
    mesh = scan / "asset" / asset.relative_to(root)
    found = meshes_from_usd(mesh, allow=(scan,))
    size = photograph_all(scan, mesh, found, options)
    texel = options.texel_size or size / 60
    name = asset.stem
    converted = subprocess.run(
        [sys.executable, "-m", "usdbrdf", "convert", str(scan), "-o", str(options.output / name),
         "-q", "--texel-size", f"{texel:.6g}"], capture_output=True, text=True,
    )  # fmt: skip
    report: dict[str, Any] = {
        "asset": name,
        "objects": len(found.objects),
        "triangles": len(found.mesh.triangles),
        "warnings": list(found.warnings),
        "convert": converted.returncode,
        "said": converted.stderr.strip(),
        "input_unchanged": hashes(scan / "asset") == hashes(root),
    }
    if converted.returncode == 0:
        made = Asset.at(options.output / name)
        theirs, ours = default_prim(mesh), f"/{made.name}"
        report["validate"] = sorted_out(
            {in_place(text, theirs, ours) for text in errors(mesh)}, errors(made.root_layer)
        )
        tables = [options.output / f"nvidia_{which}.csv" for which in ("original", "result")]
        found_by_nvidia = [
            nvidia(options.nvidia, layer, table)
            for layer, table in zip((mesh, made.root_layer), tables, strict=True)
        ]
        report["nvidia"] = sorted_out(
            {in_place(text, theirs, ours) for text in found_by_nvidia[0]}, found_by_nvidia[1]
        )
    print(json.dumps(report, indent=1))
    return converted.returncode


def sorted_out(original: set[str], result: set[str]) -> dict[str, Any]:
    return {"inherited": len(result & original), "ours": sorted(result - original)}


def in_place(text: str, theirs: str, ours: str) -> str:
    """A finding about the original, as it reads where its default prim has our name."""
    return re.sub(rf"{re.escape(theirs)}(?=[/.> :]|$)", ours, text)


def default_prim(layer: Path) -> str:
    return str(Usd.Stage.Open(str(layer)).GetDefaultPrim().GetPath())


def hashes(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def errors(layer: Path) -> set[str]:
    """What `usdbrdf validate` calls errors: of our rules and of USD's validators."""
    return {str(item) for item in validate(layer) if item.severity is Severity.ERROR}


def nvidia(command: str, layer: Path, table: Path) -> set[str]:
    """What usd-validation-nvidia calls a failure or an error, each once: it looks at a stage
    once for each of its combinations of variants."""
    # Its messages list sets: equal in both runs only if strings hash the same.
    call = [command, "--csv-output", str(table), str(layer)]
    done = subprocess.run(
        call, capture_output=True, text=True, env={**os.environ, "PYTHONHASHSEED": "0"}
    )
    if not table.is_file():
        sys.exit(f"{' '.join(call)} ended with {done.returncode}: {done.stderr[-300:]}")
    rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return {
        f"{row['Rule']}: {row['Message']} {row['Location']}"
        for row in rows
        if row["Severity"] != "Warning"
    }


def photograph_all(
    scan: Path, mesh: Path, found: ScanGeometry, options: argparse.Namespace
) -> float:
    """All frames, then transforms.json; returns the asset's size in metres."""
    points, triangles = found.mesh.points.astype(np.float64), found.mesh.triangles
    albedo = face_albedo(mesh, found)
    low, high = points[triangles].min(axis=(0, 1)), points[triangles].max(axis=(0, 1))
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    up = np.eye(3)[1 if found.up_axis == "Y" else 2]
    width, height = options.width, options.height
    lens = np.array([FOCAL * width, FOCAL * width, width / 2, height / 2])
    # In metres: rays have an offset of their own near the surface.
    meters = found.meters_per_unit or 1.0
    rays = RayScene((points * meters).astype(np.float32), triangles)
    (scan / "frames").mkdir()
    frames = []
    for k in range(options.frames):
        pose = look_at(place(k, options.frames, up) * 2.6 * radius + middle, middle, up)
        in_metres = pose.copy()
        in_metres[:3, 3] *= meters
        image = radiance(rays, found, albedo, in_metres, lens, (width, height), up)
        noise = np.random.default_rng(k).standard_normal(image.shape)
        name = f"frames/{k:04d}.exr"
        write_exr(scan / name, (image * (1 + NOISE * noise)).astype(np.float32))
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), lens.tolist(), strict=True))
    document = {
        "camera_model": "PINHOLE", "w": width, "h": height, **camera,
        "mesh": mesh.relative_to(scan).as_posix(),
        "exposure_time": 0.02, "saturation_radiance": SATURATION,
        "noise_floor_radiance": NOISE_FLOOR, "frames": frames,
    }  # fmt: skip
    (scan / "transforms.json").write_text(json.dumps(document, indent=1) + "\n")
    return 2 * radius * meters


def place(k: int, frames: int, up: Array) -> Array:
    """Unit vector to the k-th camera: three rings in turn, never twice the same azimuth."""
    turn, rise = 2 * math.pi * k / frames, math.radians(ELEVATIONS_DEG[k % len(ELEVATIONS_DEG)])
    side = np.roll(up, 1)
    ahead = np.cross(up, side)
    return math.cos(rise) * (math.cos(turn) * side + math.sin(turn) * ahead) + math.sin(rise) * up


def look_at(centre: Array, target: Array, up: Array) -> Array:
    """World-from-camera (4, 4), looking down the camera's -z."""
    back = (centre - target) / np.linalg.norm(centre - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose


def radiance(
    rays: RayScene, found: ScanGeometry, albedo: Array, camera: Array, lens: Array,
    size: tuple[int, int], up: Array,
) -> Array:  # fmt: skip
    """(H, W, 3): albedo / pi times the irradiance of sky and sun; black where nothing is."""
    width, height = size
    view = Camera(world_from_camera=camera, intrinsics=tuple(lens), width=width, height=height)
    origins, directions = view.rays(view.pixels())
    hits = rays.closest(origins, directions)
    seen = hits.face >= 0
    image = np.zeros((len(hits.face), 3))
    face = hits.face[seen]
    corner = found.mesh.points[found.mesh.triangles[face]].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    normal *= -np.sign((normal * directions[seen]).sum(axis=1, keepdims=True))
    to_sun = up + 0.5 * np.roll(up, 1) + 0.3 * np.roll(up, 2)
    to_sun /= np.linalg.norm(to_sun)
    where = origins[seen] + hits.distance[seen, None] * directions[seen]
    away = 1e-3 * float(np.median(hits.distance[seen])) if seen.any() else 0.0
    shadow = rays.closest(
        (where + away * normal).astype(np.float32),
        np.tile(to_sun, (len(face), 1)).astype(np.float32),
    )
    sun = np.maximum(normal @ to_sun, 0) * (shadow.face < 0)
    sky = SKY * (1 + normal @ up) / 2
    image[seen] = albedo[face] / math.pi * (sky[:, None] + sun[:, None] * SUN)
    return image.reshape(size[1], size[0], 3)


def face_albedo(mesh: Path, found: ScanGeometry) -> Array:
    """(F, 3) linear albedo of the triangles that ``meshes_from_usd`` made."""
    stage = Usd.Stage.Open(str(mesh))
    parts = []
    for below in found.object_prims:
        root = stage.GetDefaultPrim().GetPath()
        prim = stage.GetPrimAtPath(root if below == "." else root.AppendPath(below))
        geometry, time = UsdGeom.Mesh(prim), Usd.TimeCode.EarliestTime()
        holes = np.array(geometry.GetHoleIndicesAttr().Get(time) or [], np.int32)
        fans = triangulate(
            np.array(geometry.GetFaceVertexCountsAttr().Get(time), np.int32),
            np.array(geometry.GetFaceVertexIndicesAttr().Get(time), np.int32),
            holes=holes,
        )
        own = np.tile(colour_of(prim), (len(fans.polygon), 1))
        for subset in UsdGeom.Subset.GetAllGeomSubsets(geometry):
            chosen = np.isin(fans.polygon, np.array(subset.GetIndicesAttr().Get(time) or []))
            own[chosen] = colour_of(subset.GetPrim())
        parts.append(own)
    return np.maximum(np.concatenate(parts), DARKEST)


def colour_of(prim: Usd.Prim) -> Array:
    """One linear colour of the material that is bound, else displayColor, else grey."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0] if material else None
    diffuse = surface.GetInput("diffuseColor") if surface else None
    if diffuse:
        for attribute in UsdShade.Utils.GetValueProducingAttributes(diffuse):
            shader = UsdShade.Shader(attribute.GetPrim())
            file = shader.GetInput("file") if shader else None
            value = file.Get() if file else attribute.Get()
            if file and value and Path(value.resolvedPath).is_file():
                pixels = read_radiance(Path(value.resolvedPath))
                return to_working_space(pixels, "srgb_rec709_scene").mean(axis=(0, 1))
            if value is not None and not file:
                return np.array(value, np.float64)
    shown = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor").Get()
    return np.array(shown, np.float64).mean(axis=0) if shown else np.full(3, GREY)


if __name__ == "__main__":
    sys.exit(main())
