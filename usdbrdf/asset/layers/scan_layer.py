"""What ingest writes: the weakest layer, the capture as it came, with its meshes, camera and
photographs; and layers without any measurement: the artist's edits, those still to come."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pxr import Gf, Sdf, UsdGeom

from usdbrdf.asset.header import (
    LAYOUT,
    Draft,
    Provenance,
    Scopes,
    StageHeader,
    new_layer,
    read_header,
    read_provenance,
)
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
from usdbrdf.asset.layers.interface import (
    Component,
    components_of,
    write_components,
    write_scan_interface,
)
from usdbrdf.asset.layout import LIGHTING, Asset, relative_path, storable_path
from usdbrdf.asset.properties import LabelledObject, Photographs, facts_of, known_facts
from usdbrdf.asset.readers.scene import LENS
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.files.atomic import environment_failures, sha256_of
from usdbrdf.files.naming import readable_label
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames, Recorded, Scan
from usdbrdf.model.mesh import ObjectLabel, is_closed

Types = Sdf.ValueTypeNames
APERTURE_MM = 36.0
NEAR_M, FAR_M = 0.01, 1000.0
# Facts of the photographs that name files, and the one that tells them from others of that name.
_PLACES = ("image", "photograph", "mask")
_OF_FILES = (*_PLACES, "sha256")


def check_root(asset: Asset, header: StageHeader, capture_up: str = "") -> None:
    """Raise if the asset has a root layer that says otherwise about units or the up axis, or was
    turned from another one than ``capture_up``. USD believes the root, which is kept while
    anything is left of it: a capture in other units would come out in the wrong size, beneath edits
    that were made for the old one."""
    if not asset.root_layer.is_file():
        return
    root = read_header(asset.root_layer)
    turned_from = read_provenance(asset.root_layer).get("capture_up", "")
    ours = root.meters_per_unit, turned_from or root.up_axis
    theirs = header.meters_per_unit, capture_up or header.up_axis
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
    layer = new_layer(header, Provenance(role="edits", version=LAYOUT))
    layer.documentation = "Yours: stronger than everything that was measured, never overwritten."
    over(layer, f"/{header.name}")
    return layer


def is_edited(asset: Asset) -> bool:
    """Whether an artist's edits.usda is another than the one that was written."""
    if not asset.edits_layer.is_file():
        return True  # and nothing that could be waited for is read
    try:
        empty = _no_edits(read_header(asset.layer("scan"))).ExportToString()
        return bool(asset.edits_layer.read_bytes() != empty.encode("utf-8"))
    except (OSError, InputRefused):
        return True


def write_pending_layer(path: Path, role: str, header: StageHeader) -> None:
    """A layer without opinions, so that the root composes before the task of its role has run."""
    layer = new_layer(header, Provenance(role=role, version=LAYOUT), state="pending")
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
    layer = new_layer(header, Provenance(role=role, version=LAYOUT))
    root = Sdf.Path(f"/{header.name}")
    for name in lightings:
        variant = over(layer, str(root.AppendVariantSelection(LIGHTING, name)))
        own = replace(asset, lighting=name).layer(role)
        variant.referenceList.prependedItems = [Sdf.Reference(f"./{own.name}")]
    if role == "texturing":
        layer.subLayerPaths = [f"./{asset.uv_layer.name}"]
        layer.GetPrimAtPath(root).variantSelections[LIGHTING] = lightings[0]
    export(layer, path, folder=path.parent)


@dataclass(frozen=True, kw_only=True)
class ScanFiles:
    """Where to write what ingest knows: scan.usdc, its interface, the photographs, and the objects'
    own files, by their paths in the asset."""

    scan: Path
    interface: Path
    photographs: Path
    place: Callable[[str], Path]

    @staticmethod
    def of(asset: Asset, place: Callable[[str], Path]) -> ScanFiles:
        """All at ``place`` of their paths in the asset."""
        layers = asset.layer("scan"), asset.interface("scan"), asset.photographs_layer
        scan, interface, photographs = (place(f"layers/{layer.name}") for layer in layers)
        return ScanFiles(scan=scan, interface=interface, photographs=photographs, place=place)


def write_scan_layer(
    files: ScanFiles, scan: Scan, draft: Draft, hashes: Mapping[Path, str] = MappingProxyType({})
) -> None:
    """Write the capture as it came; objects without a face are left out.

    hashes  the SHA-256 of photographs and masks, as far as they are known
    """
    folder, frames = draft.asset.layer("scan").parent, scan.frames
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
        capture_up=scan.capture_up or None,
        lightings=list(dict.fromkeys(frames.lightings)) or None,
        scopes=scopes.names,
        competing_bindings=competing or None,
    )
    components, root = components_of(scan), layer.GetPrimAtPath(scopes.root)
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
    for item in components:
        prim = define(layer, scopes.mesh(item.label.identifier), "Mesh")
        _author_mesh(prim, item)
        _author_label(prim, item.label, scan.label_source)
    define(layer, scopes.path("cameras"), "Scope")
    camera = define(layer, scopes.path("cameras", "capture"), "Camera")
    _author_pose_and_lens(camera, scan, reset_transform=input_usd.has_transform(source))
    _author_capture(camera, frames)
    # Settings that render the capture's own view; the shading layer adds the products.
    define(layer, scopes.path("render"), "Scope")
    settings = define(layer, scopes.path("render", "capture"), "RenderSettings")
    resolution = Gf.Vec2i(frames.resolution[0].tolist())
    attribute(settings, "resolution", Types.Int2, resolution, uniform=True)
    relationship(settings, "camera", scopes.path("cameras", "capture"))
    attribute(settings, "renderingColorSpace", Types.Token, "lin_rec709_scene", uniform=True)
    export(layer, files.scan, folder=folder)
    _write_photographs(files.photographs, frames, draft, scopes, hashes)
    write_scan_interface(files.interface, scan, draft, scopes, components, source)
    write_components(files.place, draft, scopes, components)


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


def _author_mesh(prim: Sdf.PrimSpec, item: Component) -> None:
    counts = np.full(len(item.triangles), 3, np.int32)
    normals = item.corner_normals.reshape(-1, 3)
    attribute(prim, "points", Types.Point3fArray, item.points)
    attribute(prim, "faceVertexCounts", Types.IntArray, counts)
    attribute(prim, "faceVertexIndices", Types.IntArray, item.triangles.reshape(-1))
    attribute(prim, "normals", Types.Normal3fArray, normals, interpolation="faceVarying")
    attribute(prim, "extent", Types.Float3Array, item.extent)
    attribute(prim, "subdivisionScheme", Types.Token, UsdGeom.Tokens.none, uniform=True)
    # What is closed has an inside, which nobody sees; a sheet has no thickness, and a scan has
    # holes, through which cameras look at the backs of things.
    attribute(prim, "doubleSided", Types.Bool, not is_closed(item.triangles), uniform=True)


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
    attribute(prim, "clippingRange", Types.Float2, Gf.Vec2f(*_clipping_range(scan)))


def _clipping_range(scan: Scan) -> tuple[float, float]:
    """Near and far in scene units: the usual ones, wider where the scene is as small or large that
    they would cut into it."""
    seen = np.concatenate([scan.mesh.points, scan.frames.world_from_camera[:, :3, 3]])
    across = float(np.linalg.norm(np.ptp(seen.astype(np.float64), axis=0)))
    near, far = NEAR_M / scan.meters_per_unit, FAR_M / scan.meters_per_unit
    return min(near, across / 100), max(far, 2 * across)


def _author_capture(prim: Sdf.PrimSpec, frames: Frames) -> None:
    """Exposure attributes whose product is 1, as the frames are radiance already; and what we
    record of the photographs, but for their places.

    USD: scale = responsivity * time * (iso / 100) * 2^exposure / fStop^2.
    """
    times = [t if math.isfinite(t) and t > 0 else 1.0 for t in frames.exposure_time.tolist()]
    for name, value in (("", 0.0), (":fStop", 1.0), (":iso", 100.0)):
        attribute(prim, f"exposure{name}", Types.Float, value)
    attribute_per_frame(prim, "exposure:time", Types.Float, times)
    attribute_per_frame(prim, "exposure:responsivity", Types.Float, [1.0 / time for time in times])
    places = dict.fromkeys(_OF_FILES, [""] * len(frames))
    for fact, value in known_facts(_record_of(frames, places)):
        if fact.name not in _OF_FILES:
            author_fact(prim, fact, value)


def _record_of(frames: Frames, places: Mapping[str, Sequence[str]]) -> Photographs:
    """Of all photographs; their files and those they were made of at ``places``."""
    said: dict[str, Any] = {**places, "lens": frames.lenses, "lighting": frames.lightings}
    said |= zip(Recorded._fields, zip(*frames.recorded_each(), strict=True), strict=True)
    said["gain"] = [1.0] * len(frames) if frames.gain is None else frames.gain.tolist()
    for name, _ in facts_of(Photographs):
        if name not in said:
            value = getattr(frames, name)
            said[name] = value.tolist() if isinstance(value, np.ndarray) else value
    return Photographs(**said)


def _write_photographs(
    path: Path, frames: Frames, draft: Draft, scopes: Scopes, hashes: Mapping[Path, str]
) -> None:
    """Where the photographs lie, for us and where applications look for plates (new in USD 26.11;
    older versions pass over a schema that they do not know), muted: no render may change because of
    them. A layer of its own: an asset that is copied or published is whole without the capture."""
    layer, folder = draft.new_layer(), draft.asset.photographs_layer.parent
    layer.documentation = (
        "Where the capture's photographs lie. The asset is whole without them: add this layer to "
        "the sublayers of edits.usda to see them as plates of the camera."
    )
    given = (frames.image_paths, frames.photographs, frames.masks)
    files = {
        name: [storable_path(file, folder) if file else "" for file in paths]
        for name, paths in zip(_PLACES, given, strict=True)
    }
    with environment_failures(str(path)):
        files["sha256"] = [
            " ".join(hashes.get(file) or sha256_of(file) for file in recorded if file.is_file())
            for recorded in frames.recorded_by()
        ]
    prim = over(layer, scopes.path("cameras", "capture"))
    for fact, value in known_facts(_record_of(frames, files)):
        if fact.name in _OF_FILES:
            author_fact(prim, fact, value)
    plates = [Sdf.AssetPath(image) for image in files["image"]]
    apply_schema(prim, "BackPlateAPI:photograph")
    attribute_per_frame(prim, "backPlate:photograph:image", Types.Asset, plates, always=True)
    attribute(prim, "backPlate:photograph:plateVisibility", Types.Token, "mute")
    export(layer, path, folder=folder)
