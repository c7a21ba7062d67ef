"""Which axis is up, where a format does not say: as people held their cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.model.arrays import Double
from usdbrdf.options import CaptureOptions

# How many times as far as along another axis cameras must point up along y.
_CLEARLY = 2.0
# The cosine of the angle from an axis within which the mean of what cameras call up is that axis;
# and what 3 n r^2 of the length r of the mean of n random directions exceeds once in a hundred.
_NEARLY_UP, _BY_CHANCE = math.cos(math.radians(30)), 11.3


def up_axis_of(records: Sequence[FrameRecord]) -> Literal["Y", "Z"]:
    """The up axis where a format does not say: z, unless people held their cameras clearly upright
    along y."""
    up = np.nan_to_num(_ups(records), posinf=0, neginf=0).sum(axis=0)
    middle, most = np.argsort(np.abs(up)).tolist()[1:]
    clearly = most == 1 and up[1] > _CLEARLY * abs(up[middle])
    return "Y" if clearly else "Z"


def plainly_up(records: Sequence[FrameRecord]) -> str:
    """The axis, as ``options.UpAxis``, that cameras in people's hands plainly call up: the mean of
    their own is near it, and by no chance as long; "" where they do not."""
    axes = _ups(records)
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    axes = axes[np.isfinite(length[:, 0]) & (length[:, 0] > 0)]
    mean = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).sum(axis=0) / max(len(axes), 1)
    most, long = int(np.abs(mean).argmax()), float(np.linalg.norm(mean))
    plain = 3 * len(axes) * long**2 > _BY_CHANCE and abs(mean[most]) > _NEARLY_UP * long
    return f"{'-' if mean[most] < 0 else ''}{'XYZ'[most]}" if plain else ""


def _ups(records: Sequence[FrameRecord]) -> Double:
    return np.array([record.world_from_camera[:3, 1] for record in records]).reshape(-1, 3)


def up_axis_assumed(
    records: Sequence[FrameRecord], options: CaptureOptions, findings: Findings, name: str
) -> Literal["Y", "Z"]:
    """``up_axis_of`` a capture whose format does not say. Where the user does not either, and the
    cameras plainly say another, the user is told which option to try."""
    taken, plain = up_axis_of(records), plainly_up(records)
    if options.up_axis is None and plain not in ("", taken):
        findings.warn(
            f"{name}: its cameras are upright along {plain}, not along {taken}, which is taken to "
            "be up, so that sun and sky are looked for on the wrong side; try "
            f"--up-axis {plain}. [capture.up-axis]"
        )
    return taken
