"""Why a photograph is advised, for the person who is to take it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usdbrdf.advice.choice import Choice, Gain
from usdbrdf.advice.knowledge import PHIS
from usdbrdf.advice.survey import Survey, placed
from usdbrdf.asset.advice import AdvisedObject
from usdbrdf.model.arrays import Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import SceneObject
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.rays import lift_from_surface

# Of an object's expected gain what is worth a word, and how many words at most; and of the surface
# that is seen for the first time what belongs to objects that are worth one.
_TOLD, _MOST = 0.02, 3
_SHARE = 0.15
# Points whose reflections are followed to what they show.
_FOLLOWED = 24


def camera_of(survey: Survey, choice: Choice) -> Camera:
    """The camera of a photograph."""
    return placed(survey.camera, survey.places[choice.place], survey.looks[choice.look])


def told_objects(
    lit: LitScene, survey: Survey, choice: Choice, errors: Sequence[tuple[float, float]]
) -> tuple[AdvisedObject, ...]:
    """The objects that a photograph tells most of, the most first; errors: of each object, the
    stated deviations of phi and psi before any of the photographs."""
    best = sorted(choice.gains, key=lambda gain: gain.before.worth - gain.after.worth)
    told = [gain for gain in best if gain.after.worth - gain.before.worth > _TOLD][:_MOST]
    return tuple(_told(lit, survey, choice, gain, errors[gain.owner]) for gain in told)


def _told(
    lit: LitScene, survey: Survey, choice: Choice, gain: Gain, stated: tuple[float, float]
) -> AdvisedObject:
    obj = lit.scene.objects[gain.owner]
    before = (gain.before.phi_error, gain.before.psi_error)
    # What was found and what is expected come from two reckonings: the larger one is told before.
    known = [max(a, b) if math.isfinite(b) else a for a, b in zip(before, stated, strict=True)]
    return AdvisedObject(
        prim_path=obj.prim_path,
        identifier=obj.identifier,
        phi_error=known[0],
        psi_error=known[1],
        phi_error_expected=min(gain.after.phi_error, known[0]),
        psi_error_expected=min(gain.after.psi_error, known[1]),
        measured_expected=gain.after.measured,
        reflects=_reflected(lit, survey, choice, gain.owner),
    )


def _reflected(lit: LitScene, survey: Survey, choice: Choice, index: int) -> str:
    """Identifier of what most of an object's highlight is a reflection of; "" where it is the
    surroundings beyond the scan."""
    target = next(t for t in survey.targets if t.index == index)
    which, basis = target.sights[choice.place]
    spots = survey.visible[choice.place][survey.inside[choice.place][choice.look]]
    inside = np.isin(which + target.own.start, spots)
    which, lobe = which[inside], (basis @ target.typical)[inside]
    best = which[np.argsort(-lobe, kind="stable")[:_FOLLOWED]] + target.own.start
    eye = survey.places[choice.place]
    points = survey.spots.towards(best, eye)
    along = 2 * np.einsum("rd,rd->r", points.normal, points.to_camera)[:, None]
    mirrored = np.ascontiguousarray(along * points.normal - points.to_camera, np.float32)
    origin = lift_from_surface(points.position, points.normal, lit.diagonal_m)
    # What shines near the mirror direction is what shows: a lobe has some width.
    width = (PHIS[0] + PHIS[4]) / 2
    brightness: dict[int, float] = {}
    for offset in _around(width):
        directions = mirrored + offset
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        hits = lit.rays.closest(origin, np.ascontiguousarray(directions, np.float32))
        light = lit.radiance.at(hits.face, hits.u, hits.v).mean(axis=1)
        for owner, shown in zip(lit.owner(hits.face).tolist(), light.tolist(), strict=True):
            brightness[owner] = brightness.get(owner, 0.0) + shown
    found = max(brightness, key=lambda owner: (brightness[owner], owner)) if brightness else -1
    return lit.scene.objects[found].identifier if found >= 0 else ""


def _around(width: float) -> Float:
    """(7, 3) offsets: none, and so far along each axis."""
    return np.concatenate([np.zeros((1, 3)), width * np.eye(3), -width * np.eye(3)]).astype(
        np.float32
    )


def owners_of(survey: Survey, choice: Choice, objects: Sequence[SceneObject]) -> tuple[str, ...]:
    """Identifiers of the objects that most of what is seen for the first time belongs to."""
    if not len(choice.new):
        return ()
    owner = survey.spots.owner[choice.new]
    area = np.bincount(owner, survey.area[choice.new], len(objects))
    order = np.argsort(-area, kind="stable")[:_MOST]
    return tuple(objects[i].identifier for i in order if area[i] >= _SHARE * area.sum())


def looked_at(survey: Survey, choice: Choice, objects: Sequence[SceneObject]) -> str:
    """Identifier of the object in the middle of the picture; "" where there is none."""
    spots = survey.visible[choice.place]
    spots = spots[survey.inside[choice.place][choice.look]]
    if not len(spots):
        return ""
    ahead = -survey.looks[choice.look][:, 2]
    way = survey.spots.position[spots] - survey.places[choice.place]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return objects[int(survey.spots.owner[spots[(way @ ahead).argmax()]])].identifier


def exposure_in_words(time_s: float, known: bool) -> str:
    """1/500 s, 2.5 s; where nobody said how long the frames were exposed, in stops."""
    if known:
        return f"1/{1 / time_s:.0f} s" if time_s < 0.4 else f"{_two_digits(time_s)} s"
    stops = math.log2(time_s)
    if abs(stops) < 0.05:
        return "as before"
    return f"{abs(stops):.1f} stops {'shorter' if stops < 0 else 'longer'} than before"


def _two_digits(value: float) -> str:
    """To two digits as people write them: 230, 61, 0.4."""
    return f"{float(f'{value:.2g}'):.9g}"


def reason(
    objects: Sequence[AdvisedObject], new_m2: float, new_on: Sequence[str], clipped_m2: float,
    clipped_on: Sequence[str],
) -> str:  # fmt: skip
    """Why, in a sentence or two."""
    said: list[str] = []
    for one in objects:
        what = f"the reflection of {one.reflects}" if one.reflects else "what reflects"
        if not said:  # it begins a sentence
            what = what[0].upper() + what[1:]
        said.append(f"{what} on {one.identifier}: {_better(one)}")
    if new_m2 > 0:
        on = f" ({', '.join(new_on)})" if new_on else ""
        said.append(f"{_two_digits(new_m2)} m^2 that no frame shows{on}")
    if clipped_m2 > 0:
        on = ", ".join(clipped_on) or "what is bright"
        said.append(f"{on} without clipping")
    return "; ".join(said) + "." if said else "More of the same."


def _better(one: AdvisedObject) -> str:
    changes = [
        f"{name} +-{before:.2f} -> +-{after:.2f}"
        for name, before, after in (
            ("psi", one.psi_error, one.psi_error_expected),
            ("phi", one.phi_error, one.phi_error_expected),
        )
    ]
    return ", ".join(changes)


def where(camera: Camera, up: int, height: float, looks_at: str, exposure: str) -> str:
    """Where to stand and to look, in a sentence."""
    eye = ", ".join(f"{value:.2f}" for value in camera.eye)
    above = f", {height:.1f} m above the ground" if math.isfinite(height) else ""
    tilt = math.degrees(math.asin(np.clip(-camera.world_from_camera[up, 2], -1, 1)))
    steep = "level" if abs(tilt) < 5 else f"{abs(tilt):.0f} degrees {'up' if tilt > 0 else 'down'}"
    at = f" to {looks_at}" if looks_at else ""
    return f"Stand at ({eye}) m{above}, look{at} ({steep}), {exposure}."


def lines(summary: Mapping[str, Any]) -> list[str]:
    """What a person reads at the end of ``advise``."""
    said = [
        f"{k}. {pose['where']} {pose['reason']}" for k, pose in enumerate(summary["poses"], start=1)
    ]
    if not said:
        return ["nothing to photograph: no free pose would tell more than is known"]
    if summary["unseen_area"] > 0:
        share = summary["seen_area"] / summary["unseen_area"]
        said.append(
            f"{_two_digits(summary['unseen_area'])} m^2 can be seen that no frame shows; these "
            f"show {share:.0%} of it"
        )
    return [*said, f"{summary['layer']}: written"]
