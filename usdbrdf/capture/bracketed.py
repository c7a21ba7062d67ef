"""A capture whose frames are brackets becomes one of radiance, before anything else reads it.

In transforms.json a frame has ``brackets``, a list of ``{"file_path", "exposure_time"}``, or
several frames have one transform_matrix. A folder without it holds the photographs of one bracket.
All photographs are 8-bit ones of one camera with fixed settings but for the exposure, which where
it is not stated is in their EXIF data.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from usdbrdf.capture.alignment import Aligned, aligned
from usdbrdf.capture.brackets import Response, merge, response_from_brackets
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import environment_failures, whole_folder
from usdbrdf.files.colour import encoding_of_tag, linear_space_of
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.exif import exif_exposure, told_by_some
from usdbrdf.files.frames import PHOTOGRAPH_ENCODING, transparent_of
from usdbrdf.files.images import colour_tag, is_eight_bit, needs_float, read_radiance, write_exr
from usdbrdf.files.paths import contained, seen_of
from usdbrdf.job.progress import progress, warn
from usdbrdf.model.arrays import Double

_SPACES = ("srgb_rec709_scene", "srgb_p3d65_scene", "g22_adobergb_scene")
_PHOTOGRAPHS = frozenset((".jpg", ".jpeg", ".png"))
# Brackets that the response is told by.
_TELLING = 12
# Between which exposures lie, in seconds or as EXIF data has them: far more than cameras do. What
# is beyond makes radiance that no float holds.
_LEAST_EXPOSURE, _MOST_EXPOSURE = 1e-12, 1e12
_LONGEST_STEM = 200  # bytes, of the 255 that file systems allow a name


class Bracket(NamedTuple):
    """Of one view: the entry that the document has for it, the images by exposure, the longest
    first, and their exposures (K,)."""

    entry: Mapping[str, Any]
    images: tuple[Path, ...]
    exposures: Double


def merge_brackets(capture: Path, folder: Path) -> dict[str, Any]:
    """Write the capture with one EXR of radiance for each bracket into the new ``folder``, and say
    what was found: numbers of brackets and photographs, shares of clipped and contradicting pixels,
    and by frame the photographs of which nobody knows whether the camera moved.

    The unit is the same for all frames and has no other meaning: radiometric up to one scale.
    Raises InputRefused for what makes no brackets.
    """
    source = document_named(capture)
    if capture.is_dir() and not source.is_file():
        document: Any = _document_of_folder(capture)
    else:
        document = read_json(source, nonfinite_below=("transform_matrix",))
    brackets = _brackets(source, document)
    beside = files_beside(source, document)
    encoding = _linear_space(source, document, brackets[0].images[0])
    telling = [brackets[i] for i in spread_evenly(len(brackets), _TELLING)]
    response = response_from_brackets(
        [_aligned(bracket).stack for bracket in telling], [bracket.exposures for bracket in telling]
    )
    frames, clipped, ghosts = [], [], []
    flickers: list[tuple[str, float]] = []
    unchecked: dict[str, list[str]] = {}
    with environment_failures(str(folder)), whole_folder(folder) as staged:
        (staged / "frames").mkdir()
        for i, bracket in enumerate(
            progress(brackets, total=len(brackets), label="brackets", unit="brackets")
        ):
            name = frame_of(i, bracket.images[0])
            made = _merged(bracket, response, staged / name, encoding)
            frames.append({**made.entry, "file_path": name})
            clipped.append(made.clipped)
            ghosts.append(made.ghost)
            flickers.extend(made.flicker)
            if made.unchecked:
                unchecked[name] = made.unchecked
        copy_beside(beside, staged)
        rest = {**document, "frames": frames, "encoding": encoding}
        write_json(staged / "transforms.json", rest)
    told = source if source.is_file() else capture
    photographs = sum(len(bracket.images) for bracket in brackets)
    alone = sum(map(len, unchecked.values()))
    if unchecked:
        name, files = next(iter(unchecked.items()))
        warn(
            f"{told}: {alone} of {photographs} photographs, in {len(unchecked)} of "
            f"{len(brackets)} brackets, share no clear code with the exposure next to theirs, so "
            f"that nothing tells whether the camera moved; they are merged as they are (first "
            f"{', '.join(files)} in {name}). Bracket in smaller steps, or use a tripod. "
            "[brackets.unchecked]"
        )
    if flickers:
        file, factor = max(flickers, key=lambda one: abs(np.log(one[1])))
        warn(
            f"{told}: {len(flickers)} of {photographs} photographs are all brighter or darker "
            f"than their exposures say, {file} most of all ({factor:.2f} x), as a lamp's "
            "flicker or a fast shutter may make them; that factor has been taken out. With lamps "
            "in view take exposures of 1/50 s or longer, through a grey filter. [brackets.flicker]"
        )
    ranges = [float(b.exposures[0] / b.exposures[-1]) for b in brackets]
    return {
        "brackets": len(brackets),
        "photographs": photographs,
        "stops": float(np.log2(max(ranges))),
        "clipped_share": float(np.mean(clipped)),
        "contradicting_share": float(np.mean(ghosts)),
        "contradicting_share_of_worst": float(np.max(ghosts)),
        "unchecked_share": alone / (photographs - len(brackets)),
        "unchecked": unchecked,
        "flickering": len(flickers),
    }


def document_named(capture: Path) -> Path:
    """The transforms.json that a command is to work on: in a folder, or itself."""
    if capture.is_file() and capture.suffix.lower() != ".json":
        raise InputRefused(
            f"{capture}: neither a folder nor a transforms.json. Name the folder that it lies in. "
            "[capture.format]"
        )
    return capture / "transforms.json" if capture.is_dir() else capture


def files_beside(source: Path, document: Any) -> dict[str, Path]:
    """The mesh, the objects and the masks that a transforms.json has beside it, by the names that
    it gives them; InputRefused where what is there is no file: a pipe would be waited for."""
    masks = {str(f["mask_path"]) for f in document["frames"] if f.get("mask_path") is not None}
    usual = (("mesh", "mesh.ply"), ("objects", "objects.json"))
    names = (*(str(document.get(key, own)) for key, own in usual), *sorted(masks))
    found = {name: contained(source.parent, name) for name in names}
    for place in found.values():
        if place.exists() and not place.is_file():
            raise InputRefused(
                f"{place}: not a regular file. Put the file there that {source.name} means, or "
                "take its entry out. [capture.file]"
            )
    return {name: file for name, file in found.items() if file.is_file()}


def copy_beside(beside: Mapping[str, Path], folder: Path) -> None:
    """Copy ``files_beside`` into another folder, under the same names."""
    for name, file in beside.items():
        place = contained(folder, name)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)


class _Made(NamedTuple):
    """The frame's entry, shares of clipped and contradicting pixels, names of unchecked files, and
    the exposures whose pixels are all by a factor brighter than stated: file and factor."""

    entry: dict[str, Any]
    clipped: float
    ghost: float
    unchecked: list[str]
    flicker: list[tuple[str, float]]


def _merged(bracket: Bracket, response: Response, place: Path, encoding: str) -> _Made:
    """Writes the picture."""
    laid = _aligned(bracket)
    found = merge(laid.stack, bracket.exposures, response, laid.silent)
    # What is clearly negative is unknown to every reader of frames.
    pixels = np.where(np.isnan(found.radiance), -np.float32(found.saturation), found.radiance)
    write_exr(place, pixels, half=not needs_float(pixels), encoding=encoding)
    entry = {k: v for k, v in bracket.entry.items() if k not in ("brackets", "exposure_time")}
    entry.update(saturation_radiance=found.saturation, noise_floor_radiance=found.noise_floor)
    alone = np.flatnonzero(laid.unchecked).tolist()
    factors = zip(bracket.images, found.exposures / bracket.exposures, strict=True)
    return _Made(
        entry,
        found.clipped,
        found.ghost,
        [bracket.images[k].name for k in alone],
        [(image.name, float(factor)) for image, factor in factors if factor != 1],
    )


def _aligned(bracket: Bracket) -> Aligned:
    pictures = []
    for path in bracket.images:
        if not is_eight_bit(path):
            raise InputRefused(
                f"{path}: not an 8-bit image. Brackets are merged from JPEG or PNG; merge others "
                "with the program that developed them. [brackets.format]"
            )
        stored = read_radiance(path, alpha=True)
        if transparent_of(stored).any():
            raise InputRefused(
                f"{path}: part of it is transparent. Brackets are merged from opaque photographs; "
                "export them without alpha, and say with mask_path what is not to be looked at. "
                "[brackets.alpha]"
            )
        pictures.append(np.round(255 * stored[..., :3]).astype(np.uint8))
    sizes = {picture.shape for picture in pictures}
    if len(sizes) > 1:
        raise InputRefused(
            f"{bracket.images[0]}: the images of this bracket have {len(sizes)} sizes. Export all "
            "of them alike. [brackets.size]"
        )
    return aligned(np.array(pictures), [path.name for path in bracket.images])


def frame_of(number: int, photograph: Path) -> str:
    """Where the frame of a photograph is written, called after it as far as names may be."""
    stem = os.fsencode(photograph.stem)[:_LONGEST_STEM].decode("utf-8", "ignore")
    return f"frames/{number:05d}_{stem}.exr"


def is_exposure(value: object) -> TypeGuard[float]:
    """Whether something stated is the exposure of a photograph."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and _LEAST_EXPOSURE <= value <= _MOST_EXPOSURE
    )


def exposure_of(photograph: Path, given: object, rule: str) -> float:
    """What is stated of a photograph, else known of its file; InputRefused by ``rule`` where that
    is no exposure."""
    if not is_exposure(given):
        said = f"{str(given)[:80]!r} is no exposure_time of a camera"
        if given is None:
            said = "no exposure_time is stated, and its EXIF data has none"
        raise InputRefused(f"{photograph}: {said}. State the exposure in seconds. [{rule}]")
    return float(given)


def frames_of_document(source: Path, document: Any) -> list[dict[str, Any]]:
    """The entries of a transforms.json; InputRefused where it has none."""
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputRefused(
            f'{source}: no list "frames" of objects, so this is not a transforms.json. Name the '
            "capture's own document. [capture.format]"
        )
    return frames


def _linear_space(source: Path, document: Any, photograph: Path) -> str:
    """The space of what is merged, linear in the primaries of the photographs."""
    stated, tag = document.get("encoding"), colour_tag(photograph)
    known = encoding_of_tag(*tag)
    said = stated or known or PHOTOGRAPH_ENCODING
    if not stated and tag[0] and known is None:
        warn(
            f"{photograph}: it says that its colour space is {tag[0]!r}, which is not known; the "
            f"photographs are merged as {said}. Convert them to sRGB or Display P3, or state the "
            '"encoding" in a transforms.json. [brackets.encoding]'
        )
    if said not in (*_SPACES, *map(linear_space_of, _SPACES)):
        names = ", ".join(_SPACES)
        raise InputRefused(
            f"{source if stated else photograph}: its colour space is {said!r}; brackets are "
            f"merged from photographs in one of {names}. Convert them. [brackets.encoding]"
        )
    return linear_space_of(said)


def _document_of_folder(folder: Path) -> dict[str, Any]:
    """What a transforms.json would say of a folder of photographs, all of one view."""
    with environment_failures(str(folder)):
        paths = sorted(p for p in seen_of(folder.iterdir()) if p.suffix.lower() in _PHOTOGRAPHS)
    if len(paths) < 2:
        raise InputRefused(
            f"{folder}: neither a transforms.json nor two photographs (JPEG, PNG) of one view. "
            "Name the folder of a capture or of a bracket. [brackets.none]"
        )
    _refuse_unlike(paths)
    exposures = [exif_exposure(path) for path in paths]
    if None not in exposures and len(set(exposures)) < len(paths):
        first = next(p for p, e in zip(paths, exposures, strict=True) if exposures.count(e) > 1)
        raise InputRefused(
            f"{folder}: {first.name} is exposed as another photograph is, so these are of several "
            "views. Put each bracket into a folder of its own, or list those of each view in a "
            "transforms.json. [brackets.views]"
        )
    return {"frames": [{"brackets": [{"file_path": path.name} for path in paths]}]}


def _refuse_unlike(photographs: Sequence[Path]) -> None:
    """InputRefused where of photographs only some tell what exposures are compared by."""
    if unlike := told_by_some(photographs):
        what, telling, silent = unlike
        raise InputRefused(
            f"{silent}: its EXIF data tell no {what}, those of {telling.name} do, so they cannot "
            'be compared. State the "exposure_time" of all in a transforms.json, in seconds at one '
            "f-number and ISO speed. [brackets.exposure]"
        )


def _brackets(source: Path, document: Any) -> list[Bracket]:
    """The brackets of a document, in its order."""
    frames = frames_of_document(source, document)
    views: dict[str, tuple[Mapping[str, Any], list[Any]]] = {}
    for frame in frames:
        listed = frame.get("brackets")
        images = listed if isinstance(listed, list) else [frame]
        _, own = views.setdefault(str(frame.get("transform_matrix")), (frame, []))
        own.extend(images)
    found = [_bracket(source, entry, images) for entry, images in views.values()]
    photographs = [image for _, images in views.values() for image in images]
    unstated = [i["file_path"] for i in photographs if i.get("exposure_time") is None]
    _refuse_unlike([contained(source.parent, name) for name in unstated])
    if not found or all(len(bracket.images) < 2 for bracket in found):
        raise InputRefused(
            f"{source}: no frame has brackets, and no two frames have one transform_matrix. List "
            'the photographs of each view as "brackets", or convert the capture as it is. '
            "[brackets.none]"
        )
    return found


def _bracket(source: Path, entry: Mapping[str, Any], images: list[Any]) -> Bracket:
    paths, exposures = [], []
    for image in images:
        name = image.get("file_path") if isinstance(image, dict) else None
        if not isinstance(name, str):
            raise InputRefused(f"{source}: a bracket without file_path. Name it. [brackets.format]")
        path = contained(source.parent, name)
        if not path.is_file():
            raise InputRefused(f"{path}: no such file. Copy it or remove its entry. [capture.file]")
        given = image.get("exposure_time")
        if given is None:
            given = exif_exposure(path)
        exposures.append(exposure_of(path, given, "brackets.exposure"))
        paths.append(path)
    order = np.argsort([-exposure for exposure in exposures], kind="stable")
    return Bracket(entry, tuple(paths[i] for i in order), np.array(exposures)[order])
