"""Two assets of one scene under different light: do their albedos agree, do they predict each
other? (paper, section 4.2, Fig. 5 and 6)"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.asset.maps import AssetMaps, camera_hits
from usdbrdf.errors import InputRefused, first_of
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.evaluation.metrics import MIN_SAMPLES, MapError, map_error
from usdbrdf.evaluation.report import (
    FILES,
    Row,
    magma,
    output_folder,
    sheet,
    write_document,
    write_table,
)
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.images import write_preview_png
from usdbrdf.job.ownership import reads_asset
from usdbrdf.job.progress import progress, warn
from usdbrdf.model.arrays import Bool, Byte, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.options import CompareOptions
from usdbrdf.transport.rays import Hits, RayScene
from usdbrdf.transport.surface_texture import surface_texture

DOCUMENT = "comparison.json"
# Points of two assets this close are the same, as a share of the scene's size.
_SAME_POINT = 1e-5
# On meshes that differ, a texel may be this many texels away.
_REACH = 2.0
# Sheets of pictures, at most, and pixels across each of their pictures.
_CAMERAS, _MAX_WIDTH = 4, 480
# Errors of this share of the reference, or more, are shown palest.
_FULL_ERROR = 0.25


# As textured, and after the specular light was taken out of it: the maps of the diffuse radiance,
# the irradiance and the albedo.
_SETS = {
    "lit": ("lit", "irradiance", "albedo"),
    "diffuse": ("diffuse", "refined_irradiance", "base_color"),
}


@reads_asset("first", "second")
def compare(
    first: str | Path, second: str | Path, output: str | Path, options: CompareOptions | None = None
) -> dict[str, Any]:
    """Compare two assets of the same geometry and write figures and pictures to ``output``.

    first, second  asset folders, A and B; only read. Their texels need not be the same
    output         folder for comparison.json, comparison.csv (per object) and pictures/
    returns        the content of comparison.json: per set of maps (``lit``: L_d and albedo;
                   ``diffuse``: without specular light, where both assets have it) NRMSE and median
                   relative errors of ``albedo`` (B against A), ``relit_a`` (S_A rho_B / pi against
                   L_d,A) and ``relit_b``, over texels seen at least three times in both

    Raises UsdBrdfError; ``output`` is then as it was.
    """
    chosen = options or CompareOptions()
    place_a, a = measured_atlas(Path(first), chosen.lighting)
    place_b, b = measured_atlas(Path(second), chosen.other_lighting)
    with output_folder(Path(output), DOCUMENT, (place_a, place_b)) as work:
        found, (forth, back) = agreement(a, b, (place_a.name, place_b.name))
        write_table(work / "comparison.csv", found["objects"])
        _write_pictures(work / "pictures", forth, back, a.frames)
        write_document(work, DOCUMENT, found)
    return found


def agreement(
    a: AssetMaps, b: AssetMaps, names: tuple[str, str]
) -> tuple[dict[str, Any], tuple[Relit, Relit]]:
    """What ``compare`` returns of two assets of these names, but for the list of files; and A with
    the albedo of B, B with that of A, of the last set of maps that both have.

    Raises InputRefused where the assets share no texel, or no set of maps.
    """
    forth, back = matched(a, b), matched(b, a)
    if not (forth[1].any() and back[1].any()):
        raise InputRefused(
            f"{', '.join(names)}: no texel was seen three times in both. Compare captures that "
            "show the same surfaces. [compare.surface]"
        )
    shared = _shared_sets(a, b, names)
    for name, same in ((names[0], forth[0]), (names[1], back[0])):
        if same.missing:
            warn(f"only {name} has {', '.join(same.missing)}. [compare.objects]")
    found: dict[str, Any] = {
        "assets": [*names],
        **({"lightings": [a.lighting, b.lighting]} if a.lighting or b.lighting else {}),
        "texels": int(forth[1].sum()),
        "missing": [list(forth[0].missing), list(back[0].missing)],
    }
    rows: list[Row] = []
    for key, maps in shared.items():
        pair = relit(a, b, forth, maps), relit(b, a, back, maps)
        errors = _errors(*pair, forth[1], back[1])
        found[key] = {name: error._asdict() for name, error in errors.items()}
        rows += _object_rows(key, *pair)
    found["objects"] = rows
    return found, pair


def _shared_sets(
    a: AssetMaps, b: AssetMaps, names: tuple[str, str]
) -> dict[str, tuple[str, str, str]]:
    """Those of ``_SETS`` that both assets have; InputRefused where that is none: radiance under
    different light says nothing without irradiance."""
    shared = {
        key: maps
        for key, maps in _SETS.items()
        if all(atlas.has(name) for atlas in (a, b) for name in maps)
    }
    if not shared:
        lacking = [
            f"{name} has no {' and no '.join(missing)}"
            for name, atlas in zip(names, (a, b), strict=True)
            if (missing := [aov for aov in _SETS["lit"] if not atlas.has(aov)])
        ]
        raise InputRefused(
            f"{'; '.join(lacking)}: without these maps nothing of two lightings can be compared. "
            "Run `usdbrdf shade` on such assets first. [compare.maps]"
        )
    return shared


def comparison_line(found: dict[str, Any]) -> str:
    """One line for people, of the last set of maps."""
    key = next(key for key in reversed(_SETS) if key in found)
    titles = {"albedo": "albedo", "relit_a": "S_A rho_B", "relit_b": "S_B rho_A"}
    parts = []
    for name, title in titles.items():
        values = (found[key][name][figure] for figure in ("nrmse", "median_abs_relative"))
        whole, median = ("unknown" if x is None else f"{100 * x:.2f} %" for x in values)
        parts.append(f"{title} {whole} (median {median})")
    return f"{found['texels']:,} texels, NRMSE of {key}: {', '.join(parts)}"


def figures(found: dict[str, Any]) -> dict[str, Any]:
    """The content of comparison.json without objects and files."""
    return {key: value for key, value in found.items() if key not in ("objects", FILES)}


def _errors(forth: Relit, back: Relit, own: Bool, theirs: Bool) -> dict[str, MapError]:
    """Over some texels of A (T,), and of B (T',)."""
    area, other_area = forth.atlas.texels.area, back.atlas.texels.area
    return {
        "albedo": map_error(forth.other_albedo, forth.albedo, area, own),
        "relit_a": map_error(forth.predicted, forth.measured, area, own),
        "relit_b": map_error(back.predicted, back.measured, other_area, theirs),
    }


def _object_rows(key: str, forth: Relit, back: Relit) -> list[Row]:
    """Errors per object of A; B's object is the one of the same identifier."""
    owner, other = forth.atlas.texels.object_index(), back.atlas.texels.object_index()
    theirs = [obj.identifier for obj in back.atlas.scene.objects]
    rows: list[Row] = []
    for i, obj in enumerate(forth.atlas.scene.objects):
        own = forth.scored & (owner == i)
        if own.any():
            j = theirs.index(obj.identifier) if obj.identifier in theirs else -1
            row: dict[str, Any] = {"maps": key, "object": obj.identifier, "texels": int(own.sum())}
            for name, error in _errors(forth, back, own, back.scored & (other == j)).items():
                row[f"{name}_nrmse"] = error.nrmse
                row[f"{name}_median_abs_relative"] = error.median_abs_relative
            rows.append(row)
    return rows


@dataclass(frozen=True, kw_only=True)
class Relit:
    """On the texels of one asset, (T, 3) each: its radiance, the radiance predicted with the other
    asset's albedo, its irradiance, both albedos; the texels that are compared, (T,) bool."""

    atlas: AssetMaps
    measured: Float
    predicted: Float
    irradiance: Float
    albedo: Float
    other_albedo: Float
    scored: Bool


def matched(atlas: AssetMaps, other: AssetMaps) -> tuple[Correspondence, Bool]:
    """The other asset's texels on those of ``atlas``, and which are compared: (T,) bool, seen at
    least three times, inside a triangle and without emission, in both."""
    comparable = []
    for each in (atlas, other):
        often = each.samples >= MIN_SAMPLES
        comparable.append(often & ~each.emissive & each.texels.interior)
    same = correspondence(atlas, other)
    scored = comparable[0] & comparable[1][np.maximum(same.texel, 0)] & (same.texel >= 0)
    return same, np.asarray(scored, np.bool_)


def relit(
    atlas: AssetMaps, other: AssetMaps, match: tuple[Correspondence, Bool], maps: tuple[str, ...]
) -> Relit:
    """Predict the radiance of ``atlas`` with the albedo of ``other`` where they are ``matched``;
    maps: of ``_SETS``."""
    (same, scored), (radiance, irradiance, albedo) = match, maps
    theirs = same.interpolated(other.map_where_present(albedo, 3))
    measured = atlas.map_where_present(radiance, 3)
    arriving = atlas.map(irradiance)
    reflected = arriving * theirs / np.pi
    # Lamps are given: what is predicted is what they light.
    emits = atlas.map_where_present("emission", 3).any(axis=1, keepdims=True)
    return Relit(
        atlas=atlas,
        measured=measured,
        predicted=np.where(emits, measured, reflected).astype(np.float32),
        irradiance=arriving,
        albedo=atlas.map_where_present(albedo, 3),
        other_albedo=theirs,
        scored=scored,
    )


def _write_pictures(folder: Path, forth: Relit, back: Relit, frames: Frames) -> None:
    """A sheet for each of four cameras spread over ``frames``. Its rows: radiance of asset A
    measured, predicted, error; the same of asset B; albedo of A, of B, difference."""
    folder.mkdir()
    chosen = np.unique(np.linspace(0, len(frames) - 1, _CAMERAS).round().astype(int))
    scenes = [RayScene(r.atlas.scene.points, r.atlas.scene.triangles) for r in (forth, back)]
    shown = [display_exposure(r.measured[r.scored].mean(axis=1)) for r in (forth, back)]
    for i in progress(chosen, total=len(chosen), label="pictures", unit="views"):
        width, height = (int(n) for n in frames.resolution[i])
        scale = min(1.0, _MAX_WIDTH / width)
        size = max(1, round(scale * width)), max(1, round(scale * height))
        hits = [camera_hits(rays, frames, int(i), *size) for rays in scenes]
        rows = [
            _row(forth, hits[0], size, (forth.measured, forth.predicted), shown[0]),
            _row(back, hits[1], size, (back.measured, back.predicted), shown[1]),
            _row(forth, hits[0], size, (forth.albedo, forth.other_albedo), 1.0),
        ]
        write_preview_png(folder / f"{int(i):04d}.png", sheet(rows))


def _row(
    relit: Relit, hits: Hits, size: tuple[int, int], maps: tuple[Float, Float], exposure: float
) -> list[Byte]:
    """Reference, what is compared with it, and the error relative to the reference."""
    reference, values = (on_surface(relit, hits, size, values) for values in maps)
    pictures = [to_display_srgb8(m, exposure_scale=exposure) for m in (reference, values)]
    return [*pictures, error_picture(relit, hits, size, maps)]


def error_picture(
    relit: Relit, hits: Hits, size: tuple[int, int], maps: tuple[Float, Float]
) -> Byte:
    """|values - reference| over the reference of ``maps``, reference first, as ``magma`` shows it;
    grey where texels are not compared."""
    scored = np.repeat(relit.scored[:, None], 3, axis=1).astype(np.float32)
    reference, values, share = (on_surface(relit, hits, size, each) for each in (*maps, scored))
    error = np.abs(values - reference).mean(axis=2)
    relative = error / np.maximum(reference.mean(axis=2), 1e-6)
    return magma((relative / _FULL_ERROR).astype(np.float32), share[..., 0] > 0.5)


def on_surface(relit: Relit, hits: Hits, size: tuple[int, int], values: Float) -> Float:
    """(H, W, 3): values (T, 3) where a camera with pictures of ``size`` (W, H) sees them."""
    texture = surface_texture(relit.atlas.texels, relit.atlas.scene.face_object, values)
    return texture.at(hits.face, hits.u, hits.v).reshape(*size[::-1], 3)


@dataclass(frozen=True, kw_only=True)
class Correspondence:
    """For each texel (T,) of one asset: the texel of the other there (-1: none); and where the
    triangles agree but the atlases do not, the other's face, else -1; barycentric (T, 3) in it.

    missing  identifiers of the objects that the other asset does not have
    """

    other: AssetMaps
    texel: Int
    face: Int
    barycentric: Float
    missing: tuple[str, ...]

    def interpolated(self, values: Float) -> Float:
        """The other asset's values (T', 3), bilinear where its atlas differs; 0 where unknown."""
        found = np.where((self.texel >= 0)[:, None], values[np.maximum(self.texel, 0)], 0)
        between = self.face >= 0
        if between.any():
            texture = surface_texture(self.other.texels, self.other.scene.face_object, values)
            u, v = (self.barycentric[between, i] for i in (1, 2))
            found[between] = texture.at(self.face[between], u, v)
        return np.asarray(found, np.float32)


def correspondence(atlas: AssetMaps, other: AssetMaps) -> Correspondence:
    """Find the texels of ``other`` at those of ``atlas``; objects go by identifier, then label.

    Triangle by triangle where an object has the same ones in both, else by the nearest texel of the
    same object within two texels. InputRefused where the assets share no object or no surface.
    """
    scene, texels = atlas.scene, atlas.texels
    texel, face = (np.full(len(texels), -1, np.int32) for _ in range(2))
    missing = []
    for i, obj in enumerate(scene.objects):
        own = texels.of_object(i)
        j = None
        for key in ("label", "identifier"):  # of which the last counts more
            names = [getattr(each, key) for each in other.scene.objects]
            if names.count(getattr(obj, key)) == 1:
                j = names.index(getattr(obj, key))
        if j is None:
            missing.append(obj.identifier)
        elif not _same_triangles(scene, i, other.scene, j):
            texel[own] = _nearest(texels, i, other.texels, j)
        elif _same_atlas(atlas, i, other, j):
            theirs = other.texels.of_object(j)
            texel[own] = np.arange(theirs.start, theirs.stop, dtype=np.int32)
        else:
            shift = other.scene.objects[j].first_face - obj.first_face
            face[own] = texels.face[own] + shift
            texel[own] = _texel_at(other.texels, j, face[own], texels.barycentric[own])
    if len(missing) == len(scene.objects):
        raise InputRefused(
            f"the assets share no object: one has {_some(scene)}, the other {_some(other.scene)}. "
            "Compare two assets of one scene. [compare.objects]"
        )
    if not (texel >= 0).any():
        raise InputRefused(
            "the assets' objects share names but no surface: nowhere are their texels closer than "
            "two texels. Compare two assets of one scene in one frame. [compare.surface]"
        )
    return Correspondence(
        other=other, texel=texel, face=face, barycentric=texels.barycentric, missing=tuple(missing)
    )


def _same_triangles(scene: Scene, i: int, other: Scene, j: int) -> bool:
    ours = scene.points[scene.triangles[scene.objects[i].faces]]
    theirs = other.points[other.triangles[other.objects[j].faces]]
    limit = _SAME_POINT * float(np.linalg.norm(np.ptp(scene.points, axis=0)))
    return ours.shape == theirs.shape and bool(np.abs(ours - theirs).max() <= limit)


def _same_atlas(atlas: AssetMaps, i: int, other: AssetMaps, j: int) -> bool:
    tables, weights = [], []
    for each, k in ((atlas, i), (other, j)):
        own = each.texels.of_object(k)
        pixel = each.texels.pixel[own] - each.texels.first_pixel[k]
        tables.append(np.stack([pixel, each.texels.face[own] - each.scene.objects[k].first_face]))
        weights.append(each.texels.barycentric[own])
    same = np.array_equal(tables[0], tables[1])
    return same and np.allclose(weights[0], weights[1], atol=1e-3)


def _texel_at(texels: Texels, index: int, face: Int, barycentric: Float) -> Int:
    """The texel nearest to points of object ``index``, given by face and barycentric (R, 3)."""
    width, height = texels.resolution[index]
    place = np.einsum("rc,rcd->rd", barycentric, texels.corner_pixel[face]).astype(np.int64)
    x, y = np.clip(place[:, 0], 0, width - 1), np.clip(place[:, 1], 0, height - 1)
    found: Int = texels.nearest_texel[texels.first_pixel[index] + y * width + x]
    return found


def _nearest(texels: Texels, i: int, other: Texels, j: int) -> Int:
    own, theirs = texels.of_object(i), other.of_object(j)
    if own.stop == own.start or theirs.stop == theirs.start:
        return np.full(own.stop - own.start, -1, np.int32)
    side = np.sqrt(max(float(np.median(t.area[s])) for t, s in ((texels, own), (other, theirs))))
    distance, nearest = cKDTree(other.position[theirs]).query(texels.position[own])
    return np.where(distance <= _REACH * side, theirs.start + nearest, -1).astype(np.int32)


def _some(scene: Scene) -> str:
    return first_of([obj.identifier for obj in scene.objects])
