"""What is measured between a picture or a map and its reference, and between an asset and known
values of albedo, phi and psi.

The truth is a folder with objects.json (a list of id, name, phi, psi, emission) and
albedo_vertex.npz (``albedo`` per vertex of the capture's mesh), as samples/study/truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import capture_up_of_stage, read_fit
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.documents import load_arrays, read_json
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.upright import upright_points
from usdbrdf.untrusted.mesh_files import mesh_from_file

# Fewer observations than this are no median.
MIN_SAMPLES = 3
# What FLIP may take. Pictures are seen at 67 pixels per degree, a 4K screen 0.7 m wide from 0.7 m,
# its authors' default.
_FLIP_SECONDS, _FLIP_SECONDS_PER_MEGAPIXEL = 300.0, 60.0


def relative_l2(image: Float, reference: Float, counted: Bool) -> float:
    """||image - reference|| / ||reference|| over the pixels ``counted``; NaN without light there.

    image, reference (H, W, 3) linear radiance; counted (H, W). Values elsewhere may be NaN.
    """
    x, ref = image[counted].astype(np.float64), reference[counted].astype(np.float64)
    # Not by BLAS: its threads would wait for each other longer than the sums take.
    norm, error = (math.sqrt(float(np.square(values).sum())) for values in (ref, x - ref))
    return error / norm if norm > 0 else math.nan


def psnr(image: Float, reference: Float, counted: Bool) -> float:
    """Peak signal to noise ratio in dB, -10 log10(mean squared error), of display values in [0, 1]
    over the pixels ``counted``; infinite for equal pictures, NaN where nothing is counted."""
    if not counted.any():
        return math.nan
    error = float(np.mean((image[counted].astype(np.float64) - reference[counted]) ** 2))
    return -10 * math.log10(error) if error > 0 else math.inf


def nrmse(values: Float, reference: Float, area: Float) -> float:
    """||values - reference|| / ||reference|| of maps (T, C), weighted by texel area (T,): root mean
    square error over root mean square. NaN where the reference is 0 everywhere or empty."""
    weight = area.astype(np.float64)[:, None]
    norm = float((weight * reference.astype(np.float64) ** 2).sum())
    error = float((weight * (values.astype(np.float64) - reference) ** 2).sum())
    return math.sqrt(error / norm) if norm > 0 else math.nan


def median_relative(values: Float, reference: Float) -> tuple[float, float]:
    """Median of |values / reference - 1| and of values / reference - 1; NaN where empty."""
    if not values.size:
        return math.nan, math.nan
    relative = values / np.maximum(reference, 1e-6) - 1
    return float(np.median(np.abs(relative))), float(np.median(relative))


class MapError(NamedTuple):
    """How far a map is from its reference over the texels compared; None where there are none."""

    nrmse: float | None
    median_abs_relative: float | None
    median_signed: float | None


def map_error(values: Float, reference: Float, area: Float, scored: Bool) -> MapError:
    """NRMSE, weighted by ``area`` (T,), and median relative errors of maps (T, C) over ``scored``
    (T,)."""
    absolute, signed = median_relative(values[scored], reference[scored])
    whole = nrmse(values[scored], reference[scored], area[scored])
    return MapError(finite(whole), finite(absolute), finite(signed))


def finite(value: float, digits: int | None = None) -> float | None:
    """A number for a JSON document, which has no NaN and no infinity: None for those."""
    if not math.isfinite(value):
        return None
    return float(value) if digits is None else round(float(value), digits)


class Pair(NamedTuple):
    """Two pictures (H, W, 3) of display values (sRGB) in [0, 1]."""

    reference: Float
    test: Float


def flip_maps(pairs: Sequence[Pair], label: str) -> list[Float]:
    """FLIP error maps (H, W) in [0, 1] of pairs of any sizes, by one child process.

    Raises UsdBrdfError for pictures that are not equal in size, have not three channels or leave
    [0, 1]; label: what they are, for messages.
    """
    if not pairs:
        return []
    arrays = {
        f"{name}-{i}": np.ascontiguousarray(picture, np.float32)
        for i, pair in enumerate(pairs)
        for name, picture in pair._asdict().items()
    }
    megapixels = sum(pair.reference.size for pair in pairs) / 3e6
    found = run_child(
        "usdbrdf.evaluation.metrics:flip_in_child",
        arrays,
        {"count": len(pairs)},
        _FLIP_SECONDS + _FLIP_SECONDS_PER_MEGAPIXEL * megapixels,
        f"FLIP of {label}",
    )
    return [found[f"map-{i}"] for i in range(len(pairs))]


def flip_in_child(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """The child's side of ``flip_maps``."""
    import flip_evaluator

    result = {}
    for i in range(parameters["count"]):
        reference, test = arrays[f"reference-{i}"], arrays[f"test-{i}"]
        problem = None
        if reference.ndim != 3 or reference.shape[2] != 3 or not reference.size:
            problem = f"a reference of shape {reference.shape}, not (H, W, 3)"
        elif test.shape != reference.shape:
            problem = f"pictures of shapes {reference.shape} and {test.shape}"
        elif not (np.isfinite(reference).all() and np.isfinite(test).all()):
            problem = "values that are not finite"
        elif min(reference.min(), test.min()) < 0 or max(reference.max(), test.max()) > 1:
            problem = "values outside [0, 1]"
        if problem:
            raise UsdBrdfError(f"FLIP was given {problem} (pair {i}). [evaluate.flip]")
        error, _, _ = flip_evaluator.evaluate(
            reference, test, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=False
        )
        result[f"map-{i}"] = np.asarray(error, np.float32).reshape(reference.shape[:2])
    return result


class KnownObject(NamedTuple):
    """An object of the truth: its number in the capture's mesh, its lobe, whether it emits."""

    number: int
    phi: float
    psi: float
    emits: bool


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


def known_objects(folder: Path, atlas: AssetMaps) -> dict[str, KnownObject]:
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


def emitters(atlas: AssetMaps, known: dict[str, KnownObject]) -> Bool:
    """(num_objects,) bool, objects that truly emit."""
    return np.array([known[obj.label].emits for obj in atlas.scene.objects])


def scored_texels(atlas: AssetMaps, shines: Bool) -> Bool:
    """(T,) bool: seen at least three times, on an object that does not emit, inside a triangle."""
    often = atlas.samples >= MIN_SAMPLES
    scored: Bool = often & ~shines[atlas.texels.object_index()] & atlas.texels.interior
    return scored


def albedo_error(atlas: AssetMaps, scored: Bool, found: Float, known: Float) -> dict[str, Any]:
    """NRMSE, area-weighted, and median relative errors of maps (T, 3) over the texels scored; NRMSE
    per object too."""
    area, owner = atlas.texels.area, atlas.texels.object_index()
    objects = {
        obj.identifier: finite(nrmse(found[own], known[own], area[own]), 4)
        for i, obj in enumerate(atlas.scene.objects)
        if (own := scored & (owner == i)).any()
    }
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
        per_vertex = np.asarray(load_arrays(path)["albedo"], np.float32)
    except (KeyError, ValueError, InputRefused) as error:
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
    points = upright_points(source.points, capture_up_of_stage(atlas.stage))
    corners = points[source.triangles]
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


def material_error(atlas: AssetMaps, known: dict[str, KnownObject], shines: Bool) -> dict[str, Any]:
    """Errors of phi and psi of each object that does not emit, and their means by status."""
    rows: dict[str, dict[str, Any]] = {}
    for obj, emits in zip(atlas.scene.objects, shines, strict=True):
        fit = read_fit(atlas.stage, obj.prim_path)
        if emits or fit is None:
            continue
        truth = known[obj.label]
        phi, psi = (round(abs(a - b), 3) for a, b in ((fit.phi, truth.phi), (fit.psi, truth.psi)))
        rows[obj.identifier] = {
            "truth": [truth.phi, truth.psi],
            "found": [round(fit.phi, 3), round(fit.psi, 3)],
            "status": fit.status,
            "evidence": finite(fit.evidence, 3),
            "confidence": [fit.phi_confidence, fit.psi_confidence],
            "stated_error": [finite(fit.phi_error, 3), finite(fit.psi_error, 3)],
            "error": [phi, psi],
        }
    measured = [row for row in rows.values() if row["status"] == "measured"]
    every_phi, every_psi = ([row["error"][i] for row in rows.values()] for i in range(2))
    measured_phi, measured_psi = ([row["error"][i] for row in measured] for i in range(2))
    return {
        "objects": len(rows),
        "mean_abs_phi": _mean(every_phi),
        "mean_abs_psi": _mean(every_psi),
        "measured": len(measured),
        "measured_mean_abs_phi": _mean(measured_phi),
        "measured_mean_abs_psi": _mean(measured_psi),
        "measured_largest_phi": max(measured_phi, default=None),
        "measured_largest_psi": max(measured_psi, default=None),
        "rows": rows,
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
