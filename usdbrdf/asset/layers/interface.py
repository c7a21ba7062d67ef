"""What applications see of an asset before they load its payload, and the files of its objects.

The root layer loads contents.usda as a payload: the layers of all tasks. Beside that it has an
interface layer of each task, which stay small: units, boxes, kinds, pivots, and the names of what
can be chosen. Of an object whose mesh is ours the prim is an Xform with its pivot; it holds the
mesh, its materials and what it wears in the looks, so that it can be referenced alone: by its path
in the root layer, or by its own file in the folder objects, which stands at the origin. Both
compose from the layers of the tasks, the artist's edits included: no fact lies in two places."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom

from usdbrdf.asset.header import (
    LAYOUT,
    Draft,
    Provenance,
    Scopes,
    StageHeader,
    capture_up_of,
    new_layer,
    read_header,
)
from usdbrdf.asset.layers.author import apply_schema, attribute, define, export, over
from usdbrdf.asset.layout import ROLES, Asset, relative_path
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import environment_failures, publish, temporary_beside
from usdbrdf.files.naming import readable_label
from usdbrdf.geometry.fans import point_of_each_fan
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.capture import Scan
from usdbrdf.model.mesh import ObjectLabel, welded

Types = Sdf.ValueTypeNames
# Who publishes an asset gives it a number.
UNPUBLISHED = "work"
# Bytes of a root layer that was cut off at its beginning: a block of a disk.
_LONGEST_REST = 4096
_FIRST_LINE = b"#usda 1.0"
# Pivots lie on a grid of binary fractions of the unit: what is moved by them keeps its digits.
_PER_UNIT = 1024
# An abstract prim that a shot may define, to say something of all copies of an asset at once.
_CLASSES = "/__class__"
# Of assetInfo: files that loading the payload opens, for who asks before it is loaded.
NEEDS = "payloadAssetDependencies"


@dataclass(frozen=True, kw_only=True)
class Component:
    """An object whose mesh is ours, about its pivot.

    points          (V, 3) float32, in units of the stage
    triangles       (F, 3) int32
    corner_normals  (F, 3, 3) float32
    pivot           (3,) float64: the middle of its lower side, in the world
    """

    label: ObjectLabel
    points: Float
    triangles: Int
    corner_normals: Float
    pivot: Double

    @property
    def extent(self) -> Float:
        """(2, 3) its box."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


def components_of(scan: Scan) -> tuple[Component, ...]:
    """The objects that have a face; () where the meshes are an input file's."""
    if scan.usd_geometry:
        return ()
    # Files split vertices at seams; ours has its normals per corner and needs no copies, but where
    # faces do not hang together.
    mesh, components = welded(scan.mesh), []
    order = np.argsort(mesh.face_object, kind="stable")
    bounds = np.searchsorted(mesh.face_object[order], np.arange(len(scan.objects) + 1))
    for i, label in enumerate(scan.objects):
        faces = order[bounds[i] : bounds[i + 1]]
        if not len(faces):
            continue
        used, triangles = point_of_each_fan(mesh.triangles[faces])
        points = mesh.points[used].astype(np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        pivot, up = (low + high) / 2, "XYZ".index(scan.up_axis)
        pivot[up] = low[up]
        pivot = np.round(pivot * _PER_UNIT) / _PER_UNIT
        components.append(
            Component(
                label=label,
                points=(points - pivot).astype(np.float32),
                triangles=triangles,
                corner_normals=mesh.corner_normals[faces].astype(np.float32),
                pivot=pivot,
            )
        )
    return tuple(components)


def write_root(path: Path, asset: Asset, header: StageHeader, capture_up: str = "") -> None:
    """NAME.usda: the artist's layer, the interfaces, strongest first, and the payload. Never
    written over while anything is left of it; so it notes from which axis up the capture was
    turned, too."""
    provenance = Provenance(role="root", version=LAYOUT)
    layer = new_layer(header, provenance, capture_up=capture_up or None)
    layer.documentation = (
        "Captured scene with measured materials. Put your own opinions into edits.usda, the "
        "strongest layer: no tool writes it again. The files in layers/ are regenerated."
    )
    interfaces = (asset.interface(role) for role in reversed(ROLES))
    layer.subLayerPaths = [
        f"./{asset.edits_layer.name}",
        *(f"./layers/{interface.name}" for interface in interfaces),
    ]
    # Only a root layer can say this. The scan layer may still be waiting beside it, unpublished.
    staged = Asset(path.parent, asset.name)
    scopes = Scopes.of(staged if staged.layer("scan").is_file() else asset)
    layer.pseudoRoot.SetInfo("renderSettingsPrimPath", scopes.path("render", "capture"))
    payload = Sdf.Payload(f"./layers/{asset.contents_layer.name}")
    over(layer, scopes.root).payloadList.prependedItems = [payload]
    export(layer, path, folder=asset.folder)


def is_cut(root: Path) -> bool:
    """Whether nothing is left of a root layer but USD's first line, of that a part, or zeros: a
    copy or a disk stopped there. USD may take it for a stage, an empty one. All that has more in it
    is kept, and a link leads to somebody else's."""
    if root.is_symlink() or not root.is_file() or root.stat().st_size > _LONGEST_REST:
        return False
    return _FIRST_LINE.startswith(root.read_bytes().strip(b"\0 \r\n"))


def mend_root(asset: Asset) -> None:
    """Write the root layer again of which nothing is left, as the scan layer says."""
    root, scan = asset.root_layer, asset.layer("scan")
    with temporary_beside(root) as staged:
        write_root(staged, asset, read_header(scan), capture_up_of(asset))
        publish(staged, root)


@contextmanager
def cut_root_aside(asset: Asset) -> Iterator[bool]:
    """For ingest no root layer of which nothing is left is there, so that it writes one; where it
    does not, all stays as it was. Gives whether there is such a layer."""
    root = asset.root_layer
    if not is_cut(root):
        yield False
        return
    with environment_failures(str(root)):
        rest = root.read_bytes()
        root.unlink()
    try:
        yield True
    finally:
        if not root.exists():
            root.write_bytes(rest)


def write_contents(path: Path, asset: Asset, header: StageHeader) -> None:
    """contents.usda: the layers of the tasks, strongest first, and what they stand on."""
    layer = new_layer(header, Provenance(role="contents", version=LAYOUT))
    layers = [*(asset.layer(role) for role in reversed(ROLES)), asset.interface("scan")]
    layer.subLayerPaths = [f"./{each.name}" for each in layers]
    over(layer, f"/{header.name}")
    export(layer, path, folder=path.parent)


def write_interface(path: Path, *layers: Path) -> None:
    """The names of what can be chosen in layers that a task wrote, strongest first, what of it is
    selected, and the picture that browsers show."""
    layer = new_layer(read_header(layers[0]), Provenance(role="interface", version=LAYOUT))
    root = over(layer, f"/{layer.defaultPrim}")
    for file in layers:
        opened = Sdf.Layer.OpenAsAnonymous(str(file))
        source = opened.GetPrimAtPath(root.path)
        for name, choice in source.variantSets.items():
            for variant, spec in choice.variants.items():
                prim = over(layer, str(root.path.AppendVariantSelection(name, variant)))
                # What a variant takes from another layer it can choose from, too.
                arcs = spec.primSpec.referenceList.prependedItems
                names = (f"{arc.assetPath.removesuffix('.usda')}.interface.usda" for arc in arcs)
                if references := [Sdf.Reference(each) for each in names]:
                    prim.referenceList.prependedItems = references
        for name, selected in source.variantSelections.items():
            if name not in root.variantSelections:
                root.variantSelections[name] = selected
        if source.HasInfo("assetInfo"):
            root.SetInfo("assetInfo", source.GetInfo("assetInfo"))
            if source.HasInfo("apiSchemas"):
                apply_schema(root, *source.GetInfo("apiSchemas").prependedItems)
    export(layer, path, folder=path.parent)


def write_scan_interface(
    path: Path,
    scan: Scan,
    draft: Draft,
    scopes: Scopes,
    components: Sequence[Component],
    source: Usd.Prim | None,
) -> None:
    """The interface of the scan to ``path``; ``source`` is the default prim of an input file."""
    asset = draft.asset
    layer = new_layer(draft.header, Provenance(role="interface", version=LAYOUT))
    # A typed root would hide the input's own type.
    root = define(layer, scopes.root, "" if source and source.GetTypeName() else "Xform")
    if not (source and source.HasAuthoredMetadata("kind")):
        root.SetInfo("kind", "assembly")
    needs = asset.layers_of_payload(dict.fromkeys(scan.frames.lightings))
    if scan.usd_geometry:
        needs.append(scan.usd_geometry)
    root.inheritPathList.prependedItems = [Sdf.Path(f"{_CLASSES}/{asset.name}")]
    _author_model(root, asset, asset.name, asset.root_layer.name, needs, _box(scan, source))
    apply_schema(root, "ColorSpaceAPI")
    attribute(root, "colorSpace:name", Types.Token, "lin_rec709_scene", uniform=True)
    geometry = define(layer, scopes.path("geometry"), "Scope")
    if components:
        geometry.SetInfo("kind", "group")
    else:
        for label in scan.objects:
            define(layer, scopes.component(label.identifier), "Scope")
    for item in components:
        identifier = item.label.identifier
        prim = define(layer, scopes.component(identifier), "Xform")
        prim.SetInfo("kind", "component")
        prim.SetInfo("displayName", readable_label(item.label.label))
        prim.inheritPathList.prependedItems = [Sdf.Path(f"{_CLASSES}/{asset.name}_{identifier}")]
        file, needs = asset.component(identifier), [asset.root_layer]
        _author_model(prim, asset, identifier, file, needs, item.extent)
        attribute(prim, "xformOp:translate", Types.Double3, Gf.Vec3d(*item.pivot.tolist()))
        order = ["xformOp:translate"]
        attribute(prim, "xformOpOrder", Types.TokenArray, order, uniform=True)
    export(layer, path, folder=asset.layer("scan").parent)


def needs_too(root: Sdf.PrimSpec, asset: Asset, layers: Sequence[Path]) -> None:
    """Beside what the interface of the scan tells of, the payload opens these."""
    needs = [
        *_told_of(asset.interface("scan"), root.path),
        *(Sdf.AssetPath(f"./{layer.name}") for layer in layers),
    ]
    root.SetInfo("assetInfo", {NEEDS: Sdf.AssetPathArray(needs)})


def _told_of(interface: Path, path: Sdf.Path) -> list[Sdf.AssetPath]:
    """What the payload of a prim opens, as its interface tells; that may have been edited by hand,
    and adopted."""
    with suppress(Tf.ErrorException, AttributeError, TypeError):
        # Kept: a prim goes with its layer.
        layer = Sdf.Layer.OpenAsAnonymous(str(interface))
        known = layer.GetPrimAtPath(path).GetInfo("assetInfo").get(NEEDS, [])
        if all(isinstance(each, Sdf.AssetPath) for each in known):
            return list(known)
    raise InputRefused(
        f"{interface}: it does not say of <{path}> which layers it needs, as usdbrdf writes it "
        "there. Take the file from a copy of the asset, or run `usdbrdf convert` again with "
        "--discard. [stage.content]"
    )


def _author_model(
    prim: Sdf.PrimSpec, asset: Asset, name: str, file: str, needs: Sequence[Path], box: Float
) -> None:
    """What makes a prim a model: what it is called and needs, and a box (2, 3), which stands for it
    until it is loaded, and where a shot draws models as boxes."""
    folder = asset.layer("scan").parent
    dependencies = [Sdf.AssetPath(relative_path(each, folder)) for each in needs]
    info = {
        "identifier": Sdf.AssetPath(f"../{file}"),
        "name": name,
        "version": UNPUBLISHED,
        NEEDS: Sdf.AssetPathArray(dependencies),
    }
    prim.SetInfo("assetInfo", info)
    apply_schema(prim, "GeomModelAPI")
    attribute(prim, "extentsHint", Types.Float3Array, box.astype(np.float32))


def _box(scan: Scan, source: Usd.Prim | None) -> Float:
    """(2, 3) box of the scan in the frame of the default prim."""
    points = scan.mesh.points[np.unique(scan.mesh.triangles)].astype(np.float64)
    if source and source.IsA(UsdGeom.Xformable):
        first = Usd.TimeCode.EarliestTime()
        # USD multiplies row vectors from the left.
        local = np.linalg.inv(np.array(UsdGeom.Xformable(source).GetLocalTransformation(first)))
        points = points @ local[:3, :3] + local[3, :3]
    return np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float32)


def write_components(
    place: Callable[[str], Path], draft: Draft, scopes: Scopes, components: Sequence[Component]
) -> None:
    """The files of the objects, at ``place`` of their paths in the asset: what the root layer has
    of one of them, at the origin."""
    asset = draft.asset
    held: Sdf.Layer | None = None
    for item in components:
        identifier = item.label.identifier
        header = StageHeader(**vars(draft.header) | {"name": identifier})
        layer = new_layer(header, Provenance(role="component", version=LAYOUT))
        prim = define(layer, f"/{identifier}", "Xform")
        target, path = Sdf.Path(scopes.component(identifier)), place(asset.component(identifier))
        interface = f"../../layers/{asset.interface('scan').name}"
        prim.referenceList.prependedItems = [Sdf.Reference(interface, target)]
        payload = Sdf.Payload(f"../../{asset.root_layer.name}", target)
        prim.payloadList.prependedItems = [payload]
        attribute(prim, "xformOpOrder", Types.TokenArray, [], uniform=True)
        # All of them refer to it, and it tells of all objects: read for each again, the time would
        # grow as their square.
        held = held or Sdf.Layer.FindOrOpen(os.path.normpath(path.parent / interface))
        export(layer, path, folder=path.parent)
