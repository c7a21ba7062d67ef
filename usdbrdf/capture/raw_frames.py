"""A capture of camera raw files becomes one of radiance, before anything else reads it.

Black level, saturation, mosaic and the camera's matrix are LibRaw's. All frames get one white
balance, the median of what the camera set: by its own for each frame one surface would have many
colours. Radiance has one unit for all frames, which has no other meaning. The sensor's border is
left out as in the camera's own JPEGs, of which intrinsics mostly are; like these as they are
stored, frames have the sensor's orientation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf import calibration
from usdbrdf.capture.bracketed import (
    copy_beside,
    document_named,
    exposure_of,
    files_beside,
    frame_of,
    frames_of_document,
)
from usdbrdf.errors import InputRefused, first_of
from usdbrdf.files.atomic import environment_failures, whole_folder
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.frames import CLIPPED_SHARE
from usdbrdf.files.images import RAW_SUFFIXES, needs_float, write_exr
from usdbrdf.files.paths import contained
from usdbrdf.job.progress import progress, warn
from usdbrdf.model.arrays import Double, Float
from usdbrdf.untrusted.raw_files import RawPicture, raw_picture

# Stops by which a frame's own white balance may differ before it is told.
_DRIFT = calibration.number("raw.drift")


def develop_raw(capture: Path, folder: Path) -> dict[str, Any]:
    """Write the capture with an EXR of radiance for each raw file into the new ``folder``, and say
    what was found. Raises InputRefused for what is no capture of raw files."""
    source = document_named(capture)
    document = read_json(source, nonfinite_below=("transform_matrix",))
    entries = frames_of_document(source, document)
    if not entries:
        raise InputRefused(f"{source}: names no frames. Name the raw files as such. [raw.none]")
    beside = files_beside(source, document)
    files = [_raw_file(source, entry) for entry in entries]
    shown = progress(files, total=len(files), label="white balance", unit="frames")
    # Of each file twice, as all of them do not fit into memory.
    balances, told = zip(
        *((p.white_balance, p.exposure) for p in map(raw_picture, shown)), strict=True
    )
    balance = np.median(np.array(balances), axis=0)
    drift = np.abs(np.log2(np.array(balances) / balance)).max(axis=1)
    exposures = _exposures(files, entries, told)
    scales = np.median(exposures) / exposures
    frames, clipped = [], []
    with environment_failures(str(folder)), whole_folder(folder) as staged:
        (staged / "frames").mkdir()
        numbered = progress(list(enumerate(files)), total=len(files), label="raw", unit="frames")
        for i, file in numbered:
            name = frame_of(i, file)
            picture = _as_stated(raw_picture(file), _stated_size(document, entries[i]))
            pixels, saturation, share = developed_raw(picture, balance, scales[i])
            write_exr(staged / name, pixels, half=not needs_float(pixels))
            clipped.append(share)
            kept = {k: v for k, v in entries[i].items() if k != "noise_floor_radiance"}
            stated = {"exposure_time": float(exposures[i]), "saturation_radiance": saturation}
            frames.append({**kept, "file_path": name, **stated})
        copy_beside(beside, staged)
        write_json(
            staged / "transforms.json",
            {**document, "frames": frames, "encoding": "lin_rec709_scene"},
        )
    off = [files[i].name for i in np.flatnonzero(drift > _DRIFT)]
    if off:
        warn(
            f"{source}: the camera's white balance drifts by up to {drift.max():.2f} stops "
            f"({first_of(off)}); one balance was used for all frames. [raw.balance]"
        )
    return {
        "frames": len(files),
        "white_balance": [float(factor) for factor in balance],
        "white_balance_drift_stops": float(drift.max()),
        "stops": float(np.log2(exposures.max() / exposures.min())),
        "clipped_share": float(np.mean(clipped)),
    }


def developed_raw(picture: RawPicture, balance: Double, scale: float) -> tuple[Float, float, float]:
    """Radiance (H, W, 3) float32, linear Rec.709, of a raw picture; the radiance from which a
    channel counts as clipped; and the share of clipped pixels.

    balance  (3,) factors of the sensor's channels, for all frames of a capture
    scale    from balanced channels to radiance: one over the exposure, in some unit
    """
    factors = balance / balance.min()
    full = picture.sensor >= CLIPPED_SHARE
    pixels = picture.sensor * factors.astype(np.float32)
    pixels = pixels @ picture.rec709_from_camera.T.astype(np.float32)
    # Where white clips. Colours of more than that in one channel count as clipped too.
    pixels = np.where(full, np.maximum(pixels, 1), np.maximum(pixels, 0))
    radiance = (pixels * np.float32(scale)).astype(np.float32)
    return radiance, float(scale), float(full.any(axis=2).mean())


def _stated_size(
    document: Mapping[str, Any], entry: Mapping[str, Any]
) -> tuple[float, float] | None:
    """Width and height that a frame's intrinsics are for, where it or the document says."""
    width, height = (entry.get(key, document.get(key)) for key in "wh")
    if isinstance(width, int | float) and isinstance(height, int | float):
        return width, height
    return None


def _as_stated(picture: RawPicture, size: tuple[float, float] | None) -> RawPicture:
    """The picture without the border that its file states, if ``size`` is that of the rest, or of a
    smaller image of its shape, or not known; else all of the sensor, which some programs develop.
    """
    left, top, width, height = picture.crop
    rows, columns = picture.sensor.shape[:2]
    across, down = size or (width, height)
    if (across, down) == (columns, rows) or abs(width * down - height * across) >= across:
        return picture
    inside = picture.sensor[top : top + height, left : left + width]
    return replace(picture, sensor=inside, crop=(0, 0, width, height))


def _raw_file(source: Path, entry: dict[str, Any]) -> Path:
    name = entry.get("file_path")
    if not isinstance(name, str) or Path(name).suffix.lower() not in RAW_SUFFIXES:
        raise InputRefused(
            f"{source}: the frame {str(name)[:80]!r} is no camera raw file. Convert the capture as "
            "it is, or name the raw files. [raw.none]"
        )
    path = contained(source.parent, name)
    if not path.is_file():
        raise InputRefused(f"{path}: no such file. Copy it or remove its entry. [capture.file]")
    return path


def _exposures(
    files: Sequence[Path], entries: Sequence[dict[str, Any]], told: Sequence[float | None]
) -> Double:
    """(N,) as stated, else as the files tell."""
    given = [entry.get("exposure_time", own) for entry, own in zip(entries, told, strict=True)]
    return np.array(
        [exposure_of(f, e, "raw.exposure") for f, e in zip(files, given, strict=True)], np.float64
    )
