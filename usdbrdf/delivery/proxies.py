"""Coarse stand-ins for the measured meshes of a published version, which applications show while
people work: purpose "proxy" beside meshes of purpose "render", of the same object and colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from usdbrdf.asset.header import LAYOUT, Provenance, new_layer, read_header
from usdbrdf.asset.layers.author import attribute, define, export, over, relationship
from usdbrdf.asset.readers.compose import open_stage
from usdbrdf.delivery.low_poly import CREASE_ANGLE_DEG
from usdbrdf.geometry.mesh_clean import decimated
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Float, Int

PROXIES = "proxies.usdc"
Types = Sdf.ValueTypeNames


def add_proxies(root: Path, contents: Path, triangles: int, asset: Path) -> None:
    """Write the stand-ins of a copy's meshes beside its layer ``contents``, and name them there.

    root       root layer of the copy, which is not finished yet
    triangles  about as many, of all together
    asset      whose copy it is, for the sentence that says why there are none: where the meshes
               have no more triangles, or none is ours

    Geometry that came as USD, with the capture or by the artist's hand, keeps its own purposes.
    """
    stage = open_stage(root)
    meshes = _meshes_of_objects(stage, contents.parent)
    there = sum(len(corners) for _, _, corners in meshes)
    if there <= triangles:
        why = (
            f"its meshes have no more than {there:,} triangles"
            if meshes
            else "its geometry came as USD, which keeps its own purposes"
        )
        warn(f"{asset}: --proxies {triangles}: no stand-ins were made, since {why}.")
        return
    layer = new_layer(read_header(root), Provenance(role="proxies", version=LAYOUT))
    first = np.cumsum([0, *(len(points) for _, points, _ in meshes)])
    points, corners, owner = decimated(
        np.concatenate([points for _, points, _ in meshes]),
        np.concatenate([own + first[i] for i, (_, _, own) in enumerate(meshes)]).astype(np.int32),
        np.repeat(np.arange(len(meshes), dtype=np.int32), [len(own) for _, _, own in meshes]),
        triangles,
        label=str(root),
    )
    for i, (prim, _, _) in enumerate(meshes):
        used, own = np.unique(corners[owner == i], return_inverse=True)
        place = f"{prim.GetParent().GetPath()}/{prim.GetName()}_proxy"
        _author_proxy(
            define(layer, place, "Mesh"), prim, points[used], own.reshape(-1, 3).astype(np.int32)
        )
        shown = over(layer, str(prim.GetPath()))
        attribute(shown, "purpose", Types.Token, UsdGeom.Tokens.render, uniform=True)
        relationship(shown, "proxyPrim", place)
    export(layer, contents.parent / PROXIES, folder=contents.parent)
    named = Sdf.Layer.OpenAsAnonymous(str(contents))
    named.subLayerPaths.insert(0, f"./{PROXIES}")
    export(named, contents, folder=contents.parent)


def _meshes_of_objects(stage: Usd.Stage, layers: Path) -> list[tuple[Usd.Prim, Float, Int]]:
    """The meshes that the scan layer itself holds, with points and triangles about their pivots,
    as they are after all edits."""
    scan = Sdf.Layer.FindOrOpen(str(next(layers.glob("scan.usd*"))))
    found = []
    for prim in stage.Traverse():
        spec = scan.GetPrimAtPath(prim.GetPath())
        if spec is None or spec.typeName != "Mesh" or not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        if set(mesh.GetFaceVertexCountsAttr().Get() or ()) == {3}:
            points = np.array(mesh.GetPointsAttr().Get(), np.float64).reshape(-1, 3)
            # USD multiplies row vectors from the left.
            local = np.array(mesh.GetLocalTransformation())
            points = (points @ local[:3, :3] + local[3, :3]).astype(np.float32)
            corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int32).reshape(-1, 3)
            found.append((prim, points, corners))
    return found


def _author_proxy(proxy: Sdf.PrimSpec, prim: Usd.Prim, points: Float, corners: Int) -> None:
    mesh, counts = UsdGeom.Mesh(prim), np.full(len(corners), 3, np.int32)
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    normals = corner_normals(points, corners, CREASE_ANGLE_DEG).reshape(-1, 3)
    attribute(proxy, "points", Types.Point3fArray, points)
    attribute(proxy, "faceVertexCounts", Types.IntArray, counts)
    attribute(proxy, "faceVertexIndices", Types.IntArray, corners.reshape(-1))
    attribute(proxy, "normals", Types.Normal3fArray, normals, interpolation="faceVarying")
    attribute(proxy, "extent", Types.Float3Array, extent)
    attribute(proxy, "subdivisionScheme", Types.Token, UsdGeom.Tokens.none, uniform=True)
    attribute(proxy, "doubleSided", Types.Bool, mesh.GetDoubleSidedAttr().Get(), uniform=True)
    attribute(proxy, "purpose", Types.Token, UsdGeom.Tokens.proxy, uniform=True)
    if (colour := mesh.GetDisplayColorAttr().Get()) is not None and len(colour) == 1:
        attribute(
            proxy, "primvars:displayColor", Types.Color3fArray, colour, interpolation="constant"
        )
