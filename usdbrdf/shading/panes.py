"""Panes: things through which one sees out of the scan.

What a surface sends to a camera is fixed on the surface, but for what it mirrors. What a pane shows
is fixed in direction: as the camera moves, it moves over the pane. Of pixels that show the same
place of a thing in several frames, the logarithms, but for their mean, are therefore compared with
those of the radiance that other frames show in the directions in which their rays go on,

    log L - <log L> = s (log L_behind - <log L_behind>) + m (log L_mirrored - <log L_mirrored>).

Of a pane s is near 1, whatever its tint, and of all else near 0. A rough metal too shows much the
same in one direction, but no more than it mirrors. Where nothing differs behind a pane, nothing is
told, and nothing depends on it: there a pane shines like a surface that is as bright.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.files.frames import FramePixels, read_frame, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import Coverage, CoverageMap
from usdbrdf.transport.environment import pixels_of_directions
from usdbrdf.transport.lit_scene import TexturedScene, hits_behind, hits_in_mirror, points_of_rays
from usdbrdf.transport.surface_texture import SurfaceTexture

# So many pixels of a frame are asked at most, and of all.
_PIXELS, _ALL_PIXELS = 1 << 14, 1 << 22
# Directions in which rays leave the scan; places of a thing: parts of its diagonal.
_HEIGHT, _WIDTH, _PLACES = 128, 256, 128
# Bits of a coordinate of a place, and of a frame's number.
_BITS, _FRAMES = 12, 24
# Parts of the frames, each left out in turn.
_PARTS = 8
_COSINE = calibration.number("panes.cosine")
_DIM = calibration.number("panes.dim")
_FARTHEST = calibration.number("panes.farthest")
_FEWEST = calibration.count("panes.fewest")
_SLOPE = calibration.number("panes.slope")
_EXPLAINED = calibration.number("panes.explained")
_OVER = calibration.number("panes.over_mirrored")
_ABOVE = calibration.number("panes.above_mirrored")


class _Rays(NamedTuple):
    """R pixels whose rays leave the scan behind what they meet: its object, place and frame; the
    mean of the channels of what they show and of what would be mirrored, NaN where unknown; and the
    number of the direction."""

    object: Int
    place: Long
    frame: Long
    shown: Float
    mirrored: Float
    direction: Long

    @staticmethod
    def joined(parts: list[_Rays]) -> _Rays:
        return _Rays._make(map(np.concatenate, zip(*parts, strict=True)))

    def of(self, which: Bool) -> _Rays:
        return _Rays._make(values[which] for values in self)


class Through(NamedTuple):
    """How an object's pixels follow what lies behind it: slope, s, and its standard error; the
    shares of their squares that this alone explains, and what it would mirror alone; how far the
    median of their logarithms lies above what it would mirror."""

    slope: float
    error: float
    explained: float
    mirrored: float
    above: float

    @property
    def is_pane(self) -> bool:
        """Whether nothing but a pane does so."""
        follows = self.slope > max(_SLOPE, 3 * self.error) and self.explained > _EXPLAINED
        return follows and self.above > _ABOVE and self.explained > _OVER * self.mirrored


def find_panes(
    run: TaskRun, surface: TexturedScene, lit: Float, coverage: CoverageMap, frames: Frames,
    z_up: bool,
) -> tuple[int, ...]:  # fmt: skip
    """The numbers of the objects through which frames show the outside; lit (T, 3): L_d."""

    def compute() -> dict[str, Array]:
        told = what_shows_through(surface, lit, coverage, frames, z_up)
        return {"panes": np.array([k for k, one in told.items() if one.is_pane])}

    # What is all one object has no panes of its own.
    if len(surface.scene.objects) < 2:
        return ()
    return tuple(run.checkpoint("panes", compute)["panes"].astype(np.int64).tolist())


def beside_panes(
    surface: TexturedScene, lit: Float, coverage: CoverageMap
) -> tuple[Float, CoverageMap]:
    """L_d (T, 3) and its coverage without what frames saw on panes: that is sent by what lies
    behind them."""
    if not surface.panes:
        return lit, coverage
    panes = surface.of_panes()
    kind = np.where(panes, np.int8(Coverage.FILLED), coverage.kind)
    return np.where(panes[:, None], np.float32(0), lit), CoverageMap(kind)


def what_shows_through(
    surface: TexturedScene, lit: Float, coverage: CoverageMap, frames: Frames, z_up: bool
) -> dict[int, Through]:
    """How the outside shows through each object that tells; lit (T, 3): L_d."""
    known = np.where(coverage.measured, lit.mean(axis=1), np.nan).astype(np.float32)
    asked = _Asked(surface, surface.texture(np.repeat(known[:, None], 3, axis=1)), z_up)
    most = min(_PIXELS, _ALL_PIXELS // max(len(frames), 1))
    images = read_frames(partial(read_frame, frames), range(len(frames)))
    rays = _Rays.joined([
        _of_frame(asked, frames.camera(i), pixels, i, most)
        for i, pixels in progress(images, total=len(frames), label="shade: panes", unit="frames")
    ])  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        behind = np.log(_in_other_frames(rays))
        shown, mirrored = np.log(rays.shown), np.log(rays.mirrored)
    # What mirrors something bright shows that, and little else.
    told = np.isfinite(shown) & np.isfinite(behind) & (mirrored < shown + np.log(_DIM))
    told &= np.isfinite(mirrored)
    found = {}
    for k in np.unique(rays.object[told]).tolist():
        own = told & (rays.object == k)
        logs = np.stack([shown[own], behind[own], mirrored[own]])
        if (one := _told(rays.of(own), logs)) is not None:
            found[k] = one
    return found


def _in_other_frames(rays: _Rays) -> Float:
    """What other frames than their own show in the direction of each of R rays, on the mean of two
    or more; NaN where fewer do."""
    _, aim = np.unique(rays.direction, return_inverse=True)
    pair, of_pair = np.unique((aim << _FRAMES) + rays.frame, return_inverse=True)
    level = np.bincount(of_pair, rays.shown) / np.bincount(of_pair)
    aim = pair >> _FRAMES
    others, total = np.bincount(aim)[aim] - 1, np.bincount(aim, level)[aim]
    mean = np.where(others > 1, (total - level) / np.maximum(others, 1), np.nan)
    return np.asarray(mean[of_pair], np.float32)


class _Asked(NamedTuple):
    """What rays are sent through, with the radiance that frames measured; NaN elsewhere."""

    surface: TexturedScene
    texture: SurfaceTexture
    z_up: bool


def _of_frame(asked: _Asked, camera: Camera, pixels: FramePixels, frame: int, most: int) -> _Rays:
    """What ``most`` pixels of a frame show or fewer, of those whose neighbours show the same."""
    surface = asked.surface
    stride = max(1, round((camera.width * camera.height / most) ** 0.5))
    points = points_of_rays(surface, *camera.rays(camera.pixels(stride)))
    owner = surface.owner(points.face)
    part = np.s_[::stride, ::stride]
    picture = owner.reshape(pixels.valid[part].shape)
    alone = ndimage.minimum_filter(picture, 3) == ndimage.maximum_filter(picture, 3)
    cosine = np.einsum("rc,rc->r", points.normal, points.to_camera)
    counts = (alone & pixels.valid[part]).ravel() & (owner >= 0) & (cosine > _COSINE)
    which = np.flatnonzero(counts)
    beyond, behind = hits_behind(surface, points.take(which), owner[which])
    which = which[beyond & (behind.face < 0)]
    points, owner = points.take(which), owner[which]
    met = hits_in_mirror(surface, points)
    mirrored = asked.texture.at(met.face, met.u, met.v)[:, 0]
    return _Rays(
        object=owner,
        place=_places(points.position, _sides(surface)[owner, None]),
        frame=np.full(len(which), frame, np.int64),
        shown=pixels.radiance[part].mean(axis=2).ravel()[which].astype(np.float32),
        mirrored=np.where(met.face < 0, np.float32(np.nan), mirrored),
        direction=pixels_of_directions(-points.to_camera, _HEIGHT, _WIDTH, asked.z_up),
    )


def _sides(surface: TexturedScene) -> Double:
    """(num_objects,) metres: of the places of each."""
    scene, sides = surface.scene, np.ones(len(surface.scene.objects))
    for i, obj in enumerate(scene.objects):
        corners = scene.points[scene.triangles[obj.faces]].reshape(-1, 3)
        if len(corners):
            sides[i] = float(np.linalg.norm(np.ptp(corners, axis=0))) / _PLACES
    return np.maximum(sides, 1e-6 * surface.diagonal_m)


def _places(position: Float, side: Double | float) -> Long:
    """(R,): equal for positions (R, 3) in one cube of this side; each cube's is that of few others,
    far away."""
    cube = np.floor(position / side).astype(np.int64) & ((1 << _BITS) - 1)
    place: Long = (cube[:, 0] << (2 * _BITS)) + (cube[:, 1] << _BITS) + cube[:, 2]
    return place


def _told(rays: _Rays, logs: Float) -> Through | None:
    """What the rays of one object tell by the logarithms of what they show, what is behind and
    what would be mirrored, (3, R); None where they are too few."""
    _, place = np.unique(rays.place, return_inverse=True)
    pair = np.unique((place << _FRAMES) + rays.frame) >> _FRAMES
    several = (np.bincount(pair, minlength=1) > 1)[place]
    rays, place, logs = rays.of(several), place[several], logs[:, several]
    if len(place) < _FEWEST:
        return None
    values = [_within(one, place) for one in logs]
    parts = [np.stack([one[rays.frame % _PARTS == k] for one in values]) for k in range(_PARTS)]
    products = np.stack([part @ part.T for part in parts])
    every = products.sum(axis=0)
    without = [_slope(every - own) for own in products]
    squares = np.maximum(np.diag(every), 1e-30)
    explained, mirrored = (every[0, 1:] ** 2 / (squares[0] * squares[1:])).tolist()
    error = float(np.sqrt((_PARTS - 1) * np.var(without)))
    above = float(np.median(logs[0] - logs[2]))
    return Through(_slope(every), error, explained, mirrored, above)


def _slope(products: Double) -> float:
    """s by least squares from the products (3, 3) of what is shown, behind and mirrored."""
    (_, sb, sm), (_, bb, bm), (_, _, mm) = products.tolist()
    alone = bb * mm - bm**2
    if alone > 1e-6 * bb * mm:
        return float((sb * mm - sm * bm) / alone)
    return float(sb / bb) if bb > 0 else 0.0


def _within(values: Float, place: Long) -> Double:
    """(R,) beyond the mean of their place."""
    mean = np.bincount(place, values) / np.maximum(np.bincount(place), 1)
    return np.asarray(np.clip(values - mean[place], -_FARTHEST, _FARTHEST), np.float64)
