"""The sample as what is told of lenses and poses is found from."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.frames import read_frame
from usdbrdf.model.upright import as_captured
from usdbrdf.options import IngestOptions
from usdbrdf.texturing.pose_samples import logarithms

STUDY = Path(__file__).parents[2] / "samples" / "study"


@cache
def _scan():
    return as_captured(read_scan(STUDY, IngestOptions()))


def study_frames(step):
    """Mesh, cameras and pictures of every so many frames of it."""
    scan = _scan()
    some = range(0, len(scan.frames), step)
    pictures = [logarithms(read_frame(scan.frames, i), 1) for i in some]
    return scan.mesh, [scan.frames.camera(i) for i in some], pictures
