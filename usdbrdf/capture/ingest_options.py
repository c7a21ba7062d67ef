"""What a user may say about a capture that its files do not say themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from usdbrdf.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class IngestOptions:
    """Options of ``ingest``, the same for every adapter."""

    mesh: Path | None = None
    """Mesh to use instead of the one that the capture names; any place is allowed."""
    objects: Path | None = None
    """Object names (objects.json) to use instead of the ones that the capture names."""
    crease_angle_deg: float = 40.0
    """Faces that lean more than this against each other meet in a sharp edge."""
    decimate: int | None = None
    """Triangles wanted in all; None keeps every triangle."""
    min_component_area_m2: float = 0.01
    """Without labels, connected parts at least this large become objects of their own."""
    assume_srgb: bool = False
    """Accept 8-bit photographs as sRGB; what comes out is not radiometric."""
    encoding: str | None = None
    """Colour space of the images, by its OpenColorIO name; None is the adapter's default."""
    pose_scale: float | None = None
    """Uniform scale of the axes in the camera matrices, divided out; positions stay."""
    max_nonfinite: float = 0.01
    """Share of NaN or infinite pixels above which a frame is dropped."""
    allow_outside: tuple[Path, ...] = ()
    """Folders outside the capture that its documents may point into."""
    meters_per_unit: float | None = None
    """Length of a scene unit; None is the adapter's default."""
    up_axis: Literal["Y", "Z"] | None = None
    """Axis that points up; None is the adapter's default."""

    def __post_init__(self) -> None:
        if not 0 <= self.crease_angle_deg <= 180:
            raise UsageError(
                f"--crease-angle {self.crease_angle_deg:g}: not between 0 and 180 degrees. "
                "[usage.option]"
            )
        if self.decimate is not None and self.decimate < 1:
            raise UsageError(
                f"--decimate {self.decimate}: not a number of triangles. [usage.option]"
            )
        if not 0 <= self.max_nonfinite <= 1:
            raise UsageError(
                f"--max-nonfinite {self.max_nonfinite:g}: a share between 0 and 1. [usage.option]"
            )
        for name, value in (
            ("--pose-scale", self.pose_scale),
            ("--meters-per-unit", self.meters_per_unit),
        ):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} {value:g}: not a positive number. [usage.option]")
