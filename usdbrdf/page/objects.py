"""Every object as the page tells of it: its numbers with their errors, why they are what they are,
its photograph beside the model's picture, and the evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import FittedObject, ShadedObject
from usdbrdf.asset.readers.scene import read_shading
from usdbrdf.evaluation.evaluate_views import ViewedAsset, predict_view
from usdbrdf.evaluation.metrics import finite
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.job.progress import progress
from usdbrdf.material.fit_target import FrameSeen, frame_samples, relative_costs, seen_in_frame
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import IN_PART, LAMP, LEFT_OUT
from usdbrdf.model.scene import SceneObject
from usdbrdf.options import EvaluateOptions
from usdbrdf.page.pictures import Seen, data_uri, part_around, status_of
from usdbrdf.transport.lit_scene import View

# Of the pictures of objects, which are small; of the evidence's plot; and its pixels.
_PICTURE = EvaluateOptions(samples_per_pixel=1, rays=24)
_PHIS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
_PSIS = tuple(k / 10 for k in range(11))
_EVIDENCE_PIXELS = 150
# Of no lobe it is 1; what is so much worse needs no number.
_MOST_COST = 100.0


def object_rows(
    atlas: AssetMaps,
    seen: ViewedAsset,
    fits: Sequence[FittedObject],
    where: Seen,
    chosen: Sequence[int],
    *,
    photographs: bool,
    seed: int,
) -> list[dict[str, Any]]:
    """All objects, in the order of the stage, JSON.

    where, chosen  where objects are in the frames of these numbers
    photographs    whether pictures may be photographs
    """
    objects = atlas.scene.objects
    rows = [
        _numbers(atlas, i, obj, fits[i], bool(where.in_sight[i])) for i, obj in enumerate(objects)
    ]
    shown = [_place_of(where, chosen, i, fits[i].target_frame) for i in range(len(objects))]
    # By their frames, so that each frame is read once however many objects it shows.
    order = sorted((at, i) for i, at in enumerate(shown) if at is not None)
    read, looked = -1, None
    for at, i in progress(order, total=len(order), label="report", unit="objects"):
        if looked is None or at != read:
            read, looked = at, _looked_at(atlas.frames, chosen[at], seen)
        rows[i] |= _pictures(looked, seen, i, where.box[at, i], photographs=photographs, seed=seed)
        if not _was_fitted(fits[i], rows[i]["status"]):
            continue
        costs = _evidence(seen, looked, i, seed)
        if costs is not None:
            rows[i]["costs"] = {"phis": _PHIS, "psis": _PSIS, "values": costs.round(4).tolist()}
    return rows


class _LookedAt(NamedTuple):
    """A frame, as all objects that it shows need it."""

    number: int
    pixels: FramePixels
    view: View
    owners: FrameSeen


def _looked_at(frames: Frames, number: int, seen: ViewedAsset) -> _LookedAt:
    pixels = read_frame(frames, number)
    view = View(
        radiance=np.nan_to_num(pixels.radiance), valid=pixels.valid, camera=frames.camera(number)
    )
    return _LookedAt(number, pixels, view, seen_in_frame(seen.lit, view))


def _place_of(where: Seen, chosen: Sequence[int], index: int, target: int) -> int | None:
    """Which of the chosen frames shows an object: its target frame if that does, else the one that
    shows the most of it; None where none shows it."""
    share = where.share[:, index]
    if target in chosen and share[chosen.index(target)] > 0:
        return chosen.index(target)
    most = int(share.argmax())
    return most if share[most] > 0 else None


def _numbers(
    atlas: AssetMaps, index: int, obj: SceneObject, fit: FittedObject, in_sight: bool
) -> dict[str, Any]:
    texels, own = atlas.texels, atlas.texels.of_object(index)
    status = status_of(atlas, index, fit)
    shading = read_shading(atlas.stage, obj.prim_path)
    observed = bool(atlas.coverage.observed[own].any())
    glimpsed = bool(atlas.coverage.glimpsed[own].any())
    colours = next((n for n in ("base_color", "albedo") if atlas.has(n)), None)
    base = texels.mean_of_object(index, atlas.map_where_present(colours, 3)) if colours else None
    return {
        "id": obj.identifier,
        "label": obj.name,
        "class": obj.class_name,
        "prim": obj.prim_path,
        "status": status,
        "because": undetermined_because(fit, status, in_sight=in_sight),
        "fit": fit.status,
        "material": fit.model,
        "directive": fit.directive or (shading.directive if shading else ""),
        "phi": finite(fit.phi, 4),
        "phi_error": finite(fit.phi_error, 4),
        "phi_confidence": fit.phi_confidence,
        "psi": finite(fit.psi, 4),
        "psi_error": finite(fit.psi_error, 4),
        "psi_upper": finite(fit.psi_upper, 4),
        "psi_confidence": fit.psi_confidence,
        "f0": [round(value, 4) for value in fit.f0] if fit.is_metal else None,
        "evidence": finite(fit.evidence, 4),
        "base_color": None if base is None else [round(float(value), 4) for value in base],
        "seen": round(float(atlas.coverage.observed[own].mean()) if len(texels) else 0.0, 4),
        "clipped": round(float(atlas.coverage.clipped[own].mean()), 4),
        "area": round(float(texels.area[own].sum()), 4),
        "radiance": _radiance(shading),
        "why": why(fit, status, shading, in_sight=in_sight, observed=observed, glimpsed=glimpsed),
        "target": fit.target_frame,
    }


def _radiance(shading: ShadedObject | None) -> dict[str, Any] | None:
    if shading is None or not shading.emitter:
        return None
    known = [round(float(value), 5) for value in shading.radiance]
    return {"mean": known, "status": shading.radiance_status,
            "error": finite(shading.radiance_error, 4)}  # fmt: skip


def why(
    fit: FittedObject,
    status: str,
    shading: ShadedObject | None,
    *,
    in_sight: bool = True,
    observed: bool = True,
    glimpsed: bool = False,
) -> str:
    """In a sentence or two, why the numbers of an object are to be believed, or not.

    in_sight  whether it lies in the sight of a camera
    observed  whether a frame tells something of any of its texels, if only that it clips
    glimpsed  whether frames show some of it in pixels that show something else as well
    """
    if directive := _by_directive(fit, shading):
        return directive
    if fit.is_glass:
        return "Photographs show the outside through it: it is clear glass, and nothing was fitted."
    if status == "lamp":
        known = shading.radiance_status if shading else "measured"
        if known == "measured":
            return "It shines; its radiance was measured."
        how = "and clipped in every photograph" if observed else "where no photograph measures it"
        what = "estimated from the light that it casts" if known == "estimated" else "a lower bound"
        return f"It shines {how}: its radiance is {what}."
    if status == "unseen":
        if glimpsed:
            return (
                "Photographs show it only together with what is beside it: its colour is about "
                "that, and everything else about it is a guess."
            )
        hardly = "Photographs hardly show it, and nothing on it was measured"
        shown = hardly if in_sight else "No photograph shows it"
        return f"{shown}: everything about it is a guess."
    if fit.is_metal:
        better = "A metal explains the views better than anything with a base colour"
        known = "" if status == "measured" else " Its numbers are not known well."
        return f"{better}: its reflectance, F0, takes the place of psi.{known}"
    if fit.is_contradicted:
        return (
            f"Its views contradict by {fit.contradiction:.0%} that it is a surface: something is "
            "seen through it or in it. If it is glass, say so by a directive."
        )
    explained = f"A lobe explains {max(fit.evidence, 0):.0%} of what changes with the view."
    if math.isnan(fit.evidence):
        explained = "There were too few samples for a fit."
    if status == "measured":
        return f"{explained} Both numbers are determined."
    if status == "failed":
        return f"{explained} The target frame does not determine the numbers."
    sure = [name for name in ("phi", "psi") if getattr(fit, f"{name}_confidence") == "high"]
    known = f"Only {sure[0]} is determined." if sure else "Neither number is determined."
    weak = "Its highlights, if it has any, are weaker than usual: " if status == "bounded" else ""
    bound = f" {weak}psi is below {fit.psi_upper:.2f} with 95 %." if fit.psi_upper < 0.995 else ""
    return f"{explained} {known}{bound}"


def undetermined_because(fit: FittedObject | None, status: str, *, in_sight: bool = False) -> str:
    """One word about why the numbers of an object are not known: "told" where a person said that
    nothing be fitted, "pane", "contradicted", "sparse" where too little was seen, "glimpsed" where
    an object that counts as unseen lies ``in_sight`` of a camera; else ``status``."""
    if status == "unseen" and in_sight:
        return "glimpsed"
    if fit is None or status not in IN_PART:
        return status
    if fit.directive in LEFT_OUT:
        return "told"
    if fit.is_glass:
        return "pane"
    if fit.is_contradicted:
        return "contradicted"
    return "sparse" if math.isnan(fit.evidence) else status


def _by_directive(fit: FittedObject, shading: ShadedObject | None) -> str:
    """The same where a person said what is to be done; "" where the numbers speak."""
    if shading is not None and shading.directive == LAMP:
        return "It counts as a lamp by directive, whatever its radiance says."
    told = {
        "ignore": "It was left out by directive: nothing was fitted.",
        "glass": "It is clear glass by directive: nothing was fitted.",
        "metal": f"It is fitted as a metal by directive{_of_metal(fit)}",
    }
    return told.get(fit.directive, "")


def _of_metal(fit: FittedObject) -> str:
    """How sure that is, as the end of a sentence, or of two."""
    if not fit.is_metal:
        return ", of which the photographs do not show enough."
    if fit.status == "measured":
        return "."
    if math.isnan(fit.f0_error):
        return ". One frame cannot tell whether it is one."
    if "low" in (fit.phi_confidence, fit.psi_confidence):
        return ". Its numbers are not known well."
    return ". Dielectrics explain the photographs no worse."


def _pictures(
    frame: _LookedAt,
    seen: ViewedAsset,
    index: int,
    box: Sequence[float],
    *,
    photographs: bool,
    seed: int,
) -> dict[str, Any]:
    """The object in a frame: photograph and model's picture of one exposure."""
    part = part_around(frame.view.camera, box)
    predicted = predict_view(seen, part.camera, _PICTURE, seed + index)
    small = part.of(frame.pixels)
    known = small.radiance[~small.unknown] if not small.unknown.all() else predicted.full
    exposure = display_exposure(known.reshape(-1, 3).mean(axis=1))
    found: dict[str, Any] = {
        "frame": frame.number,
        "model": data_uri(to_display_srgb8(predicted.full, exposure_scale=exposure)),
        "size": [part.camera.width, part.camera.height],
    }
    if photographs:
        picture = to_display_srgb8(np.nan_to_num(small.radiance), exposure_scale=exposure)
        found["photograph"] = data_uri(picture)
    return found


def _was_fitted(fit: FittedObject, status: str) -> bool:
    """Whether there is a fit for a frame to be evidence of."""
    return undetermined_because(fit, status) not in ("lamp", "unseen", "told", "sparse", "pane")


def _evidence(seen: ViewedAsset, frame: _LookedAt, index: int, seed: int) -> Double | None:
    """(phi, psi): what lobes leave unexplained of the object in one frame, relative to none."""
    samples, _ = frame_samples(seen.lit, frame.view, frame.owners, index, _EVIDENCE_PIXELS, seed)
    if samples is None:
        return None
    return np.minimum(relative_costs(seen.lit, samples, _PHIS, _PSIS), _MOST_COST)
