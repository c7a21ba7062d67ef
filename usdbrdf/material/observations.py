"""Which texels, seen in which frames, tell most about an object's lobe: squares of flat surface,
how far pictures were smoothed, and the texels that are followed through all frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.samples import SAMPLE, Picture, first_surfaces, samples_from_frame
from usdbrdf.transport.lit_scene import LitScene, View, visible_points
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.warps import shifts_of

# Side of the squares in texels, which are about as large as pixels.
SIDE = 4.0
_FLAT = calibration.number("observations.flat_cosine")
_MOST = calibration.number("observations.squares_share")
_WIDEST = calibration.number("observations.widest_square")


def sides_of_samples(texels: Texels, usable: Bool, diagonal_m: float) -> tuple[Float, Bool]:
    """The side of what samples of each object average, (num_objects,), in texels: SIDE or 1; and
    which of the ``usable`` texels (T,) have so much surface around them. diagonal_m in metres."""
    owner = texels.object_index()
    objects = len(texels.resolution)
    small = SIDE * np.sqrt(texels.area) <= _WIDEST * diagonal_m
    flat = usable & small & on_flat_squares(texels, round(SIDE) // 2)
    share = np.bincount(owner, flat, objects) / np.maximum(np.bincount(owner, usable, objects), 1)
    in_squares = share >= _MOST
    side = np.where(in_squares, np.float32(SIDE), np.float32(1))
    return side, np.where(in_squares[owner], flat, usable)


def on_flat_squares(texels: Texels, reach: int) -> Bool:
    """(T,): whether a texel's atlas shows surface of its own plane ``reach`` texels around it."""
    owner = texels.object_index()
    width, height = texels.resolution[owner].T
    row, column = np.divmod(texels.pixel - texels.first_pixel[owner], width)
    flat: Bool = (np.minimum(row, column) >= reach) & (row + reach < height)
    flat &= column + reach < width
    for down, right in product((-reach, 0, reach), repeat=2):
        pixel = texels.pixel + np.where(flat, down * width.astype(np.int64) + right, 0)
        other = texels.nearest_texel[pixel]
        flat &= texels.pixel[other] == pixel
        flat &= np.einsum("td,td->t", texels.normal, texels.normal[other]) > _FLAT
    return flat


# The noise is looked at in windows of so many pixels that show one object alone, so many per frame.
_WINDOW, _WINDOWS = 24, 60
_FEWEST_WINDOWS = calibration.count("observations.noise.min_tiles")
_LAGS = 3
_WHITE = calibration.number("observations.noise.white")
_WIDEST_BLUR = calibration.number("observations.noise.widest_blur")


def noise_correlation(lit: LitScene, view: View) -> Double:
    """(N, 3): of N windows of a frame, the correlation of its relative deviation from L_d between
    pixels 1, 2 and 3 apart."""
    height, width = view.valid.shape
    corners = [
        (row, column)
        for row in range(0, height - _WINDOW + 1, _WINDOW)
        for column in range(0, width - _WINDOW + 1, _WINDOW)
        if view.valid[row : row + _WINDOW, column : column + _WINDOW].all()
    ]
    chosen = np.linspace(0, len(corners) - 1, min(_WINDOWS, len(corners))).round().astype(int)
    if not len(chosen):
        return np.zeros((0, _LAGS))
    within = np.moveaxis(np.indices((_WINDOW, _WINDOW)), 0, -1)
    place = np.array(corners)[chosen][:, None, None] + within
    pixels = place[..., ::-1].reshape(-1, 2) + 0.5
    seen = visible_points(lit, view.camera, pixels)
    diffuse = lit.radiance.at(seen.face, seen.u, seen.v).reshape(len(chosen), _WINDOW, _WINDOW, 3)
    owner = lit.owner(seen.face).reshape(len(chosen), -1)
    alone = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    alone &= (diffuse > 0).all(axis=(1, 2, 3))
    shown = view.radiance[place[alone, ..., 0], place[alone, ..., 1]]
    return correlations((shown / diffuse[alone]).mean(axis=-1, dtype=np.float64))


def correlations(windows: Double) -> Double:
    """(N, 3) correlation between pixels 1, 2 and 3 apart in windows (N, H, W)."""
    rest = windows - windows.mean(axis=(1, 2), keepdims=True)
    power = np.maximum((rest**2).mean(axis=(1, 2)), 1e-30)
    each = [
        (rest[:, lag:] * rest[:, :-lag]).mean(axis=(1, 2))
        + (rest[:, :, lag:] * rest[:, :, :-lag]).mean(axis=(1, 2))
        for lag in range(1, _LAGS + 1)
    ]
    found: Double = np.stack(each, axis=1) / (2 * power[:, None])
    return found


def smoothing_of(windows: Sequence[Double]) -> float:
    """Standard deviation in pixels of what smoothed the pictures, 0 if nothing did, NaN if they do
    not tell.

    White noise that a normal distribution of standard deviation s has smoothed correlates as
    exp(-d^2 / (4 s^2)) over a distance d. White noise that came on top, later, lessens all alike:
    so the ratio of two correlations tells s. windows: ``noise_correlation`` of frames.
    """
    every = np.concatenate([np.zeros((0, _LAGS)), *windows])
    if len(every) < _FEWEST_WINDOWS:
        return math.nan
    first, _, last = np.median(every, axis=0)
    if first < _WHITE:
        return 0.0
    ratio = max(float(last / first), 0.01)
    if ratio > math.exp(-(_LAGS**2 - 1) / (4 * _WIDEST_BLUR**2)):
        return math.nan
    return math.sqrt((_LAGS**2 - 1) / (-4 * math.log(ratio)))


# Followed per object, kept per object, and views kept per texel.
_FOLLOWED = 3000
_KEPT = 200
_VIEWS = 12
_MIN_VIEWS = calibration.count("observations.min_views")
# Bounds the table of followed texels times frames, 17 bytes each (12 of radiance, 4 of light, 1 of
# whether the texel was seen). Rather than fewer texels per object, fewer frames are followed.
_MAX_CELLS = 12_000_000
_FEWEST = 40
# The mirror direction is blurred by this many rays within a lobe of this alpha: how far a highlight
# reaches is not known yet.
_PROXY_RAYS = 4
_PROXY_ALPHA = calibration.number("observations.proxy_alpha")
# How far pictures were smoothed is measured on about so many frames.
_FRAMES_OF_NOISE = 20


class Observations(NamedTuple):
    """M samples of texels by frames, sorted by object and texel.

    texel (M,) int32; frame (M,) int32; radiance (M, 3) float32; noise (M,) float32, the frame's
    noise floor; side (M,) float32, of the square that the sample is the mean of, in texels
    """

    texel: Int
    frame: Int
    radiance: Float
    noise: Float
    side: Float

    def of_texels(self, own: slice) -> Observations:
        """Those of one object's texels."""
        first, last = np.searchsorted(self.texel, [own.start, own.stop])
        return self.take(slice(int(first), int(last)))

    def take(self, index: slice | npt.NDArray[np.int64]) -> Observations:
        return Observations._make(values[index] for values in self)


class Follower:
    """Follows some texels of every object through the frames, one ``add`` per frame, in any order
    and from any thread."""

    def __init__(self, lit: LitScene, usable: Bool, frames: int, seed: int) -> None:
        """usable (T,): texels worth following (measured, not emissive)."""
        self._lit, texels = lit, lit.texels
        side, usable = sides_of_samples(texels, usable, lit.diagonal_m)
        random = np.random.default_rng([seed, 0])
        own = [texels.of_object(i) for i in range(len(texels.resolution))]
        candidates = [part.start + np.flatnonzero(usable[part]) for part in own]
        limit, rows = _table_size(frames, sum(len(some) > 0 for some in candidates))
        picked = [
            np.sort(random.choice(some, min(limit, len(some)), replace=False))
            for some in candidates
        ]
        self._index = np.concatenate([np.zeros(0, np.int64), *picked])
        self._owner = texels.object_index()[self._index]
        self._side = side[self._owner]
        followed, across = texels.take(self._index), self._side[:, None]
        steps = {"step_x": across * followed.step_x, "step_y": across * followed.step_y}
        self._texels = replace(followed, **steps)
        # Offsets of the proxy's half vectors, the same for all texels so that views compare.
        self._jitter = _PROXY_ALPHA * (2 * shifts_of(np.arange(_PROXY_RAYS), 3, seed) - 1)
        # Row of a frame in the tables; what was not seen there is zero.
        self._frame = np.linspace(0, max(frames - 1, 0), rows).round().astype(np.int64)
        self._row = {int(frame): row for row, frame in enumerate(self._frame)}
        self._frames_per_noise = max(1, -(-frames // _FRAMES_OF_NOISE))
        self._noise_in_windows: dict[int, Double] = {}
        cells = (rows, len(self._index))
        self._seen = np.zeros(cells, np.bool_)
        self._radiance = np.zeros((*cells, 3), np.float32)
        self._light = np.zeros(cells, np.float32)
        self._noise = np.zeros(rows, np.float32)

    def add(self, frame: int, view: View, clipped: Bool, noise_floor: float) -> None:
        """Sample the followed texels in the frame of this number."""
        row = self._row.get(frame)
        if len(self._index) and frame % self._frames_per_noise == 0:
            self._noise_in_windows[frame] = noise_correlation(self._lit, view)
        if row is None or not len(self._index):
            return
        surfaces = first_surfaces(self._lit.rays, self._lit.scene.face_object, view.camera)
        picture = Picture(view.radiance, view.valid, clipped, np.zeros_like(clipped))
        kind, radiance = samples_from_frame(
            self._texels, self._owner, surfaces, picture, view.camera, beside_glare=True
        )
        seen = np.flatnonzero(kind == SAMPLE)
        self._seen[row, seen] = True
        self._radiance[row, seen] = radiance[seen]
        self._light[row, seen] = self._mirrored_light(seen, view.camera.eye)
        self._noise[row] = noise_floor

    def chosen(self, seed: int) -> Observations:
        """The texels and views to fit, after the last frame.

        Half of the kept texels are from the best fifth by score, half from all that have a score.
        Of a texel's views a third are those with most mirrored light, the rest spread.
        """
        scores, texels, pairs = self._scores(), self._lit.texels, []
        random = np.random.default_rng([seed, 1])
        for own in (texels.of_object(i) for i in range(len(texels.resolution))):
            low, high = np.searchsorted(self._index, [own.start, own.stop])
            score = scores[low:high]
            kept = np.flatnonzero(score >= 0)
            if len(kept) > _KEPT:
                count = max(_KEPT // 2, len(kept) // 5)
                best = kept[np.argsort(-score[kept], kind="stable")[:count]]
                first = random.choice(best, _KEPT // 2, replace=False)
                others = np.setdiff1d(kept, first)
                second = random.choice(others, _KEPT - len(first), replace=False)
                kept = np.sort(np.concatenate([first, second]))
            for column in kept + low:
                views = np.flatnonzero(self._seen[:, column])
                if len(views) > _VIEWS:
                    light = self._light[views, column]
                    brightest = views[np.argsort(-light, kind="stable")[: _VIEWS // 3]]
                    rest = np.setdiff1d(views, brightest)
                    spread = np.linspace(0, len(rest) - 1, _VIEWS - len(brightest)).round()
                    views = np.sort(np.concatenate([brightest, rest[spread.astype(int)]]))
                pairs += [(column, row) for row in views]
        column, row = np.array(pairs, np.int64).reshape(-1, 2).T
        texel, frame = self._index[column].astype(np.int32), self._frame[row].astype(np.int32)
        radiance, side = self._radiance[row, column], self._side[column]
        return Observations(texel, frame, radiance, self._noise[row], side)

    @property
    def smoothing(self) -> float:
        """Standard deviation in pixels of what smoothed the pictures, NaN if they do not tell."""
        return smoothing_of([*self._noise_in_windows.values()])

    def target_frames(self) -> tuple[Int, Double]:
        """Per object, the frame in which its followed texels mirror most light beyond what each of
        them mirrors on the mean, -1 where none does, or nothing was followed; and how much."""
        mean = self._light.sum(axis=0) / np.maximum(self._seen.sum(axis=0), 1)
        objects = len(self._lit.scene.objects)
        beyond = np.stack(
            [
                np.bincount(self._owner, np.maximum(light - mean, 0) * seen, minlength=objects)
                for seen, light in zip(self._seen, self._light, strict=True)
            ]
        )
        best = self._frame[beyond.argmax(axis=0)]
        most = beyond.max(axis=0)
        return np.where(most > 0, best, -1).astype(np.int32), most

    def _scores(self) -> Double:
        """How much the mirrored light changes between the views of each followed texel, over its
        radiance; -1 where too few frames see it."""
        if not len(self._index):
            return np.zeros(0)
        views = self._seen.sum(axis=0)
        mean = self._light.sum(axis=0) / np.maximum(views, 1)
        contrast = np.zeros(len(mean))
        for seen, light in zip(self._seen, self._light, strict=True):
            np.maximum(contrast, np.abs(light - mean), out=contrast, where=seen)
        level = self._radiance.sum(axis=(0, 2)) / np.maximum(3 * views, 1)
        return np.where(views >= _MIN_VIEWS, contrast / np.maximum(level + level.mean(), 1e-30), -1)

    def _mirrored_light(self, which: npt.NDArray[np.int64], eye: Double) -> Float:
        """Mean L_d about the mirror direction, (len(which),): what a highlight would show."""
        position, normal = self._texels.position[which], self._texels.normal[which]
        to_eye = (eye - position).astype(np.float32)
        to_eye /= np.maximum(np.linalg.norm(to_eye, axis=1, keepdims=True), 1e-12)
        origin = lift_from_surface(position, normal, self._lit.diagonal_m)
        total = np.zeros(len(which), np.float32)
        for offset in self._jitter:
            half = (normal + offset).astype(np.float32)
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            along = 2 * np.einsum("td,td->t", half, to_eye)[:, None]
            direction = np.ascontiguousarray(along * half - to_eye, np.float32)
            hits = self._lit.light_rays.closest(origin, direction)
            total += self._lit.radiance.at(hits.face, hits.u, hits.v).mean(axis=1)
        mean: Float = total / np.float32(len(self._jitter))
        return mean


def _table_size(frames: int, objects: int) -> tuple[int, int]:
    """(texels to follow per object, frames to follow them through): their product over all objects
    is at most _MAX_CELLS, whatever is asked for."""
    texels = min(_FOLLOWED, _MAX_CELLS // max(frames * objects, 1))
    if texels >= _FEWEST:
        return texels, frames
    rows = min(frames, max(_MIN_VIEWS, _MAX_CELLS // (_FEWEST * objects)))
    return min(_FEWEST, _MAX_CELLS // (rows * objects)), rows
