"""Pictures of the page: JPEG without metadata, as text; parts of photographs around an object; and
the maps of an asset on its surface, seen by a camera."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from usdbrdf.asset.maps import AssetMaps, camera_hits
from usdbrdf.asset.properties import FittedObject
from usdbrdf.evaluation.report import magma
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.frames import FramePixels
from usdbrdf.files.images import encoded_jpeg
from usdbrdf.model.arrays import Bool, Byte, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.rays import Hits, RayScene

_QUALITY = 82
# Pixels across in which objects are looked for, and of the parts of photographs at most.
_SEARCHED, _MOST_PIXELS = 112, 12_000
# Around an object, of its width and height.
_MARGIN = 0.2
# Okabe and Ito's colours, which people with any sight tell apart.
STATUS_COLOURS = {
    "measured": (0, 158, 115),
    "bounded": (86, 180, 233),
    "undetermined": (230, 159, 0),
    "unseen": (150, 150, 150),
    "failed": (213, 94, 0),
    "lamp": (240, 228, 66),
}
_COVERAGE_COLOURS = ((150, 150, 150), (86, 180, 233), (213, 94, 0), (0, 158, 115))
_BACKGROUND = np.array((40, 44, 52), np.uint8)


def data_uri(picture: Byte) -> str:
    """An sRGB picture (H, W, 3) uint8 as it stands in a page."""
    return uri_of(encoded_jpeg(picture, _QUALITY), "image/jpeg")


def uri_of(content: bytes, kind: str) -> str:
    """Bytes as a page holds them."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def as_bytes(display: Float) -> Byte:
    """Display values in [0, 1] as bytes."""
    return (np.clip(display, 0, 1) * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Where objects are in frames: share (N, num_objects) of the frame's pixels; box (N,
    num_objects, 4) left, top, right, bottom as shares of width and height."""

    share: Float
    box: Float

    @property
    def in_sight(self) -> Bool:
        """(num_objects,): whether any of the frames has an object in its sight."""
        return np.asarray(self.share.any(axis=0), np.bool_)


def objects_in_frames(rays: RayScene, face_object: Int, count: int, frames: Frames) -> Seen:
    """``count`` objects looked for in each frame, coarsely."""
    share = np.zeros((len(frames), count), np.float32)
    box = np.zeros((len(frames), count, 4), np.float32)
    for i in range(len(frames)):
        camera = frames.camera(i)
        small = camera.at_width(min(_SEARCHED, camera.width))
        hits = camera_hits(rays, frames, i, small.width, small.height)
        owner = np.where(hits.face >= 0, face_object[hits.face], -1)
        owner = owner.reshape(small.height, small.width)
        for k in np.unique(owner[owner >= 0]):
            rows, columns = np.nonzero(owner == k)
            share[i, k] = len(rows) / owner.size
            box[i, k] = (
                columns.min() / small.width, rows.min() / small.height,
                (columns.max() + 1) / small.width, (rows.max() + 1) / small.height,
            )  # fmt: skip
    return Seen(share=share, box=box)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a frame: its pixels left, top, right, bottom, and a camera that sees just these,
    perhaps with fewer pixels."""

    pixels: tuple[int, int, int, int]
    camera: Camera

    def of(self, pixels: FramePixels) -> FramePixels:
        """The part of the frame's pixels, as large as the camera's picture."""
        return pixels.window(*self.pixels).at_size(self.camera.width, self.camera.height)


def part_around(camera: Camera, box: Sequence[float]) -> Part:
    """The part of a frame around an object, whose ``box`` is in shares of width and height."""
    size = np.array([camera.width, camera.height])
    low, high = np.array(box[:2]) * size, np.array(box[2:]) * size
    margin = np.maximum(_MARGIN * (high - low).max(), 2)
    left, top = np.maximum(np.floor(low - margin), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + margin), size).astype(int).tolist()
    width, height = right - left, bottom - top
    fx, fy, cx, cy = camera.intrinsics
    inner = replace(camera, intrinsics=(fx, fy, cx - left, cy - top), width=width, height=height)
    if width * height > _MOST_PIXELS:
        inner = inner.at_width(max(1, round(width * (_MOST_PIXELS / (width * height)) ** 0.5)))
    return Part(pixels=(left, top, right, bottom), camera=inner)


@dataclass(frozen=True, kw_only=True)
class SurfaceMap:
    """A quantity on the surface, and how to read its picture.

    values  (T, 3) float32 per texel: linear colours, or with ``top`` one number thrice
    top     the number that is shown in the brightest colour; None for colours
    direct  values are sRGB bytes / 255 already
    """

    name: str
    title: str
    legend: str
    values: Float
    top: float | None = None
    direct: bool = False
    exposure: float = 1.0


def surface_maps(atlas: AssetMaps, fits: Sequence[FittedObject | None]) -> Iterator[SurfaceMap]:
    """Those that the asset has."""
    owner = atlas.texels.object_index()
    lit = atlas.lit
    shown = display_exposure(lit[atlas.coverage.measured].mean(axis=1))
    yield SurfaceMap(
        name="lit", title="Lit radiance", values=lit, exposure=shown,
        legend="Diffuse radiance as photographed, one exposure for all.",
    )  # fmt: skip
    kinds = np.array(_COVERAGE_COLOURS, np.float32)[atlas.coverage.kind] / np.float32(255)
    yield SurfaceMap(
        name="coverage", title="Coverage", values=kinds, direct=True,
        legend="Green: measured. Orange: clipped in every frame. Blue: seen with what is "
        "beside it alone. Grey: no frame shows it; filled.",
    )  # fmt: skip
    for name, title, relative, unit in (
        ("samples", "Samples", False, "frames per texel"),
        ("spread", "Spread between views", True, "of the lit radiance"),
        ("stderr", "Error of the irradiance", False, "relative standard error"),
    ):
        if atlas.has(name):
            yield _numbers(atlas, name, title, lit if relative else None, unit)
    if atlas.has("irradiance"):
        irradiance = atlas.irradiance
        exposure = display_exposure(irradiance.mean(axis=1))
        yield SurfaceMap(
            name="irradiance", title="Irradiance", values=irradiance, exposure=exposure,
            legend="Light that arrives at the surface, traced; one exposure for all.",
        )  # fmt: skip
    for name, title in (("albedo", "Albedo"), ("base_color", "Base colour")):
        if atlas.has(name):
            legend = {
                "albedo": "The paper's albedo, with the specular light seen from everywhere.",
                "base_color": "Diffuse reflectance without specular light: what materials use.",
            }[name]
            values = atlas.map_where_present(name, 3)
            yield SurfaceMap(name=name, title=title, values=values, legend=legend)
    for name, title in (("phi", "Roughness phi"), ("psi", "Specular psi")):
        numbers = np.array([getattr(fit, name) if fit else np.nan for fit in fits], np.float32)
        yield SurfaceMap(
            name=name, title=title, values=_thrice(np.nan_to_num(numbers)[owner]), top=1.0,
            legend="One number per object. Black: 0. Pale yellow: 1.",
        )  # fmt: skip
    colours = np.array(
        [STATUS_COLOURS[status_of(atlas, i, fit)] for i, fit in enumerate(fits)], np.float32
    )
    yield SurfaceMap(
        name="status", title="What is known", values=colours[owner] / np.float32(255), direct=True,
        legend="Green: measured. Orange: not determined. Red: the fit failed. Grey: unseen. "
        "Yellow: lamp.",
    )  # fmt: skip


def status_of(atlas: AssetMaps, index: int, fit: FittedObject | None) -> str:
    """One word about an object: "lamp" if most of what it is shines, else the status of its fit."""
    own = atlas.emissive[atlas.texels.of_object(index)]
    if own.size and own.mean() > 0.5:
        return "lamp"
    return fit.status if fit else "unseen"


def _numbers(
    atlas: AssetMaps, name: str, title: str, divisor: Float | None, unit: str
) -> SurfaceMap:
    values = atlas.map(name).mean(axis=1)
    if divisor is not None:
        values = values / np.maximum(divisor.mean(axis=1), 1e-9)
    known = values[atlas.coverage.measured & np.isfinite(values)]
    top = float(np.percentile(known, 99)) if len(known) else 1.0
    legend = f"Black: 0. Pale yellow: {top:.3g} {unit} and more."
    return SurfaceMap(
        name=name, title=title, legend=legend, values=_thrice(values), top=max(top, 1e-9)
    )


def _thrice(numbers: Float) -> Float:
    return np.repeat(np.asarray(numbers, np.float32)[:, None], 3, axis=1)


def pictures_of_map(
    lit: LitScene, shown: SurfaceMap, seen: Sequence[Hits], sizes: Sequence[tuple[int, int]]
) -> Iterator[Byte]:
    """A map as the cameras of ``seen`` see it, in pictures of these heights and widths."""
    texture = lit.radiance.showing(lit.texels, np.nan_to_num(shown.values).astype(np.float32))
    for hits, (height, width) in zip(seen, sizes, strict=True):
        values = texture.at(hits.face, hits.u, hits.v).reshape(height, width, 3)
        there: Bool = (hits.face >= 0).reshape(height, width)
        if shown.top is not None:
            picture = magma(values[..., 0] / np.float32(shown.top), there)
        elif shown.direct:
            picture = as_bytes(values)
        else:
            picture = to_display_srgb8(values, exposure_scale=shown.exposure)
        yield np.where(there[..., None], picture, _BACKGROUND)
