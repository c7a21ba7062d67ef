"""Albedo, phi and psi of an asset against known values.

The truth is a folder with objects.json (a list of id, name, phi, psi, emission) and
albedo_vertex.npz (``albedo`` per vertex of the capture's mesh), as samples/study/truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.objects import read_fit
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.metrics import finite, median_relative, nrmse
from usdbrdf.files.documents import read_json
from usdbrdf.model.arrays import Bool, Float

Known: TypeAlias = Mapping[str, Mapping[str, Any]]

# Fewer observations than this are no median.
MIN_SAMPLES = 3


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
    listed = read_json(path)
    try:
        known = {o["name"]: o for o in listed}
        for o in listed:
            float(o["phi"]), float(o["psi"]), max(o["emission"]), int(o["id"])
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
    return np.array([max(known[obj.label]["emission"]) > 0 for obj in atlas.scene.objects])


def scored_texels(atlas: AssetMaps, shines: Bool) -> Bool:
    """(T,) bool: seen at least three times, on an object that does not emit, inside a triangle."""
    seen = atlas.map("samples")[:, 0] >= MIN_SAMPLES
    scored: Bool = seen & ~shines[atlas.texels.object_index()] & atlas.texels.interior
    return scored


def albedo_error(atlas: AssetMaps, scored: Bool, found: Float, known: Float) -> dict[str, Any]:
    """NRMSE, area-weighted, and median relative errors of maps (T, 3) over the texels scored."""
    area = atlas.texels.area
    owner = atlas.texels.object_index()

    def over(part: Bool) -> float:
        return nrmse(found[part], known[part], area[part])

    absolute, signed = median_relative(found[scored], known[scored])
    return {
        "nrmse": finite(over(scored)),
        "median_abs_relative": finite(absolute),
        "median_signed": finite(signed),
        "objects": {
            obj.identifier: finite(over(scored & (owner == i)), 4)
            for i, obj in enumerate(atlas.scene.objects)
            if (scored & (owner == i)).any()
        },
    }


def true_albedo(atlas: AssetMaps, folder: Path, mesh: Path) -> Float:
    """(T, 3), linear between the vertices of the capture's mesh, a PLY with ``object_id``: each
    face of ours is found in it by its centre, among those of the object of the same name."""
    source, labels = _labelled_mesh(mesh)
    path = folder / "albedo_vertex.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            per_vertex = np.asarray(file["albedo"], np.float32)
    except (OSError, KeyError, ValueError) as error:
        raise InputRefused(
            f"{path}: no array 'albedo' can be read from it ({error}). Check --truth. "
            "[evaluate.truth]"
        ) from error
    if per_vertex.shape != (len(source.vertices), 3):
        raise InputRefused(
            f"{path}: albedo is {per_vertex.shape}, but {mesh} has {len(source.vertices)} "
            "vertices. Name the mesh that it belongs to with --mesh. [evaluate.truth]"
        )
    names = {o["id"]: o["name"] for o in read_json(folder / "objects.json")}
    corners = np.asarray(source.vertices, np.float32)[source.faces]
    result = np.zeros((len(atlas.texels), 3), np.float32)
    for i, obj in enumerate(atlas.scene.objects):
        own = atlas.texels.of_object(i)
        theirs = np.flatnonzero([names.get(int(label)) == obj.label for label in labels])
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
        values = per_vertex[source.faces[match[:, None], corner]]
        result[own] = np.einsum("tc,tcd->td", atlas.texels.barycentric[own], values)
    return result


def _labelled_mesh(mesh: Path) -> tuple[Any, npt.NDArray[Any]]:
    try:
        # Unprocessed, because merged vertices would no longer be the truth's.
        source = trimesh.load(mesh, process=False)
        labels = np.asarray(source.metadata["_ply_raw"]["face"]["data"]["object_id"]).ravel()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputRefused(
            f"{mesh}: not a readable PLY with the face property object_id ({error!r}). Name the "
            "capture's mesh with --mesh. [evaluate.truth]"
        ) from error
    return source, labels


def material_error(atlas: AssetMaps, known: Known, shines: Bool) -> dict[str, Any]:
    """Errors of phi and psi of each object that does not emit, and their means by status."""
    rows: dict[str, dict[str, Any]] = {}
    for obj, emits in zip(atlas.scene.objects, shines, strict=True):
        fit = read_fit(atlas.stage, obj.prim_path)
        if emits or fit is None:
            continue
        truth = known[obj.label]
        rows[obj.identifier] = {
            "truth": [truth["phi"], truth["psi"]],
            "found": [round(fit.phi, 3), round(fit.psi, 3)],
            "status": fit.status,
            "evidence": finite(fit.evidence, 3),
            "confidence": [fit.phi_confidence, fit.psi_confidence],
            "stated_error": [finite(fit.phi_error, 3), finite(fit.psi_error, 3)],
            "error": [round(abs(fit.phi - truth["phi"]), 3), round(abs(fit.psi - truth["psi"]), 3)],
        }

    def mean(status: str | None, k: int) -> float | None:
        errors = [r["error"][k] for r in rows.values() if status in (None, r["status"])]
        return float(np.mean(errors)) if errors else None

    def largest(k: int) -> float | None:
        return max(
            (r["error"][k] for r in rows.values() if r["status"] == "measured"), default=None
        )

    return {
        "objects": len(rows),
        "mean_abs_phi": mean(None, 0),
        "mean_abs_psi": mean(None, 1),
        "measured": sum(r["status"] == "measured" for r in rows.values()),
        "measured_mean_abs_phi": mean("measured", 0),
        "measured_mean_abs_psi": mean("measured", 1),
        "measured_largest_phi": largest(0),
        "measured_largest_psi": largest(1),
        "rows": rows,
    }
