"""What ingest writes: the weakest layer, the capture as it came, with its meshes, camera and
photographs; and layers without any measurement: root, the artist's edits, those still to come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, UsdGeom

from usdbrdf.asset.header import Draft, Provenance, Scopes, StageHeader, new_layer, read_header
from usdbrdf.asset.layers import input_usd
from usdbrdf.asset.layers.author import (
    apply_schema,
    attribute,
    attribute_per_frame,
    author_fact,
    author_record,
    define,
    export,
    over,
    relationship,
)
from usdbrdf.asset.layout import LIGHTING, ROLES, Asset, relative_path, storable_path
from usdbrdf.asset.properties import LabelledObject, Photographs, facts_of, known_facts
from usdbrdf.asset.readers.scene import LENS
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.files.naming import readable_label
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.mesh import ObjectLabel, ScanMesh, welded

Types = Sdf.ValueTypeNames
APERTURE_MM = 36.0
NEAR_M, FAR_M = 0.01, 1000.0
_VERSION = "1"  # of the folder's layout; these layers outlive the version of the tool


def write_root(path: Path, asset: Asset, header: StageHeader) -> None:
    """NAME.usda: the sublayers, strongest first, and metadata. Written once, never again."""
    layer = new_layer(header, Provenance(role="root", version=_VERSION))
    layer.documentation = (
        "Captured scene with measured materials. Put your own opinions into edits.usda, the "
        "strongest layer: no tool writes it again. The files in layers/ are regenerated."
    )
    layer.subLayerPaths = [
        f"./{asset.edits_layer.name}",
        *(f"./layers/{asset.layer(role).name}" for role in reversed(ROLES)),
    ]
    # Only a root layer can say this. The scan layer may still be waiting beside it, unpublished.
    staged = Asset(path.parent, asset.name)
    scopes = Scopes.of(staged if staged.layer("scan").is_file() else asset)
    layer.pseudoRoot.SetInfo("renderSettingsPrimPath", scopes.path("render", "capture"))
    export(layer, path, folder=asset.folder)


def check_root(asset: Asset, header: StageHeader) -> None:
    """Raise if the asset has a root layer that says otherwise about units or the up axis. USD
    believes the root, which is never written again: a capture in other units would come out in the
    wrong size, beneath edits that were made for the old one."""
    if not asset.root_layer.is_file():
        return
    root = read_header(asset.root_layer)
    ours, theirs = ((h.meters_per_unit, h.up_axis) for h in (root, header))
    if ours != theirs:
        raise OwnershipConflict(
            f"{asset.root_layer}: the asset was made with {ours[0]:g} metres per unit and "
            f"{ours[1]} up, this capture has {theirs[0]:g} and {theirs[1]}. Convert it into a new "
            "folder. [ownership.units]"
        )


def write_edits(path: Path, asset: Asset, header: StageHeader) -> None:
    """edits.usda: empty, for the artist. Written once, never again."""
    export(_no_edits(header), path, folder=asset.folder)


def _no_edits(header: StageHeader) -> Sdf.Layer:
    layer = new_layer(header, Provenance(role="edits", version=_VERSION))
    layer.documentation = "Yours: stronger than everything that was measured, never overwritten."
    over(layer, f"/{header.name}")
    return layer


def is_edited(asset: Asset) -> bool:
    """Whether an artist's edits.usda is another than the one that was written."""
    try:
        empty = _no_edits(read_header(asset.layer("scan"))).ExportToString()
        return bool(asset.edits_layer.read_bytes() != empty.encode("utf-8"))
    except (OSError, InputRefused):
        return True


def write_pending_layer(path: Path, role: str, header: StageHeader) -> None:
    """A layer without opinions, so that the root composes before the task of its role has run."""
    layer = new_layer(header, Provenance(role=role, version=_VERSION), state="pending")
    over(layer, f"/{header.name}")
    export(layer, path, folder=path.parent)


def check_lightings(asset: Asset, lightings: Sequence[str]) -> None:
    """Raise if the asset is there and shows other lightings than these, or none by a name: what
    was made of the others would stay in it. New ones may join."""
    known = asset.recorded_lightings
    if known is None:
        return
    if bool(known) != bool(lightings) or set(known) - set(lightings):
        there = f"has the lightings {', '.join(known)}" if known else "has one lighting"
        new = ", ".join(lightings) if lightings else "one alone"
        raise OwnershipConflict(
            f"{asset.folder}: the asset {there}, and this is to make it {new}. Name its captures "
            "too, or convert into a new folder. [ownership.lightings]"
        )


def write_choice_of_lighting(
    path: Path, role: str, asset: Asset, lightings: Sequence[str], header: StageHeader
) -> None:
    """The layer of a role that is made once for each lighting: the default prim takes the layer of
    the one that is selected, of the variant set ``lighting``; first the first. Beside ``path`` lie
    these layers, or empty ones. What all lightings have in common is a sublayer of texturing.usda.
    """
    layer = new_layer(header, Provenance(role=role, version=_VERSION))
    root = Sdf.Path(f"/{header.name}")
    for name in lightings:
        variant = over(layer, str(root.AppendVariantSelection(LIGHTING, name)))
        own = replace(asset, lighting=name).layer(role)
        variant.referenceList.prependedItems = [Sdf.Reference(f"./{own.name}")]
    if role == "texturing":
        layer.subLayerPaths = [f"./{asset.uv_layer.name}"]
        layer.GetPrimAtPath(root).variantSelections[LIGHTING] = lightings[0]
    export(layer, path, folder=path.parent)


def write_scan_layer(path: Path, scan: Scan, draft: Draft) -> None:
    """Write scan.usdc to ``path``; objects without a face are left out."""
    asset, folder, frames = draft.asset, draft.asset.layer("scan").parent, scan.frames
    stage = input_usd.open_input(scan.usd_geometry) if scan.usd_geometry else None
    source = stage.GetDefaultPrim() if stage else None
    taken = [child.GetName() for child in source.GetAllChildren()] if source else []
    scopes = Scopes.beside(f"/{draft.header.name}", taken)
    meshes = input_usd.input_meshes(source, scan.object_prims, scopes.root) if source else {}
    rivals = partial(input_usd.competing_bindings, source=source, root=scopes.root)
    competing = {at: rivals(mesh) for at, mesh in meshes.items()}
    layer = draft.new_layer(
        adapter=scan.adapter,
        radiometric=frames.radiometric,
        counts=scan.counts,
        objects_from=scan.label_source,
        lightings=list(dict.fromkeys(frames.lightings)) or None,
        scopes=scopes.names,
        competing_bindings=competing or None,
    )
    # A typed root would hide the input's own type.
    root = define(layer, scopes.root, "" if source and source.GetTypeName() else "Xform")
    if not (source and source.HasAuthoredMetadata("kind")):
        root.SetInfo("kind", "assembly")
    identifier = Sdf.AssetPath(f"../{asset.root_layer.name}")
    root.SetInfo("assetInfo", {"identifier": identifier, "name": asset.name})
    apply_schema(root, "ColorSpaceAPI")
    attribute(root, "colorSpace:name", Types.Token, "lin_rec709_scene", uniform=True)
    if source and scan.usd_geometry:
        reference = Sdf.Reference(relative_path(scan.usd_geometry, folder))
        root.referenceList.prependedItems = [reference]
        normals, face_object = scan.mesh.corner_normals, scan.mesh.face_object
        turned = scan.turned_faces
        turned = np.zeros(len(normals), np.bool_) if turned is None else turned
        for i, (at, mesh) in enumerate(meshes.items()):
            input_usd.weaken_bindings(layer, mesh, source, scopes.root)
            own = face_object == i
            input_usd.author_overrides(layer, at, mesh, normals[own], turned[own])
            _author_label(over(layer, at), scan.objects[i], scan.label_source)
    else:
        _author_meshes(layer, scopes, scan)
    define(layer, scopes.path("cameras"), "Scope")
    camera = define(layer, scopes.path("cameras", "capture"), "Camera")
    _author_pose_and_lens(camera, scan, reset_transform=input_usd.has_transform(source))
    _author_capture(camera, frames, folder)
    # Settings that render the capture's own view; the shading layer adds the products.
    define(layer, scopes.path("render"), "Scope")
    settings = define(layer, scopes.path("render", "capture"), "RenderSettings")
    resolution = Gf.Vec2i(frames.resolution[0].tolist())
    attribute(settings, "resolution", Types.Int2, resolution, uniform=True)
    relationship(settings, "camera", scopes.path("cameras", "capture"))
    attribute(settings, "renderingColorSpace", Types.Token, "lin_rec709_scene", uniform=True)
    export(layer, path, folder=folder)


def _author_label(prim: Sdf.PrimSpec, found: ObjectLabel, source: str) -> None:
    """What makes a mesh one of our objects, as USD can hold it."""
    label, class_name = readable_label(found.label), readable_label(found.class_name)
    author_record(
        prim,
        LabelledObject(
            label=label, class_name=class_name, identifier=found.identifier, label_source=source
        ),
    )
    prim.SetInfo("displayName", label)
    if class_name:
        apply_schema(prim, "SemanticsLabelsAPI:class")
        attribute(prim, "semantics:labels:class", Types.TokenArray, [class_name])


def _author_meshes(layer: Sdf.Layer, scopes: Scopes, scan: Scan) -> None:
    # Files split vertices at seams; ours has its normals per corner and needs no copies.
    mesh = welded(scan.mesh)
    geometry = define(layer, scopes.path("geometry"), "Scope")
    geometry.SetInfo("kind", "group")
    order = np.argsort(mesh.face_object, kind="stable")
    bounds = np.searchsorted(mesh.face_object[order], np.arange(len(scan.objects) + 1))
    for i, label in enumerate(scan.objects):
        faces = order[bounds[i] : bounds[i + 1]]
        if len(faces):
            prim = define(layer, scopes.path("geometry", label.identifier), "Mesh")
            prim.SetInfo("kind", "component")
            _author_mesh(prim, mesh, faces)
            _author_label(prim, label, scan.label_source)


def _author_mesh(prim: Sdf.PrimSpec, mesh: ScanMesh, faces: npt.NDArray[np.intp]) -> None:
    """The triangles ``faces`` with only the points that they use."""
    used, corners = np.unique(mesh.triangles[faces], return_inverse=True)
    points = mesh.points[used].astype(np.float32)
    normals = mesh.corner_normals[faces].astype(np.float32).reshape(-1, 3)
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    attribute(prim, "points", Types.Point3fArray, points)
    attribute(prim, "faceVertexCounts", Types.IntArray, np.full(len(faces), 3, np.int32))
    attribute(prim, "faceVertexIndices", Types.IntArray, corners.reshape(-1).astype(np.int32))
    attribute(prim, "normals", Types.Normal3fArray, normals, interpolation="faceVarying")
    attribute(prim, "extent", Types.Float3Array, extent)
    attribute(prim, "subdivisionScheme", Types.Token, UsdGeom.Tokens.none, uniform=True)
    # A scan has holes, and cameras look through them at the backs of things.
    attribute(prim, "doubleSided", Types.Bool, True, uniform=True)


def lens_from_pinhole(
    pinhole: Double, resolution: Sequence[int], meters_per_unit: float
) -> tuple[float, float, float, float, float]:
    """The values of ``LENS``, in tenths of a scene unit, as USD wants them. Only ratios to the
    aperture mean anything, so the aperture is that of a full-frame camera."""
    fx, fy, cx, cy = (float(value) for value in pinhole)
    width, height = (int(value) for value in resolution)
    aperture = APERTURE_MM / (100.0 * meters_per_unit)
    focal = fx * aperture / width
    vertical = focal * height / fy
    offset_x = (width / 2 - cx) * aperture / width
    offset_y = (cy - height / 2) * vertical / height
    return focal, aperture, vertical, offset_x, offset_y


def _author_pose_and_lens(prim: Sdf.PrimSpec, scan: Scan, *, reset_transform: bool) -> None:
    """Frame i is at time code i + 1, and the first is the default as well. The poses are in the
    world: ``reset_transform`` where the default prim moves what is below it. Refined ones are those
    captured, followed by a step in the camera's own axes."""
    frames, meters_per_unit = scan.frames, scan.meters_per_unit
    refined = np.asarray(frames.world_from_camera, np.float64)
    ops = {"xformOp:transform": refined}
    if frames.captured_pose is not None:
        captured = frames.captured_pose
        step = np.asarray(np.linalg.solve(captured, refined), np.float64)
        ops = {"xformOp:transform": captured, "xformOp:transform:refined": step}
    for name, matrices in ops.items():
        # USD multiplies row vectors from the left: its matrices are ours transposed.
        poses = [Gf.Matrix4d(pose.T.tolist()) for pose in matrices]
        attribute_per_frame(prim, name, Types.Matrix4d, poses, always=True)
    order = ["!resetXformStack!", *ops] if reset_transform else [*ops]
    attribute(prim, "xformOpOrder", Types.TokenArray, order, uniform=True)
    lens = [
        lens_from_pinhole(pinhole, resolution, meters_per_unit)
        for pinhole, resolution in zip(frames.intrinsics, frames.resolution, strict=True)
    ]
    for name, values in zip(LENS, zip(*lens, strict=True), strict=True):
        attribute_per_frame(prim, name, Types.Float, values)
    attribute(prim, "projection", Types.Token, "perspective")
    near, far = NEAR_M / meters_per_unit, FAR_M / meters_per_unit
    attribute(prim, "clippingRange", Types.Float2, Gf.Vec2f(near, far))


def _author_capture(prim: Sdf.PrimSpec, frames: Frames, folder: Path) -> None:
    """Exposure attributes whose product is 1, as the frames are radiance already; our record of
    the photographs; and these where applications look for plates (new in USD 26.11; older versions
    pass over a schema that they do not know), muted: no render may change because of them.

    USD: scale = responsivity * time * (iso / 100) * 2^exposure / fStop^2.
    """
    times = [t if math.isfinite(t) and t > 0 else 1.0 for t in frames.exposure_time.tolist()]
    for name, value in (("", 0.0), (":fStop", 1.0), (":iso", 100.0)):
        attribute(prim, f"exposure{name}", Types.Float, value)
    attribute_per_frame(prim, "exposure:time", Types.Float, times)
    attribute_per_frame(prim, "exposure:responsivity", Types.Float, [1.0 / time for time in times])
    images = [storable_path(path, folder) for path in frames.image_paths]
    said: dict[str, Any] = {
        "image": images, "lens": frames.lenses, "lighting": frames.lightings,
    }  # fmt: skip
    for name, files in (("photograph", frames.photographs), ("mask", frames.masks)):
        said[name] = [storable_path(file, folder) if file else "" for file in files]
    said["gain"] = [1.0] * len(frames) if frames.gain is None else frames.gain.tolist()
    for name, _ in facts_of(Photographs):
        if name not in said:
            value = getattr(frames, name)
            said[name] = value.tolist() if isinstance(value, np.ndarray) else value
    plates = [Sdf.AssetPath(image) for image in images]
    for fact, value in known_facts(Photographs(**said)):
        author_fact(prim, fact, value)
        if fact.name == "image":
            apply_schema(prim, "BackPlateAPI:photograph")
            attribute_per_frame(
                prim, "backPlate:photograph:image", Types.Asset, plates, always=True
            )
            attribute(prim, "backPlate:photograph:plateVisibility", Types.Token, "mute")
