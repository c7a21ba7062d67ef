"""Albedo, phi and psi of an asset against known values.

The truth is a folder with objects.json (a list of id, name, phi, psi, emission) and
albedo_vertex.npz (``albedo`` per vertex of the capture's mesh), as samples/study/truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.metrics import finite, map_error, nrmse
from usdbrdf.files.documents import read_json
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.untrusted.mesh_files import mesh_from_file

# Fewer observations than this are no median.
MIN_SAMPLES = 3


class KnownObject(NamedTuple):
    """An object of the truth: its number in the capture's mesh, its lobe, whether it emits."""

    number: int
    phi: float
    psi: float
    emits: bool


Known: TypeAlias = Mapping[str, KnownObject]


def compare_with_truth(
    atlas: AssetMaps, folder: Path, mesh: Path | None, albedo: str
) -> dict[str, Any]:
    """NRMSE of the map named ``albedo`` and errors of phi and psi, whole and per object.

    mesh  what the truth's vertices belong to; None: mesh.ply beside ``folder``
    """
    known = known_objects(folder, atlas)
    shines = emitters(atlas, known)
    scored = scored_texels(atlas, shines)
    albedo_known = true_albedo(atlas, folder, mesh or folder.resolve().parent / "mesh.ply")
    return {
        "albedo_map": albedo,
        "albedo": albedo_error(atlas, scored, atlas.map_where_present(albedo, 3), albedo_known),
        "material": material_error(atlas, known, shines),
    }


def known_objects(folder: Path, atlas: AssetMaps) -> Known:
    """The truth's objects by name; InputRefused where it lacks one of the asset's."""
    path = folder / "objects.json"
    try:
        known = {
            o["name"]: KnownObject(
                int(o["id"]), float(o["phi"]), float(o["psi"]), max(o["emission"]) > 0
            )
            for o in read_json(path)
        }
    except (TypeError, KeyError, ValueError) as error:
        raise InputRefused(
            f"{path}: not a list of objects with id, name, phi, psi and emission ({error!r}). "
            "Correct it. [evaluate.truth]"
        ) from error
    missing = [obj.label for obj in atlas.scene.objects if obj.label not in known]
    if missing:
        raise InputRefused(
            f"{path}: does not know the asset's object {missing[0]!r}. Use the truth of the same "
            "capture. [evaluate.truth]"
        )
    return known


def emitters(atlas: AssetMaps, known: Known) -> Bool:
    """(num_objects,) bool, objects that truly emit."""
    return np.array([known[obj.label].emits for obj in atlas.scene.objects])


def scored_texels(atlas: AssetMaps, shines: Bool) -> Bool:
    """(T,) bool: seen at least three times, on an object that does not emit, inside a triangle."""
    seen = atlas.map("samples")[:, 0] >= MIN_SAMPLES
    scored: Bool = seen & ~shines[atlas.texels.object_index()] & atlas.texels.interior
    return scored


def albedo_error(atlas: AssetMaps, scored: Bool, found: Float, known: Float) -> dict[str, Any]:
    """NRMSE, area-weighted, and median relative errors of maps (T, 3) over the texels scored; NRMSE
    per object too."""
    area, owner = atlas.texels.area, atlas.texels.object_index()
    objects = {}
    for i, obj in enumerate(atlas.scene.objects):
        own = scored & (owner == i)
        if own.any():
            objects[obj.identifier] = finite(nrmse(found[own], known[own], area[own]), 4)
    return {**map_error(found, known, area, scored)._asdict(), "objects": objects}


def true_albedo(atlas: AssetMaps, folder: Path, mesh: Path) -> Float:
    """(T, 3), linear between the vertices of the capture's mesh, a PLY with ``object_id``: each
    face of ours is found in it by its centre, among those of the object of the same name."""
    source = mesh_from_file(mesh)
    if source.face_label is None:
        raise InputRefused(
            f"{mesh}: its faces have no property object_id. Name the capture's mesh with --mesh. "
            "[evaluate.truth]"
        )
    path = folder / "albedo_vertex.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            per_vertex = np.asarray(file["albedo"], np.float32)
    except (OSError, KeyError, ValueError) as error:
        raise InputRefused(
            f"{path}: no array 'albedo' can be read from it ({error}). Check --truth. "
            "[evaluate.truth]"
        ) from error
    if per_vertex.shape != (len(source.points), 3):
        raise InputRefused(
            f"{path}: albedo is {per_vertex.shape}, but {mesh} has {len(source.points)} "
            "vertices. Name the mesh that it belongs to with --mesh. [evaluate.truth]"
        )
    known = known_objects(folder, atlas)
    corners = source.points[source.triangles]
    result = np.zeros((len(atlas.texels), 3), np.float32)
    for i, obj in enumerate(atlas.scene.objects):
        own = atlas.texels.of_object(i)
        theirs = np.flatnonzero(source.face_label == known[obj.label].number)
        if not len(theirs):
            raise InputRefused(
                f"{mesh}: no face belongs to the object {obj.label!r}. Name the mesh of the same "
                "capture with --mesh. [evaluate.truth]"
            )
        face = atlas.texels.face[own]
        ours = atlas.scene.points[atlas.scene.triangles[face]]
        _, nearest = cKDTree(corners[theirs].mean(axis=1)).query(ours.mean(axis=1))
        match = theirs[nearest]
        distance = np.linalg.norm(ours[:, :, None] - corners[match][:, None], axis=-1)
        corner = distance.argmin(axis=2)
        values = per_vertex[source.triangles[match[:, None], corner]]
        result[own] = np.einsum("tc,tcd->td", atlas.texels.barycentric[own], values)
    return result


class _MaterialError(NamedTuple):
    """|found - true| of an object that does not emit, and whether its values were measured."""

    phi: float
    psi: float
    measured: bool


def material_error(atlas: AssetMaps, known: Known, shines: Bool) -> dict[str, Any]:
    """Errors of phi and psi of each object that does not emit, and their means by status."""
    rows: dict[str, dict[str, Any]] = {}
    errors = []
    for obj, emits in zip(atlas.scene.objects, shines, strict=True):
        fit = read_fit(atlas.stage, obj.prim_path)
        if emits or fit is None:
            continue
        truth = known[obj.label]
        phi, psi = (round(abs(a - b), 3) for a, b in ((fit.phi, truth.phi), (fit.psi, truth.psi)))
        errors.append(_MaterialError(phi, psi, fit.status == "measured"))
        rows[obj.identifier] = {
            "truth": [truth.phi, truth.psi],
            "found": [round(fit.phi, 3), round(fit.psi, 3)],
            "status": fit.status,
            "evidence": finite(fit.evidence, 3),
            "confidence": [fit.phi_confidence, fit.psi_confidence],
            "stated_error": [finite(fit.phi_error, 3), finite(fit.psi_error, 3)],
            "error": [phi, psi],
        }
    measured = [error for error in errors if error.measured]
    return {
        "objects": len(rows),
        "mean_abs_phi": _mean([error.phi for error in errors]),
        "mean_abs_psi": _mean([error.psi for error in errors]),
        "measured": len(measured),
        "measured_mean_abs_phi": _mean([error.phi for error in measured]),
        "measured_mean_abs_psi": _mean([error.psi for error in measured]),
        "measured_largest_phi": max((error.phi for error in measured), default=None),
        "measured_largest_psi": max((error.psi for error in measured), default=None),
        "rows": rows,
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
