"""Frames become the lit diffuse texture L_d, its companions, and what is known of each texel."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Float
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.texturing.astray import doubts_about_places, frames_astray
from usdbrdf.texturing.earlier import GoingOn
from usdbrdf.texturing.exposures import Probes, contradicting_frames, probed_texels
from usdbrdf.texturing.inpaint import inpaint_alike, telling
from usdbrdf.texturing.observe import Measured, Observation, samples_from_frames
from usdbrdf.texturing.passes import among_workers, groups_of_texels, in_passes, shares_of
from usdbrdf.transport.lit_scene import TexturedScene

# A larger share of unmeasured texels is worth a warning.
_MOSTLY = 0.9


@dataclass(frozen=True, kw_only=True)
class LitTexture:
    """Of T texels; radiance in W/(m^2 sr), linear Rec.709.

    lit, mean  (T, 3) float32: the quantile that was asked for and the mean of what frames measured,
               or of an object that they hardly do, of what the pixels hold that show it; filled in
               elsewhere; where all frames clip, at least what saturates them
    spread     (T, 3) float32: see ``psquare.spread``; 0 where not measured
    samples    (T,) float32: frames that measured the texel
    coverage   what is known of each texel
    contradicting  image and gain of the frames that show the same texels brighter or darker than
                   the others do
    misplaced      a sentence on the frames that show other things than the rest do
    """

    lit: Float
    mean: Float
    spread: Float
    samples: Float
    coverage: CoverageMap
    contradicting: dict[str, float] = field(default_factory=dict)
    misplaced: tuple[str, ...] = ()

    def doubts(self) -> Iterator[str]:
        """Sentences about what a person should look at."""
        yield from self.misplaced
        unmeasured = 1 - float(self.coverage.measured.mean())
        if unmeasured > _MOSTLY:
            yield (
                f"{100 * unmeasured:.1f} % of the texels were measured by no frame and are filled "
                "in. Check the poses and the exposures. "
                "[texturing.unseen]"
            )

    def contradictions(self) -> list[str]:
        """A sentence on each contradicting frame; the user has been told of all at once."""
        return [
            f"{name}: {gain} times as bright as the other frames show it. [texturing.exposure]"
            for name, gain in self.contradicting.items()
        ]


def lit_texture_from_frames(
    run: TaskRun,
    surface: TexturedScene,
    frames: Frames,
    quantile: float,
    memory: float | None,
    going_on: GoingOn,
) -> LitTexture:
    """Project all frames, in as many passes over them as ``memory`` (GiB) asks for.

    run       keeps what is done, should it be interrupted
    going_on  in which order frames come, and what is known of the first of them

    Raises InputRefused where no frame shows any surface.
    """
    texels = surface.texels
    frames = frames.at(going_on.order)
    shown = _Shown(surface, frames.images_alone(), quantile)

    def measured(part: slice) -> dict[str, Array]:
        """Some texels in all frames, going on from the last saved state of an interrupted run, or
        of one with fewer frames."""
        name = going_on.name(f"frames-{part.start}-{part.stop}")
        start, earlier, saved = 0, going_on.statistics(part), run.latest(name)
        observed = shown.by_no_frame(part)
        if saved is not None:
            start = saved[0] + 1
            observed.restore(saved[1])
        elif earlier is not None and observed.restore_earlier(earlier[1]):
            start = earlier[0]
            say(f"texture: goes on from the statistics of {start} frames")
        if workers := run.elsewhere():
            shares = shares_of(part, workers)
            name = f"{name}-from-{start}"
            pieces = [(own, start, observed.of(own).arrays() if start else None) for own in shares]
            observed.restore(
                among_workers(run, name, shares, _seen_by_frames, shown, pieces, "texture")
            )
        else:
            frames_left = _with_frames(shown, part, start, observed)
            total = len(frames) - start
            for frame in progress(frames_left, total=total, label="texture", unit="frames"):
                run.save_latest_in_time(name, frame, observed.arrays)
        going_on.keep_statistics(part, observed.arrays())
        return observed.measured(quantile)

    groups = groups_of_texels(texels, surface.scene, frames, memory)
    found = Measured(**in_passes(run, going_on.name("texels"), groups, measured))
    owner = texels.object_index()[probed_texels(len(texels), len(frames))]
    astray = frames_astray(found.probes)
    names = [path.name for path in frames.image_paths]
    misplaced = tuple(doubts_about_places(astray, names, None))
    # How bright a frame shows what it does not look at says nothing.
    probes = np.where(astray, np.float32(np.nan), found.probes)
    contradicting = contradicting_frames(frames, probes, owner)
    lit = _filled_in(texels, found)
    return replace(lit, contradicting=contradicting, misplaced=misplaced)


class _Shown(NamedTuple):
    """What is seen by which frames."""

    surface: TexturedScene
    frames: Frames
    quantile: float

    def by_no_frame(self, part: slice) -> Observation:
        """The statistics with which texels begin."""
        probes = Probes.empty(len(self.surface.texels), len(self.frames), part)
        return Observation.empty(part, probes)


def _with_frames(shown: _Shown, part: slice, start: int, observed: Observation) -> Iterator[int]:
    """Add the frames from number ``start`` on to what was observed of the texels of ``part``, and
    give the number of each that is in it."""
    surface, frames, quantile = shown
    read, order = partial(read_frame, frames), range(start, len(frames))
    for some in samples_from_frames(surface, frames, read, order, part):
        observed.add(some, quantile)
        yield some.frame


def _seen_by_frames(
    shown: _Shown, piece: tuple[slice, int, dict[str, Array] | None]
) -> Mapping[str, Array]:
    """A unit of work: the statistics of some texels, from a frame on after earlier ones."""
    part, start, earlier = piece
    observed = shown.by_no_frame(part)
    if earlier is not None:
        observed.restore(earlier)
    for _ in _with_frames(shown, part, start, observed):
        pass
    return observed.arrays()


def _filled_in(texels: Texels, found: Measured) -> LitTexture:
    """L_d and the mean everywhere: measured, or inpainted from what was measured on the same
    object. An object that only ever clipped is known by those bounds alone, and one too thin for
    more by glimpses."""
    measured = found.count > 0
    clipped = ~measured & (found.clipped > 0)
    if not (measured | clipped).any():
        side = math.sqrt(float(np.median(texels.area)))
        raise InputRefused(
            f"no frame sees any surface well enough with texels of {side:.3g} m: too few pixels "
            "show them, or only at grazing angles. Check that the objects are larger than the "
            "--texel-size, the poses, and the size of the images. [texturing.unseen]"
        )
    owner, count = texels.object_index(), len(texels.resolution)
    has_measured = np.bincount(owner, measured, count) > 0
    enough = telling(np.bincount(owner, minlength=count))
    has_bounds = np.bincount(owner, clipped, count) >= enough
    bounded = clipped & (~has_measured & has_bounds)[owner]
    thin = (np.bincount(owner, measured, count) < enough) & ~has_bounds
    glimpsed = found.glimpsed & ~clipped & thin[owner]
    least = found.lower_bound[:, None]
    lit, mean = inpaint_alike(
        texels,
        [np.where(bounded[:, None], least, values) for values in (found.median, found.mean)],
        measured | bounded | glimpsed,
    )
    return LitTexture(
        lit=np.where(clipped[:, None], np.maximum(lit, least), lit),
        mean=mean,
        spread=np.nan_to_num(found.spread),
        samples=found.count.astype(np.float32),
        coverage=CoverageMap.of(measured, clipped, glimpsed),
    )
