"""COLMAP: a model, text or binary, its images, and a mesh beside.

::

    CAPTURE/
      sparse/0/ or sparse/ or the folder itself     cameras and images, distorted or not; else any
                                                    folder that holds a model and nothing else
      images/, input/, images_2/ ...                as the model names them, in subfolders too;
                                                    else the only other folder that holds them,
                                                    none of normals, depths or masks
      dense/ or dense/0/ ...: sparse/, images/      what image_undistorter writes: used where the
                                                    distorted images are not there
      distorted/sparse/0, input/                    what those had before them, who train splats
      mesh.ply, meshed-poisson.ply, ...             in one of these folders, or by --mesh

A model's poses are camera from world, with a camera whose x points right, y down and z forward;
its world has neither scale nor a direction up. Each model goes with the images beside it: the
distorted model with undistorted images would bend them a second time.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.named_pictures import Pictured, scan_of
from usdbrdf.capture.mesh_frames import (
    mask_beside,
    mesh_beside,
    path_in_capture,
    scene_above,
    why_elsewhere,
)
from usdbrdf.capture.parts import geometry_from_file
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.images import image_size
from usdbrdf.files.paths import seen_of
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Curve, Lens, whole_sphere
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import ColmapCamera, ColmapModel, colmap_model, model_files

NAME = "colmap"
DESCRIPTION = DESCRIPTIONS[NAME]
# Workspaces below the capture, as COLMAP and those who follow it lay them out; where the model lies
# in a workspace; and where its images do.
_WORKSPACES = ("", "dense", "dense/0", "colmap_dense", "undistorted", "colmap", "distorted")
_MODELS = ("", "sparse/0", "sparse", "colmap_sparse/0", "colmap_text")
_IMAGES = ("images", "input", "", "images_2", "images_4", "images_8")
# What scaled-down copies of images are in.
_REDUCED = re.compile(r"(^|/)images_\d+$")
# How deep in the capture other folders of images are looked for, and of models; what lies beside
# these.
_BELOW, _MODELS_BELOW = ("*/", "*/*/"), ("*/", "*/*/", "*/*/*/")
_BESIDE_MODELS = frozenset((".bin", ".txt", ".db", ".ini", ".ply", ".json", ".yaml", ".log"))
# Words in the names of folders whose pictures are no photographs, although they are called as these
# are.
_LAYERS = re.compile(
    r"(?<![a-z])(depth|normals|normal_?maps?|masks?|semantics?|segment|seg(?![a-z])|labels?(?![a-z])"
    r"|instances?(?![a-z])|albedo|roughness|metallic|confidence|disparit|thumb|preview)",
    re.IGNORECASE,
)
# The last two are what COLMAP's own meshers write; fused.ply is a point cloud.
_MESHES = (
    "mesh.ply", "mesh.obj", "mesh.glb", "mesh.usd", "mesh.usda", "mesh.usdc",
    "textured.obj", "meshed-poisson.ply", "meshed-delaunay.ply",
)  # fmt: skip
_CURVES: dict[str, Curve] = {
    "FOV": "fov", "SIMPLE_DIVISION": "division", "DIVISION": "division", "EUCM": "eucm",
}  # fmt: skip


def matches(path: Path) -> bool:
    """A folder with a model in one of the usual places."""
    return path.is_dir() and next(iter(_workspaces(path)), None) is not None


def read(path: Path, options: CaptureOptions) -> Scan:
    path = path.resolve()
    findings = Findings()
    chosen = _chosen(path, options, findings)
    records = _records(path, chosen, options, findings)
    up_axis = up_axis_assumed(records, options, findings, path.name)
    if options.meters_per_unit is None or options.up_axis is None:
        findings.warn(
            f"{path.name}: a COLMAP model has no scale and no direction up; taken are metres and "
            f"{up_axis}. State them with --meters-per-unit and --up-axis. [colmap.scale]"
        )
    objects = path_in_capture(path, "objects.json", options)

    def geometry() -> ScanGeometry:
        mesh = options.mesh or _mesh(path, scene_above(chosen.folder / "images"), options)
        labels = options.objects or (objects if objects.is_file() else None)
        found = geometry_from_file(mesh, labels, options, findings, capture_root=path)
        if why := why_elsewhere(found.mesh, chosen.folder):
            findings.warn(f"{mesh.name}: {why}. [mesh.frame]")
        return found

    return scan_of(
        records,
        geometry,
        options,
        findings,
        adapter=NAME,
        source=path,
        folder=path,
        up_axis=up_axis,
    )


def lens_of(camera: ColmapCamera) -> tuple[Lens, tuple[float, float, float, float]]:
    """Our lens and intrinsics for a camera of any of COLMAP's models (its ``models.h``)."""
    model, numbers = camera.model, camera.parameters
    if model == "EQUIRECTANGULAR":
        return Lens(curve="equirectangular"), whole_sphere(*camera.resolution)
    one = model.startswith("SIMPLE_") or model in ("RADIAL", "RADIAL_FISHEYE")
    fx, *rest = numbers
    fy, cx, cy, *k = [fx, *rest] if one else rest
    curve: Curve = "fisheye" if model.endswith("FISHEYE") else "perspective"
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        lens = PINHOLE
    elif model in _CURVES:
        lens = Lens(curve=_CURVES[model], shape=tuple(k))
    elif model in ("OPENCV", "FULL_OPENCV"):
        lens = Lens(radial=(*k[:2], *k[4:5]), divisor=tuple(k[5:]), tangential=(k[2], k[3]))
    elif model == "THIN_PRISM_FISHEYE":
        lens = Lens(
            curve="fisheye",
            radial=(*k[:2], *k[4:6]),
            tangential=(k[2], k[3]),
            prism=(k[6], 0.0, k[7], 0.0),
        )
    elif model == "RAD_TAN_THIN_PRISM_FISHEYE":
        lens = Lens(
            curve="fisheye",
            radial=tuple(k[:6]),
            tangential=(k[7], k[6]),
            prism=(k[8], k[9], k[10], k[11]),
            radial_first=True,
        )
    elif "RADIAL" in model or model.endswith("FISHEYE"):
        lens = Lens(curve=curve, radial=tuple(k))
    else:
        raise InputRefused(
            f"COLMAP's camera model {model} is not known here. Undistort the images with 'colmap "
            "image_undistorter'. [capture.camera]"
        )
    return lens, (fx, fy, cx, cy)


class _Workspace(NamedTuple):
    """A model's folder, and where its images may lie: one of these folders, in this order."""

    model: Path
    images: tuple[str, ...]


class _Chosen(NamedTuple):
    """A model and the folder of its images, relative to the capture."""

    model: ColmapModel
    folder: Path
    images: str


def _workspaces(path: Path) -> list[_Workspace]:
    """All that are there, the distorted before the undistorted."""
    found = []
    for workspace in _WORKSPACES:
        folders = [path / workspace / name for name in _MODELS]
        # Further reconstructions of images that would not go together.
        folders += sorted((path / workspace / "sparse").glob("[1-9]*"))
        base = f"{workspace}/" if workspace else ""
        beside = [f"{base}{images}".rstrip("/") for images in _IMAGES]
        if workspace == "colmap":  # as nerfstudio has it
            beside += ["images", *(name for name in _IMAGES if name.startswith("images_"))]
        if workspace == "distorted":
            beside += ["input"]
        elif not workspace and (path / "distorted/sparse").is_dir():
            beside.remove("input")  # what its images were made of
        found += [_Workspace(f, tuple(beside)) for f in folders if model_files(f)]
    # Of any name, if nothing but the model lies there: others may be captures of their own.
    others = (
        f for pattern in _MODELS_BELOW for f in seen_of(path.glob(pattern), below=path) if not found
    )
    return found or [
        _Workspace(f, _IMAGES)
        for f in others
        if _holds_a_model_alone(f) and scene_above(f / "images") is None
    ]


def _holds_a_model_alone(folder: Path) -> bool:
    """Whether there are neither folders nor pictures or meshes beside a model."""
    if folder.name.startswith(".") or not model_files(folder):
        return False
    beside = seen_of(folder.iterdir())
    return all(f.is_file() and f.suffix.lower() in _BESIDE_MODELS for f in beside)


def _chosen(path: Path, options: CaptureOptions, findings: Findings) -> _Chosen:
    """The first model that has images whose size its cameras are for, or the first with images."""
    workspaces = _workspaces(path)
    pictured = Pictured(folder=path, options=options)
    candidates: list[_Chosen] = []
    named, first = 0, ""
    for workspace in workspaces:
        model = colmap_model(workspace.model)
        if not model.names:
            continue
        named += 1
        counts = {
            folder: sum(pictured.of(name, folder) is not None for name in model.names)
            for folder in workspace.images
        }
        counts = _of_full_size(counts)
        if counts:
            images = max(counts, key=counts.__getitem__)
            candidates.append(_Chosen(model, workspace.model, images))
        first = first or model.names[0]
    if not candidates and options.frames is None:
        candidates = _elsewhere(path, workspaces, findings)
    if not candidates:
        pictured.refuse_what_leads_out()
        where = f"{path}: none of the images that the COLMAP model names is there, first {first!r}"
        if not workspaces:
            where = f"{path}: no COLMAP model (cameras and images, .bin or .txt)"
        elif not named:
            raise InputRefused(
                f"{workspaces[0].model}: no image of this COLMAP model has a pose. Have them found "
                "with 'colmap mapper', and name the folder that holds what it writes. "
                "[colmap.model]"
            )
        cure = "Put the model in sparse/0 and the images in images/"
        above = _images_above(path, first)
        cure = f"Name {above}, where they are" if above else f"{cure}, or name theirs by --frames"
        raise InputRefused(f"{where}. {cure}. [colmap.images]")
    fitting = [c for c in candidates if _images_fit(pictured, c, candidates)]
    chosen = (fitting or candidates)[0]
    parts = [c for c in candidates if c.images == chosen.images]
    largest = max(parts, key=lambda c: len(c.model.names))
    if len(parts) > 1:
        findings.warn(
            f"{path.name}: {len(parts)} COLMAP models of the same images; taken is "
            f"{largest.folder.relative_to(path).as_posix()} with most of them, "
            f"{len(largest.model.names)}. [colmap.model]"
        )
    return largest


def _images_above(path: Path, image: str) -> Path | None:
    """The folder above a model's that holds its images in a usual place."""
    above = path.parents[:2] if image else ()
    return next((p for p in above if any((p / f / image).is_file() for f in _IMAGES)), None)


def _of_full_size(counts: dict[str, int]) -> dict[str, int]:
    """Of folders and how many of the images they hold those that hold any: of images_2 and the like
    only where no other does, however many these lack."""
    counts = {folder: count for folder, count in counts.items() if count}
    full = {folder: count for folder, count in counts.items() if not _REDUCED.search(folder)}
    return full or counts


def _elsewhere(path: Path, workspaces: Sequence[_Workspace], findings: Findings) -> list[_Chosen]:
    """The first model with images, by their very names, in one folder of the capture that is none
    of normals, depths or masks; InputRefused where several hold as many."""
    below = (
        p for level in _BELOW for p in seen_of(path.glob(level), below=path) if not p.is_symlink()
    )
    folders = [p.relative_to(path).as_posix() for p in below]
    folders = [folder for folder in folders if not _LAYERS.search(folder)]
    for workspace in workspaces:
        model = colmap_model(workspace.model)
        counts = _of_full_size(
            {f: sum((path / f / name).is_file() for name in model.names) for f in folders}
        )
        found = [folder for folder, count in counts.items() if count == max(counts.values())]
        if len(found) > 1:
            raise InputRefused(
                f"{path}: {', '.join(found[:3])} all hold the images that the COLMAP model names. "
                "Name the folder of the photographs with --frames. [colmap.images]"
            )
        if found:
            which = "only folder that holds" if len(counts) == 1 else "folder that holds most of"
            findings.warn(
                f"{path.name}: the images of the COLMAP model are taken from {found[0]}/, the "
                f"{which} them. [capture.file]"
            )
            return [_Chosen(model, workspace.model, found[0])]
    return []


def _images_fit(pictured: Pictured, one: _Chosen, others: Sequence[_Chosen]) -> bool:
    """Whether the first image that is there has the shape that its camera is for, and is not what
    another model, one of pinholes, calls its own."""
    for k, name in enumerate(one.model.names):
        image = pictured.of(name, one.images)
        if image is None:
            continue
        camera = one.model.cameras[int(one.model.camera_of_image[k])]
        try:
            width, height, _ = image_size(image)
        except ImageRefused:
            continue
        across, down = camera.resolution
        if abs(width * down - height * across) >= across:
            return False
        if not lens_of(camera)[0].bends:
            return True
        for other in others:
            if name in other.model.names and other.images != one.images:
                undistorted = pictured.of(name, other.images)
                theirs = other.model.cameras[0]
                same = undistorted and sha256_of(undistorted) == sha256_of(image)
                if same and not lens_of(theirs)[0].bends:
                    return False
        return True
    return False


def _joined(folder: str, name: str) -> str:
    return f"{folder}/{name}" if folder else name


def _records(
    path: Path, chosen: _Chosen, options: CaptureOptions, findings: Findings
) -> list[FrameRecord]:
    records = []
    pictured = Pictured(folder=path, options=options)
    for k, name in enumerate(chosen.model.names):
        file = pictured.of(name, chosen.images)
        if file is None:
            findings.drop(name, "the image file does not exist", "capture.file")
            continue
        camera = chosen.model.cameras[int(chosen.model.camera_of_image[k])]
        lens, intrinsics = lens_of(camera)
        records.append(
            FrameRecord(
                name=name,
                image_path=file,
                world_from_camera=world_from_camera(chosen.model.camera_from_world[k]),
                intrinsics=intrinsics,
                resolution=camera.resolution,
                lens=lens,
                mask_path=mask_beside(path, name.replace("\\", "/"), options),
            )
        )
    pictured.warn_of_others(findings, path)
    return records


def world_from_camera(camera_from_world: Double) -> Double:
    """(4, 4), OpenGL's axes, from a model's (3, 4), OpenCV's: the inverse, y and z of the camera
    turned round."""
    rotation, translation = camera_from_world[:, :3], camera_from_world[:, 3]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * (1.0, -1.0, -1.0)
    pose[:3, 3] = -rotation.T @ translation
    return pose


def _mesh(path: Path, scene: Path | None, options: CaptureOptions) -> Path:
    """The mesh beside a model, which may be a part of a scene of ScanNet++."""
    for workspace in _WORKSPACES:
        for name in _MESHES:
            mesh = path_in_capture(path, _joined(workspace, name), options)
            if mesh.is_file():
                return mesh
    how = "Make one with 'colmap poisson_mesher'"
    if scene is not None:
        how = f"Name the scene of ScanNet++, {scene}, which has one in scans/"
    return mesh_beside(path, options, how=how)
