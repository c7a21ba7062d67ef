"""A capture whose frames are those of a video that cycles exposures becomes one of radiance, before
anything else reads it.

In transforms.json "video" names the file, each frame has a number in it, "video_frame", from 0 on,
and "exposure_cycle" lists the exposures in seconds that the camera went through from the first
frame on, over and over; or "exposure_table" names a CSV file of frame and exposure_time. What
follows each other shows nearly the same: such frames, laid onto each other, tell the response as
brackets do, and each of them says how its exposure compares with those beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.capture.alignment import aligned
from usdbrdf.capture.bracketed import (
    copy_beside,
    document_named,
    files_beside,
    frames_of_document,
    is_exposure,
)
from usdbrdf.capture.brackets import BRIGHT_CODE, DARK_CODE, Response, merge, response_from_brackets
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused, first_of
from usdbrdf.files.atomic import environment_failures, whole_folder
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.images import needs_float, read_radiance, write_exr
from usdbrdf.files.paths import contained
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.files.tables import csv_rows, number_in
from usdbrdf.job.progress import progress, say, warn
from usdbrdf.model.arrays import Byte, Double
from usdbrdf.untrusted.video_files import MOST_FRAMES, frames_of_video, place_of

# Runs of frames that the response is told by, and how long such a run is, at most.
_TELLING, _RUN = 12, 4
_CONTRADICTING = calibration.number("video.contradicting")
_MOST = calibration.number("video.most")
# Pixels along each side of which one is asked how bright a frame is.
_STRIDE = 2
# Ranks at which the codes of two frames are compared, and how many must tell.
_RANKS, _FEWEST = 64, 8
# What is named in one line.
_LISTED = 6


class _Video(NamedTuple):
    """The document's frames and their numbers; exposures in seconds by number; and after how many
    frames they repeat, 0 where a table says them."""

    source: Path
    entries: list[dict[str, Any]]
    numbers: list[int]
    exposures: Mapping[int, float]
    cycle: int


def develop_video(capture: Path, folder: Path) -> dict[str, Any]:
    """Write the capture with an EXR of radiance for each frame of its video into the new
    ``folder``, and say what was found: numbers of frames, stops between exposures, share of clipped
    pixels, and by how many stops which frames contradict those beside them.

    The unit is the same for all frames and has no other meaning: radiometric up to one scale.
    Raises InputRefused for what is no capture of a video, and where the exposures are not those
    that its pixels show.
    """
    source = document_named(capture)
    document = read_json(source, nonfinite_below=("transform_matrix",))
    video, beside = _video(source, document), files_beside(source, document)
    path = contained(source.parent, str(document["video"]))
    with scratch_folder() as scratch:
        wanted = {n + step for n in video.numbers for step in (-1, 0, 1)} | {
            n + step for n in _telling(video) for step in range(_RUN)
        }
        known = sorted(n for n in wanted if n in video.exposures)
        say(f"video: {len(known)} frames are decoded up to number {known[-1]}, then merged")
        found = frames_of_video(path, known, scratch)
        _refuse_missing(path, video, found.numbers)
        there = frozenset(found.numbers)
        response = _response(video, there, scratch)
        off = _contradicting(video, there, response, scratch)
        _judge(video, off)
        frames, clipped = [], []
        with environment_failures(str(folder)), whole_folder(folder) as staged:
            (staged / "frames").mkdir()
            rows = zip(video.numbers, video.entries, strict=True)
            for n, entry in progress(
                list(rows), total=len(video.numbers), label="video", unit="frames"
            ):
                name, exposure = f"frames/{n:06d}.exr", video.exposures[n]
                codes = _codes(scratch, n)
                made = merge(codes[None], np.array([exposure]), response)
                pixels = np.where(np.isnan(made.radiance), -made.saturation, made.radiance)
                write_exr(staged / name, pixels, half=not needs_float(pixels))
                clipped.append(made.clipped)
                kept = {k: v for k, v in entry.items() if k != "video_frame"}
                limits = {
                    "saturation_radiance": made.saturation,
                    "noise_floor_radiance": made.noise_floor,
                }
                frames.append({**kept, "file_path": name, "exposure_time": exposure, **limits})
            copy_beside(beside, staged)
            of_video = ("video", "exposure_cycle", "exposure_table")
            rest = {k: v for k, v in document.items() if k not in of_video}
            rest |= {"frames": frames, "encoding": "lin_rec709_scene"}
            write_json(staged / "transforms.json", rest)
    stated = [video.exposures[n] for n in video.numbers]
    return {
        "frames": len(frames),
        "width": found.resolution[0],
        "height": found.resolution[1],
        "stops": float(np.log2(max(stated) / min(stated))),
        "clipped_share": float(np.mean(clipped)),
        "contradicting": {str(n): round(stops, 2) for n, stops in off.items()},
    }


def _video(source: Path, document: Any) -> _Video:
    entries = frames_of_document(source, document)
    if not isinstance(document.get("video"), str):
        raise InputRefused(
            f'{source}: names no "video". Convert the capture as it is, or name the video and each '
            "frame's number in it, video_frame. [video.none]"
        )
    numbers = [entry.get("video_frame") for entry in entries]
    sound = [
        n
        for n in numbers
        if isinstance(n, int) and not isinstance(n, bool) and 0 <= n < MOST_FRAMES
    ]
    if len(sound) < len(numbers) or len(set(sound)) < len(sound) or not sound:
        raise InputRefused(
            f"{source}: its frames need a video_frame each, a whole number from 0 to "
            f"{MOST_FRAMES - 1} that no other has. Correct them. [video.frames]"
        )
    exposures, cycle = _exposures(source, document, max(sound) + _RUN)
    without = next((n for n in sound if n not in exposures), None)
    if without is not None:
        raise InputRefused(
            f"{source}: no exposure is stated for the frame {without} of its video. Add it to the "
            "table. [video.exposure]"
        )
    decoded = {n + step for n in sound for step in range(-1, _RUN)} & exposures.keys()
    if len({exposures[n] for n in decoded}) < 2:
        raise InputRefused(
            f"{source}: its frames and those beside them all have one exposure, so that nothing "
            "tells the response of the camera. Export the frames as PNG and convert these with "
            "--assume-srgb. [video.exposure]"
        )
    return _Video(source, entries, sound, exposures, cycle)


def _exposures(
    source: Path, document: Mapping[str, Any], count: int
) -> tuple[dict[int, float], int]:
    """Of the frames below ``count``, by number, and the length of the cycle."""
    cycle, table = document.get("exposure_cycle"), document.get("exposure_table")
    if isinstance(table, str) and cycle is None:
        place = contained(source.parent, table)
        stated: dict[int, float] = {}
        for row in csv_rows(place):
            number, time = number_in(row, "frame"), number_in(row, "exposure_time")
            if number is None or not is_exposure(time) or number % 1 or number in stated:
                raise InputRefused(
                    f"{place}: the row {str(row)[:80]} has no frame of its own and no "
                    "exposure_time above 0. Correct it. [video.exposure]"
                )
            stated[int(number)] = time
        return stated, 0
    known = isinstance(cycle, list) and 2 <= len(cycle) <= MOST_FRAMES and table is None
    if not known or not all(map(is_exposure, cycle or ())):
        raise InputRefused(
            f'{source}: the exposures of its video are stated neither as "exposure_cycle", a list '
            'of two or more in seconds, nor in an "exposure_table". State one of them. '
            "[video.exposure]"
        )
    assert isinstance(cycle, list)
    return {n: float(cycle[n % len(cycle)]) for n in range(count)}, len(cycle)


def _refuse_missing(path: Path, video: _Video, there: Sequence[int]) -> None:
    missing = sorted(set(video.numbers) - set(there))
    if missing:
        named = first_of([*map(str, missing)], _LISTED)
        raise InputRefused(
            f"{path}: has no sound frame {named}, which {video.source.name} names. Copy the "
            "video again, or take these frames out. [video.frames]"
        )


def _codes(folder: Path, number: int) -> Byte:
    return np.round(255 * read_radiance(place_of(folder, number))).astype(np.uint8)


def _telling(video: _Video) -> list[int]:
    """Where runs of frames begin that tell the response."""
    return [video.numbers[i] for i in spread_evenly(len(video.numbers), _TELLING)]


def _response(video: _Video, there: frozenset[int], folder: Path) -> Response:
    """Of the runs of frames that can be laid onto each other."""
    stacks, exposures, why = list[Byte](), list[Double](), "none that follow each other are there"
    telling = _telling(video)
    for first in progress(telling, total=len(telling), label="response", unit="runs"):
        run = [n for n in range(first, first + _RUN) if n in there]
        run = sorted(
            {video.exposures[n]: n for n in run}.values(), key=lambda n: -video.exposures[n]
        )
        if len(run) < 2:
            continue
        codes = np.array([_codes(folder, n) for n in run])
        try:
            stacks.append(aligned(codes, [f"frame {n}" for n in run]).stack)
        except InputRefused as error:
            why = str(error)
            continue
        exposures.append(np.array([video.exposures[n] for n in run]))
    if not stacks:
        raise InputRefused(
            f"{video.source}: no frames of different exposure that follow each other can be laid "
            f"onto each other ({why.partition('. ')[0]}). Move the camera more slowly, or check "
            "the exposures. [video.response]"
        )
    return response_from_brackets(stacks, exposures)


def _contradicting(
    video: _Video, there: frozenset[int], response: Response, folder: Path
) -> dict[int, float]:
    """Stops by which frames are brighter than their stated exposure makes of what those beside
    them show, where both of these say so."""
    off: dict[int, float] = {}
    total = len(video.numbers)
    for n in progress(video.numbers, total=total, label="exposures", unit="frames"):
        beside = [m for m in (n - 1, n + 1) if m in there]
        own = _codes(folder, n)[::_STRIDE, ::_STRIDE]
        said = []
        for m in beside:
            ratio = _ratio(own, _codes(folder, m)[::_STRIDE, ::_STRIDE], response)
            if ratio is not None:
                stated = np.log(video.exposures[n] / video.exposures[m])
                said.append((ratio - stated) / np.log(2))
        if said and (all(s > 0 for s in said) or all(s < 0 for s in said)):
            least = min(said, key=abs)
            if abs(least) > _CONTRADICTING:
                off[n] = float(least)
    return off


def _ratio(one: Byte, other: Byte, response: Response) -> float | None:
    """Logarithm of the exposure of one frame over another's, of codes that as large a share of
    either lies below; None where too few of these tell. What moves a little changes no rank."""
    ranks = (np.arange(_RANKS) + 0.5) / _RANKS
    found = []
    for channel in range(3):
        pair = [np.quantile(p[..., channel], ranks) for p in (one, other)]
        clear = np.all([(c > DARK_CODE) & (c < BRIGHT_CODE) for c in pair], axis=0)
        logs = [np.interp(c, np.arange(256), response.logarithm[channel]) for c in pair]
        found.append((logs[0] - logs[1])[clear])
    every = np.concatenate(found)
    return float(np.median(every)) if len(every) >= _FEWEST else None


def _judge(video: _Video, off: Mapping[int, float]) -> None:
    """Says which frames contradict; InputRefused where more than a fifth do."""
    if not off:
        return
    named = first_of([f"{n} ({stops:+.1f} stops)" for n, stops in off.items()], _LISTED)
    what = (
        f"{len(off)} of {len(video.numbers)} frames are brighter or darker beside those before and "
        f"after them than their exposures say, {named}"
    )
    if len(off) > _MOST * len(video.numbers):
        cure = "Correct the table"
        if video.cycle:
            cure = 'Check that "exposure_cycle" begins with the exposure of frame 0'
        raise InputRefused(f"{video.source}: {what}. {cure}. [video.contradiction]")
    warn(
        f"{video.source}: {what}. Correct their exposures or leave them out. [video.contradiction]"
    )
