"""What a capture holds, what it lacks and what would be refused, before hours are spent on it.

The adapters and checks of ingest read it, with the same options; of many frames the pixels of some
are looked at. Where one of them refuses the capture, what was read by then is told beside its
sentence.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import choose_adapter, read_with, refuse_missing
from usdbrdf.capture.checks import DroppedFrame, Findings, spread_evenly
from usdbrdf.capture.native import own_faces
from usdbrdf.errors import ImageRefused, MeshMissing, UsageError, UsdBrdfError, first_of
from usdbrdf.files.frames import read_frame
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Float
from usdbrdf.model.capture import Frames, Scan, View
from usdbrdf.model.mesh import ObjectLabel, ScanMesh
from usdbrdf.model.upright import as_captured
from usdbrdf.options import CaptureOptions, InspectOptions

# Frames whose radiance is measured, and what is named in one line.
_MOST_MEASURED, _LISTED = 8, 6
# Shares of the valid pixels below and above which radiance is not told: single pixels say little.
_DARKEST, _BRIGHTEST = 0.001, 0.999


@dataclass(frozen=True, kw_only=True)
class Radiance:
    """Of some frames: how many; the radiance (mean of R, G and B) that all but 0.1 % of their valid
    pixels exceed, and that which 0.1 % do; shares of clipped pixels, of all and in the worst frame,
    and of pixels below the noise floor."""

    frames: int
    darkest: float
    brightest: float
    clipped: float
    most_clipped: float
    dark: float


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """What was found of a capture, as far as it could be read.

    adapter, description  of the one that recognised it; "" where none did
    frames, radiance      None where they could not be read
    views                 how frames come of photographs, as those of a Scan
    mesh, objects         in the capture's unit and coordinates, as are frames; meters_per_unit that
                          of a Scan
    up_axis               of the capture
    own_faces             of the mesh; second skins come after them
    dropped               frames that cannot be used
    looked_at             frames whose pixels were checked
    turned_images         of a Scan
    agreement             by how much frames that show the same points differ, as a share of what
                          any two pixels do
    granted               options that were taken as given to read on after a refusal
    refusals              what convert would refuse, in the order in which it would find it
    """

    source: Path
    adapter: str = ""
    description: str = ""
    frames: Frames | None = None
    views: tuple[View | None, ...] = ()
    radiance: Radiance | None = None
    mesh: ScanMesh | None = None
    objects: tuple[ObjectLabel, ...] = ()
    own_faces: int = 0
    meters_per_unit: float | None = None
    up_axis: str | None = None
    dropped: tuple[DroppedFrame, ...] = ()
    looked_at: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    turned_images: Mapping[Path, int] = field(default_factory=dict)
    agreement: float | None = None
    granted: tuple[str, ...] = ()
    refusals: tuple[UsdBrdfError, ...] = ()

    @property
    def could_be_read(self) -> bool:
        """Whether all of it is there, if only with what was granted."""
        return len(self.refusals) == len(self.granted)

    def missing(self) -> list[str]:
        """What the capture does not say, each with what that means."""
        lacks = []
        if self.frames is not None and len(self.frames):
            if np.isinf(self.frames.saturation_radiance).all():
                lacks.append("saturation_radiance: what clips passes for radiance")
            if (self.frames.exposure_time == 1).all():
                lacks.append("exposure times: all frames count as exposed alike")
            if not self.frames.noise_floor_radiance.any():
                lacks.append("noise_floor_radiance: noise passes for radiance")
            if not self.frames.radiometric:
                lacks.append("radiance: 8-bit frames give colours and relative brightness only")
        if any(isinstance(error, MeshMissing) for error in self.refusals):
            lacks.append("mesh")
        if any("[objects.none]" in warning for warning in self.warnings):
            lacks.append("object labels: connected parts are the objects")
        return lacks

    def summary(self) -> dict[str, Any]:
        """All of it for a program: numbers, text, lists."""
        refusals = [{"sentence": str(e), "exit_code": e.exit_code} for e in self.refusals]
        return {
            "source": str(self.source),
            "adapter": self.adapter or None,
            "frames": self.frames and _frames_summary(self.frames),
            "looked_at": self.looked_at,
            "dropped": [frame._asdict() for frame in self.dropped],
            "radiance": self.radiance and vars(self.radiance),
            "mesh": self.mesh and self._mesh_summary(self.mesh),
            "objects": [vars(label) for label in self.objects],
            "agreement": self.agreement,
            "counts": self.counts,
            "missing": self.missing(),
            "warnings": list(self.warnings),
            "granted": list(self.granted),
            "refused": refusals,
        }

    def _mesh_summary(self, mesh: ScanMesh) -> dict[str, Any]:
        size = np.ptp(mesh.points.astype(np.float64), axis=0)
        return {
            "vertices": self._own_points(mesh),
            "faces": self.own_faces,
            "size": [float(length) for length in size],
            "meters_per_unit": self.meters_per_unit,
            "up_axis": self.up_axis,
        }

    def _own_points(self, mesh: ScanMesh) -> int:
        """Without those of second skins, of which each face has three."""
        return len(mesh.points) - 3 * (len(mesh.triangles) - self.own_faces)

    def lines(self) -> list[str]:
        """The table for a person."""
        return [f"{title:<12}{text}" for title, text in self._rows()]

    def _rows(self) -> Iterator[tuple[str, str]]:
        yield "capture", str(self.source)
        yield "adapter", f"{self.adapter}: {self.description}" if self.adapter else "none"
        if self.frames is None:
            yield "frames", "not read"
        else:
            yield from _frame_rows(self.frames, len(self.dropped), self.looked_at)
        for rule, frames in _by_rule(self.dropped).items():
            yield "dropped", f"{len(frames)}: {_named(frames)}: {frames[0].reason} [{rule}]"
        if self.radiance is not None:
            yield "radiance", _radiance_row(self.radiance)
        if self.mesh is not None:
            yield "mesh", self._mesh_row(self.mesh)
            names = [label.label for label in self.objects]
            yield "objects", f"{len(names)}: {first_of(names, _LISTED)}"
        if self.agreement is not None:
            yield (
                "agreement",
                f"frames that show the same points of the mesh differ by {self.agreement:.0%} of "
                "what any two pixels do",
            )
        yield from (("missing", lack) for lack in self.missing())
        yield from (("warning", warning) for warning in self.warnings)
        yield from (("granted", f"the rest is read as with {o}") for o in self.granted)
        yield from (("refused", str(error)) for error in self.refusals)
        if not self.refusals:
            yield "refused", "nothing"

    def _mesh_row(self, mesh: ScanMesh) -> str:
        size = np.ptp(mesh.points.astype(np.float64), axis=0)
        unit = "" if self.meters_per_unit is None else f", a unit is {self.meters_per_unit:g} m"
        up = "" if self.up_axis is None else f", {self.up_axis} up"
        return (
            f"{self._own_points(mesh):,} vertices, {self.own_faces:,} faces, "
            f"{' x '.join(f'{length:.3g}' for length in size)} units{unit}{up}"
        )


def inspect(
    capture: Path, options: InspectOptions, adapter: str | None = None, *, plugins: bool = True
) -> Inspection:
    """What ``ingest`` would make of a capture, and what it would refuse. Writes nothing.

    Raises UsageError where the options contradict each other, as ingest does.
    """
    seen = Inspection(source=capture)
    refusals: list[UsdBrdfError] = []
    try:
        refuse_missing(capture)
        chosen = choose_adapter(capture, adapter, plugins=plugins)
    except UsageError:
        raise
    except UsdBrdfError as error:
        return replace(seen, refusals=(error,))
    seen = replace(seen, adapter=chosen.name, description=chosen.description)
    try:
        return _of_scan(seen, read_with(chosen, capture, options), options)
    except UsageError:
        raise
    except UsdBrdfError as error:
        refusals.append(error)
    if "[capture.ldr]" in str(refusals[0]) and not options.assume_srgb:
        # Whoever agrees to photographs is told what else there is, in the same go.
        options = replace(options, assume_srgb=True)
        seen = replace(seen, granted=("--assume-srgb",))
        try:
            found = _of_scan(seen, read_with(chosen, capture, options), options)
            return replace(found, refusals=tuple(refusals))
        except UsdBrdfError as error:
            if str(error) == str(refusals[0]):
                seen = replace(seen, granted=())
            else:
                refusals.append(error)
    seen = replace(seen, refusals=tuple(refusals))
    findings: Findings | None = refusals[-1].found
    return seen if findings is None else _of_findings(seen, findings, options)


def _of_scan(seen: Inspection, scan: Scan, options: CaptureOptions) -> Inspection:
    scan = as_captured(scan)
    return replace(
        seen,
        frames=scan.frames,
        views=scan.views,
        radiance=radiance_of_frames(scan.frames.as_recorded(), options.looked_at),
        mesh=scan.mesh,
        objects=scan.objects,
        own_faces=own_faces(scan),
        meters_per_unit=scan.meters_per_unit,
        up_axis=scan.up_axis,
        looked_at=scan.counts.get("frames_looked_at", len(scan.frames)),
        counts=scan.counts,
        warnings=scan.warnings,
        turned_images=scan.turned_images,
    )


def _of_findings(seen: Inspection, findings: Findings, options: CaptureOptions) -> Inspection:
    """What is known of a capture that was refused on the way."""
    frames, geometry = findings.frames, findings.geometry
    if geometry is not None:
        seen = replace(
            seen,
            mesh=geometry.mesh,
            objects=geometry.objects,
            own_faces=len(geometry.mesh.triangles),
            meters_per_unit=options.meters_per_unit or geometry.meters_per_unit,
            up_axis=options.up_axis or geometry.up_axis,
        )
    return replace(
        seen,
        frames=frames,
        radiance=None if frames is None else radiance_of_frames(frames, options.looked_at),
        dropped=tuple(findings.dropped),
        looked_at=len(findings.looked_at),
        counts=dict(findings.counts),
        warnings=tuple(findings.warnings),
    )


def radiance_of_frames(frames: Frames, most: int | None) -> Radiance | None:
    """Between which radiances some frames lie, ``most`` at most (None: a few); None where none of
    them can be read or no pixel is valid."""
    levels: list[Float] = []
    shares = []
    numbers = spread_evenly(len(frames), min(most or _MOST_MEASURED, _MOST_MEASURED))
    for i in progress(numbers, total=len(numbers), label="radiance", unit="frames"):
        with suppress(ImageRefused):
            pixels = read_frame(frames, i)
            shares.append((float(pixels.clipped.mean()), float(pixels.dark.mean())))
            levels.append(pixels.radiance[pixels.valid].mean(axis=1))
    valid = np.concatenate([np.zeros(0, np.float32), *levels])
    valid = valid[valid > 0]
    if not len(valid):
        return None
    darkest, brightest = np.quantile(valid, (_DARKEST, _BRIGHTEST))
    clipped, dark = np.array(shares).T
    return Radiance(
        frames=len(shares),
        darkest=float(darkest),
        brightest=float(brightest),
        clipped=float(clipped.mean()),
        most_clipped=float(clipped.max()),
        dark=float(dark.mean()),
    )


def _radiance_row(found: Radiance) -> str:
    stops = math.log2(found.brightest / found.darkest)
    return (
        f"{found.darkest:.3g} to {found.brightest:.3g} ({stops:.1f} stops) in {found.frames} "
        f"frames; clipped {found.clipped:.2%} of the pixels, {found.most_clipped:.2%} in the worst "
        f"frame; {found.dark:.2%} below the noise floor"
    )


def _cameras(frames: Frames) -> list[tuple[tuple[float, ...], int]]:
    """Width, height and intrinsics of each different camera, and how many frames it took."""
    rows = np.column_stack([frames.resolution, frames.intrinsics.round(3)]).tolist()
    return Counter(map(tuple, rows)).most_common()


def _files(frames: Frames) -> Counter[str]:
    """How many frames come of each kind of file."""
    given = frames.photographs or (None,) * len(frames)
    pairs = zip(given, frames.image_paths, strict=True)
    return Counter((photograph or image).suffix.lower() for photograph, image in pairs)


def _frames_summary(frames: Frames) -> dict[str, Any]:
    times = np.unique(frames.exposure_time)
    sizes = Counter(map(tuple, frames.resolution.tolist()))
    return {
        "count": len(frames),
        "files": dict(_files(frames)),
        "cameras": len(_cameras(frames)),
        "resolutions": [{"width": w, "height": h, "frames": n} for (w, h), n in sizes.items()],
        "exposure_times": [float(time) for time in times],
        "frames_without_saturation": int(np.isinf(frames.saturation_radiance).sum()),
        "encoding": frames.encoding,
        "radiometric": frames.radiometric,
    }


def _frame_rows(frames: Frames, dropped: int, looked_at: int) -> Iterator[tuple[str, str]]:
    kinds = ", ".join(f"{n} {suffix[1:].upper()}" for suffix, n in _files(frames).most_common())
    seen = f"; the pixels of {looked_at} looked at" if looked_at else ""
    lost = f", {dropped} dropped" if dropped else ""
    yield "frames", f"{len(frames)}{lost} ({kinds}){seen}"
    if not len(frames):
        return
    cameras = _cameras(frames)
    (width, height, fx, *_), most = cameras[0]
    angle = math.degrees(2 * math.atan2(width / 2, fx)) if fx > 0 else math.nan
    yield (
        "cameras",
        f"{len(cameras)}, that of {most} frames {width:.0f} x {height:.0f} pixels, "
        f"fx {fx:.1f}, {angle:.0f} degrees wide",
    )
    sizes = Counter(map(tuple, frames.resolution.tolist())).most_common()
    if len(sizes) > 1:
        listed = (f"{w} x {h} ({n} frames)" for (w, h), n in sizes[:_LISTED])
        yield "resolutions", f"{len(sizes)}: {', '.join(listed)}"
    yield "exposures", _exposures_row(frames)
    kind = "radiance" if frames.radiometric else "not radiometric"
    yield "encoding", f"{frames.encoding}, {kind}"


def _exposures_row(frames: Frames) -> str:
    times = np.unique(frames.exposure_time)
    if (times == 1).all():
        return "not stated"
    apart = f"{math.log2(times[-1] / times[0]):.1f} stops"
    if not frames.radiometric:
        # EXIF's count aperture and sensitivity in: they are no seconds.
        return f"{len(times)}, {apart} apart" if len(times) > 1 else "1, that of all frames"
    several = f" to {times[-1]:.4g} s ({apart})" if len(times) > 1 else " s"
    return f"{len(times)}: {times[0]:.4g}{several}"


def _by_rule(dropped: Sequence[DroppedFrame]) -> dict[str, list[DroppedFrame]]:
    rules: dict[str, list[DroppedFrame]] = {}
    for frame in dropped:
        rules.setdefault(frame.rule, []).append(frame)
    return rules


def _named(dropped: Sequence[DroppedFrame]) -> str:
    return first_of([repr(frame.name) for frame in dropped])
