"""What was captured and with what, for the page: frames on a map of the room, how they were
exposed, what was found and what not, in words."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import first_of
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.frames import read_frame, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.job.stamp import name_in_lighting, read_stamp, stamp_path
from usdbrdf.model.arrays import Byte, Double, Float
from usdbrdf.model.capture import Frames
from usdbrdf.page.pictures import data_uri
from usdbrdf.transport.lit_scene import LitScene

STEPS = ("ingest", "texture", "shade", "fit")
# Those that are done for each lighting apart.
_OF_LIGHTING = ("texture", "shade")
# Frames that are read for their exposures, pixels across the map, and names in a sentence, at most.
_MOST_READ, _MAP_WIDTH, _MOST_NAMED = 96, 480, 6
_FLOORLESS = np.array((40, 44, 52), np.uint8)
# Of words why a lobe was not measured, in this order: what is said of one object, and of several.
_BOUNDED = (
    "bounded: photographs do not determine both numbers, but tell that highlights are weaker than "
    "usual, if there are any."
)
_UNDETERMINED = (
    "not determined: no photograph shows a clear highlight, so the numbers are what remains likely."
)
_SPARSE = "seen in too few pixels for a fit: the numbers are a guess."
_FAILED = "photographs do not determine the numbers."
_GLIMPSED = "was measured, and everything but a colour is a guess."
_NOT_MEASURED = {
    "bounded": (f"{{n}} is {_BOUNDED}", f"{{n}} are {_BOUNDED}"),
    "undetermined": (f"{{n}} is {_UNDETERMINED}", f"{{n}} are {_UNDETERMINED}"),
    "sparse": (f"{{n}} is {_SPARSE}", f"{{n}} are {_SPARSE}"),
    "contradicted": (
        "The views of {n} contradict that it is a surface: something is seen through it or in it.",
        "The views of {n} contradict that they are surfaces: something is seen through them or in "
        "them.",
    ),
    "told": ("{n} was not fitted, by directive.", "{n} were not fitted, by directive."),
    "pane": ("{n} is a pane before the outside.", "{n} are panes before the outside."),
    "failed": (
        f"The fit of {{n}} failed: its {_FAILED}",
        f"The fit of {{n}} failed: their {_FAILED}",
    ),
    "glimpsed": (
        f"Photographs hardly show {{n}}: nothing on it {_GLIMPSED}",
        f"Photographs hardly show {{n}}: nothing on them {_GLIMPSED}",
    ),
}


def summaries(asset: Asset) -> dict[str, dict[str, Any]]:
    """What each step found when it ran, in the asset's lighting, by its name; empty where its stamp
    is gone."""
    found = {}
    for number, name in enumerate(STEPS, start=1):
        own = asset.lighting if name in _OF_LIGHTING else ""
        stamp = read_stamp(stamp_path(asset.folder, number, name_in_lighting(name, own)))
        found[name] = dict(stamp.summary) if stamp else {}
    return found


def warnings_of(found: Mapping[str, Mapping[str, Any]]) -> list[str] | None:
    """All sentences of warning, in the order of the steps; None where no step's stamp is there: a
    published version does not hold what they told."""
    if not any(found[step] for step in STEPS):
        return None
    return [str(sentence) for step in STEPS for sentence in found[step].get("warnings", ())]


def frame_rows(frames: Frames) -> list[dict[str, Any]]:
    """Of frames spread evenly: which they are, how they were exposed, and which shares of their
    pixels are clipped, dark or unknown."""
    chosen, rows = spread_evenly(len(frames), _MOST_READ), []
    images = read_frames(lambda i: read_frame(frames, i), chosen)
    for i, pixels in progress(images, total=len(chosen), label="report", unit="frames"):
        known = pixels.radiance[~pixels.unknown]
        rows.append(
            {
                "number": i,
                "name": frames.image_paths[i].name,
                "exposure_s": float(frames.exposure_time[i]),
                "clipped": round(float(pixels.clipped.mean()), 6),
                "dark": round(float(pixels.dark.mean()), 6),
                "unknown": round(float(pixels.unknown.mean()), 6),
                "median": float(np.median(known)) if known.size else None,
            }
        )
    return rows


def room_map(
    atlas: AssetMaps,
    lit: LitScene,
    colours: Float,
    up_axis: str,
    advised: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """The room from above, cut open at the cameras' height, and where the cameras stood on that
    picture: x, y as shares of width and height, and the direction that they looked in, in the
    same, of unit length.

    colours  (T, 3), linear
    advised  poses of photographs to come, which are told of in the same way
    """
    up = 2 if up_axis == "Z" else 1
    # On the map right and down, so that it is no mirror image: x and -y, or x and z.
    right, down, sign = (0, 1, -1.0) if up == 2 else (0, 2, 1.0)
    poses = atlas.frames.world_from_camera
    eyes = np.array([*poses[:, :3, 3], *(pose["eye"] for pose in advised)], np.float64)
    looks = np.array([*-poses[:, :3, 2], *(pose["direction"] for pose in advised)], np.float64)
    plan = np.stack([eyes[:, right], sign * eyes[:, down]], axis=1)
    points = atlas.scene.points
    across = np.concatenate([np.stack([points[:, right], sign * points[:, down]], axis=1), plan])
    low, high = across.min(axis=0), across.max(axis=0)
    margin = 0.03 * float((high - low).max())
    low, high = low - margin, high + margin
    size = high - low
    width = _MAP_WIDTH
    height = int(np.clip(round(width * size[1] / max(size[0], 1e-9)), 40, 2 * width))
    level = float(np.median(poses[:, up, 3]))
    picture = _from_above(
        lit, colours, (low, size), (height, width), (right, down, up, sign, level)
    )
    direction = np.stack([looks[:, right], sign * looks[:, down]], axis=1)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    place = (plan - low) / size
    cameras = np.concatenate([place, direction], axis=1).round(4).tolist()
    return {
        "picture": data_uri(picture), "width": width, "height": height,
        "cameras": cameras[: len(poses)], "advised": cameras[len(poses) :],
        "metres": [round(float(n), 2) for n in size],
    }  # fmt: skip


def _from_above(
    lit: LitScene,
    colours: Float,
    window: tuple[Double, Double],
    pixels: tuple[int, int],
    axes: tuple[int, int, int, float, float],
) -> Byte:
    (low, size), (height, width), (right, down, up, sign, level) = window, pixels, axes
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    origins = np.zeros((width * height, 3), np.float32)
    origins[:, right] = (low[0] + x * size[0]).ravel()
    origins[:, down] = sign * (low[1] + y * size[1]).ravel()
    origins[:, up] = level
    directions = np.zeros_like(origins)
    directions[:, up] = -1
    hits = lit.rays.closest(origins, directions)
    shown = lit.radiance.showing(lit.texels, colours).at(hits.face, hits.u, hits.v)
    picture = to_display_srgb8(shown.reshape(height, width, 3), exposure_scale=1.0)
    return np.where((hits.face >= 0).reshape(height, width, 1), picture, _FLOORLESS)


def findings(
    found: Mapping[str, Mapping[str, Any]],
    words: Sequence[str],
    radiometric: bool,
    never_observed: Collection[str] = (),
    shining_parts: Sequence[str] = (),
    *,
    metals: Sequence[str] = (),
    dark_outside: bool = False,
) -> list[str]:
    """What was found, what not and why, in sentences.

    words           of each object, see ``status_of`` and ``undetermined_because``
    never_observed  identifiers of objects of which no frame tells anything
    shining_parts   those of objects that are no lamps but of a small part
    metals          those of objects that are metals, measured well or not
    dark_outside    whether next to no light comes from what photographs show out there
    """
    total = len(words)
    told = [f"{words.count('measured')} of {total} objects have a measured roughness and specular."]
    if metals:
        told.append(
            f"{len(metals)} {_by_count(len(metals), 'is a metal', 'are metals')}: "
            f"{first_of(metals, _MOST_NAMED)}."
        )
    told += _of_objects(words)
    if unseen := words.count("unseen"):
        told.append(f"No photograph shows {unseen if unseen < total else 'any'} of the objects.")
    if lamps := words.count("lamp"):
        told.append(f"{lamps} {_by_count(lamps, 'is a lamp', 'are lamps')}.")
    if shining_parts:
        many = len(shining_parts)
        parts = f"{_by_count(many, 'A part', 'Parts')} of {first_of(shining_parts, _MOST_NAMED)}"
        told.append(f"{parts} {_by_count(many, 'shines', 'shine')}, too.")
    told += _of_light(found["texture"], found["shade"], never_observed, dark_outside)
    if not radiometric:
        told.append("The images are not radiometric: albedo and fit have no absolute meaning.")
    return told


def _of_objects(words: Sequence[str]) -> list[str]:
    """A sentence on those that share a word, of each that says why a lobe was not measured."""
    counts = ((words.count(word), says) for word, says in _NOT_MEASURED.items())
    return [_by_count(n, *says).format(n=n) for n, says in counts if n]


def _of_light(
    texture: Mapping[str, Any],
    shade: Mapping[str, Any],
    never_observed: Collection[str],
    dark_outside: bool,
) -> list[str]:
    """How well surfaces and the light on them are known, by what the two steps found."""
    told = []
    if "measured_fraction" in texture:
        told.append(
            f"Photographs measured {texture['measured_fraction']:.1%} of the surface; "
            f"{texture.get('clipped_fraction', 0):.2%} clipped in all that show it; "
            f"{_glimpsed(texture)}the rest is filled in from around it."
        )
    if "standard_error" in shade:
        told.append(f"The traced light has a standard error of {shade['standard_error']:.1%}.")
    if (escaped := shade.get("escaped_fraction", 0)) > 0.001:
        told.append(
            f"{escaped:.1%} of the directions in which surfaces look leave the scan. "
            f"{_outside(shade.get('outside'), dark=dark_outside)}"
        )
    estimated = list(shade.get("estimated_emitters", {}))
    for wanted in (False, True):
        names = [name for name in estimated if (name in never_observed) == wanted]
        told += _estimated_lamps(names, never_observed=wanted)
    return told


def _glimpsed(texture: Mapping[str, Any]) -> str:
    share = texture.get("glimpsed_fraction", 0)
    return f"{share:.2%} is too thin for that and was glimpsed; " if share >= 0.00005 else ""


def _outside(found: Mapping[str, Any] | None, *, dark: bool) -> str:
    if found is None:
        return "What is out there counts as dark."
    if dark:
        return "It is dark out there, as by night: next to no light comes in."
    names = ["sky", *(["sun"] if "sun_direction" in found else [])]
    if found.get("source") != "estimated":
        return f"A file told the light from there: {' and '.join(names)}."
    errors = {name: found.get(f"{name}_error") for name in names}
    told = [
        f"{name} to \u00b1 {e:.0%}" if e else f"{name} as photographs show it"
        for name, e in errors.items()
    ]
    how = "was estimated" if any(errors.values()) else "is known"
    return f"The light from there {how}: {', '.join(told)}."


def _estimated_lamps(names: Sequence[str], *, never_observed: bool) -> list[str]:
    """In one sentence at most, also of a room with hundreds."""
    if not names:
        return []
    count = len(names)
    lamps = f"he {_by_count(count, 'lamp', 'lamps')} {first_of(names, _MOST_NAMED)}"
    how = f"No photograph measures t{lamps}" if never_observed else f"T{lamps} clipped everywhere"
    what = _by_count(count, "its radiance is an estimate", "their radiances are estimates")
    return [f"{how}: {what}."]


def _by_count(count: int, one: str, many: str) -> str:
    """What is said of one thing, or of none or several."""
    return one if count == 1 else many
