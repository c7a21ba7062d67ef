"""An asset -> which photographs would tell most about what it does not know yet, as cameras in a
layer of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.advice.choice import Choice, choose
from usdbrdf.advice.free_space import Places, free_places
from usdbrdf.advice.knowledge import (
    Exposure,
    Lobes,
    Products,
    coarser_than_reckoned,
    contrast,
    likely_lobes,
    lobes,
    reckoned_samples,
    share_found,
)
from usdbrdf.advice.survey import (
    Survey,
    Target,
    all_looks,
    chosen_spots,
    level_of,
    look_from,
    seen_by_frames,
)
from usdbrdf.advice.words import (
    camera_of,
    exposure_in_words,
    looked_at,
    owners_of,
    reason,
    told_objects,
    where,
)
from usdbrdf.asset.advice import AdvisedPose, write_advice
from usdbrdf.asset.header import read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.evaluate_views import measured_atlas, viewed_asset
from usdbrdf.files.atomic import environment_failures
from usdbrdf.job.ownership import folder_lock
from usdbrdf.job.stamp import STATE_FOLDER
from usdbrdf.job.versions import refuse_version
from usdbrdf.material.fit_views import MIN_OBSERVATIONS
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import LEFT_OUT
from usdbrdf.options import AdviseOptions
from usdbrdf.transport.lit_scene import LitScene

# Frames whose knowledge is counted, places that are looked from, and objects that count, at most:
# time.
_MOST_FRAMES, _PLACES, _MOST_OBJECTS = 72, 220, 48
# What clips in all frames is looked at with an exposure so many times shorter, too.
_SHORTER = 4.0
# An object that is a lamp by more than this share needs no lobe.
_LAMP = 0.5
# Samples that are no sample: one view less, and there were some.
_HARDLY_ANY = 10


@dataclass(frozen=True, kw_only=True)
class Advice:
    """poses, the most telling first; unseen_area, m^2 that no frame shows and that can be seen from
    free space, seen_area of it by the poses; undetermined: identifiers of the objects whose lobe is
    not known."""

    poses: tuple[AdvisedPose, ...]
    unseen_area: float
    seen_area: float
    undetermined: tuple[str, ...]
    places: int
    in_room: bool


def advise(
    folder: str | Path,
    options: AdviseOptions | None = None,
    *,
    wait_s: float = 0.0,
    without_lock: bool = False,
) -> dict[str, Any]:
    """Find what to photograph next and write it to the layer ``advice.usda`` of the asset in
    ``folder``; no other file is touched.

    Returns a summary of plain values. wait_s, without_lock: as of ``pipeline.working_on``.

    Raises InputRefused where a step has not run or no camera can stand anywhere, OwnershipConflict
    for a published version.
    """
    chosen = options or AdviseOptions()
    asset = Asset.made(Path(folder))
    refuse_version(asset.folder)
    state = asset.folder / STATE_FOLDER
    with environment_failures(str(state)), folder_lock(state, wait_s, without_lock=without_lock):
        place, atlas = measured_atlas(asset.folder, chosen.lighting)
        # Where none is asked for it is the one that the asset opens in.
        place = place.in_lighting(atlas.lighting or None)
        found = find_advice(place, atlas, chosen)
        layer = write_advice(place, found.poses, _recorded(chosen))
    return {
        "asset": str(asset.root_layer),
        "layer": str(layer),
        "in_room": found.in_room,
        "places": found.places,
        "undetermined": list(found.undetermined),
        "unseen_area": round(found.unseen_area, 4),
        "seen_area": round(found.seen_area, 4),
        "poses": [pose.summary for pose in found.poses],
    }


def _recorded(options: AdviseOptions) -> dict[str, Any]:
    """Nothing of it may depend on the machine: of a picture its name."""
    given = vars(options)
    return {k: v.name if isinstance(v, Path) else v for k, v in given.items() if v is not None}


def find_advice(asset: Asset, atlas: AssetMaps, options: AdviseOptions) -> Advice:
    """What to photograph next; nothing is written."""
    lit = viewed_asset(asset, atlas, options.environment).lit
    up = "XYZ".index(read_header(asset.layer("scan")).up_axis)
    frames = atlas.frames
    places = free_places(
        lit.rays, frames.world_from_camera[:, :3, 3], up,
        heights=(options.lowest, options.highest), clearance=options.clearance, count=_PLACES,
    )  # fmt: skip
    if not len(places.eye):
        raise InputRefused(
            f"{asset.folder}: nowhere is there {options.clearance:g} m of free space that the "
            "cameras' places reach, at the heights asked for. Ask for less --clearance, or for "
            "other --lowest and --highest. [advice.space]"
        )
    fits = [read_fit(atlas.stage, obj.prim_path) for obj in atlas.scene.objects]
    survey = survey_of(lit, atlas, [fit for fit in fits if fit], places, up, options.seed)
    poses = choose(survey, options.poses)
    errors = [(fit.phi_error, fit.psi_error) if fit else (math.nan, math.nan) for fit in fits]
    known = bool(np.ptp(frames.exposure_time) > 0 or abs(frames.exposure_time[0] - 1) > 1e-9)
    can_be_seen = np.zeros(survey.of_surface, np.bool_)
    for visible in survey.visible:
        can_be_seen[visible[visible < survey.of_surface]] = True
    objects = atlas.scene.objects
    return Advice(
        poses=tuple(
            _posed(lit, survey, choice, places, errors, up, known=known) for choice in poses
        ),
        unseen_area=float(survey.area[survey.unseen & can_be_seen].sum()),
        seen_area=float(sum(survey.area[choice.new].sum() for choice in poses)),
        undetermined=tuple(objects[target.index].identifier for target in survey.targets),
        places=len(places.eye),
        in_room=places.in_room,
    )


def survey_of(
    lit: LitScene,
    atlas: AssetMaps,
    fits: Sequence[FittedObject],
    places: Places,
    up: int,
    seed: int,
) -> Survey:
    """All that poses are chosen from."""
    texels, known, frames = atlas.texels, lobes(), atlas.frames
    wanted = _wanted(atlas, fits)
    spots, own, of_surface = chosen_spots(texels, wanted, atlas.emissive, seed)
    level = level_of(lit, atlas.light, spots)
    # The diffuse part of what is seen: a lobe is on top of it.
    diffuse = atlas.map_where_present("diffuse", 3) if atlas.has("diffuse") else atlas.lit
    level[of_surface:] = level_of(lit, diffuse, spots)[of_surface:]
    targets = []
    for index, part in zip(wanted, own, strict=True):
        fit = fits[index]
        errors = (fit.phi_error, fit.psi_error, fit.psi_upper)
        likely = likely_lobes(known, fit.phi, fit.psi, *errors)
        typical = likely @ known.combination
        products = Products.none(part.stop - part.start, len(typical))
        targets.append(
            Target(index=index, own=part, likely=likely, typical=typical, products=products)
        )
    counted = spread_evenly(len(frames), _MOST_FRAMES)
    cameras = [frames.camera(i) for i in counted]
    exposures = [_exposure(frames, i) for i in counted]
    seen_by_frames(lit, spots, level, targets, cameras, exposures, seed)
    targets = [_as_the_fit_found(target, known, fits[target.index]) for target in targets]
    coverage, first = atlas.coverage, spots.texel[:of_surface]
    clipped = coverage.clipped[first]
    looks, camera = all_looks(up), frames.camera(0)
    visible, inside = look_from(lit, spots, targets, places.eye, looks, camera, seed)
    return Survey(
        spots=spots,
        level=level,
        of_surface=of_surface,
        area=np.full(of_surface, float(texels.area.sum(dtype=np.float64)) / of_surface),
        unseen=~coverage.observed[first],
        clipped=clipped,
        targets=tuple(targets),
        lobes=known,
        places=places.eye,
        visible=visible,
        looks=looks,
        inside=inside,
        camera=camera,
        exposures=_to_choose_from(frames, clipped=bool(clipped.any())),
    )


def _as_the_fit_found(target: Target, known: Lobes, fit: FittedObject) -> Target:
    """With what the fit made of the frames so far against what was reckoned."""
    contrasts = contrast(target.products, target.typical)
    found = replace(
        target,
        holds=share_found(known, target.likely, contrasts, fit.evidence),
        samples=_samples(fit, target.products),
    )
    stated = fit.phi_error, fit.psi_error
    return replace(found, coarser=coarser_than_reckoned(found.expected(known), *stated))


def _samples(fit: FittedObject, products: Products) -> float:
    """How many samples the fit had for each that is reckoned with; of large things enough."""
    if fit.num_pixels >= MIN_OBSERVATIONS:
        return math.inf
    return (fit.num_pixels + _HARDLY_ANY) / max(reckoned_samples(products), _HARDLY_ANY)


def _wanted(atlas: AssetMaps, fits: Sequence[FittedObject]) -> list[int]:
    """Objects whose lobe is not known, the largest first where they are too many, in order."""
    wanted, areas = [], []
    for i, fit in enumerate(fits):
        own = atlas.texels.of_object(i)
        if own.stop == own.start or fit.status == "measured":
            continue
        if fit.is_glass or fit.directive in LEFT_OUT:
            continue
        if atlas.emissive[own].mean() > _LAMP:
            continue
        wanted.append(i)
        areas.append(float(atlas.texels.area[own].sum()))
    order = np.argsort(-np.array(areas), kind="stable")[:_MOST_OBJECTS]
    return [wanted[k] for k in np.sort(order)]


def _exposure(frames: Frames, i: int) -> Exposure:
    return Exposure(
        float(frames.exposure_time[i]),
        float(frames.saturation_radiance[i]),
        float(frames.noise_floor_radiance[i]),
    )


def _to_choose_from(frames: Frames, *, clipped: bool) -> tuple[Exposure, ...]:
    """Those of the frames, the longest first, and where something clips in all a shorter one."""
    _, firsts = np.unique(np.round(np.log2(frames.exposure_time), 1), return_index=True)
    found = sorted((_exposure(frames, i) for i in firsts), key=lambda one: -one.time)
    if clipped:
        time, saturation, floor = found[-1]
        found.append(Exposure(time / _SHORTER, saturation * _SHORTER, floor * _SHORTER))
    return tuple(found)


def _posed(
    lit: LitScene,
    survey: Survey,
    choice: Choice,
    places: Places,
    errors: Sequence[tuple[float, float]],
    up: int,
    *,
    known: bool,
) -> AdvisedPose:
    scene = lit.scene.objects
    camera = camera_of(survey, choice)
    objects = told_objects(lit, survey, choice, errors)
    new = float(survey.area[choice.new].sum())
    unclipped = float(survey.area[choice.unclipped].sum())
    exposure = exposure_in_words(choice.exposure.time, known)
    height = float(places.height[choice.place])
    looks_at = looked_at(survey, choice, scene)
    clipped_on = tuple(
        scene[i].identifier for i in np.unique(survey.spots.owner[choice.unclipped]).tolist()
    )
    return AdvisedPose(
        camera=camera,
        exposure_time=choice.exposure.time,
        exposure=exposure,
        height=height,
        looks_at=looks_at,
        where=where(camera, up, height, looks_at, exposure),
        reason=reason(objects, new, owners_of(survey, choice, scene), unclipped, clipped_on),
        objects=objects,
        new_area=new,
        unclipped_area=unclipped,
    )
