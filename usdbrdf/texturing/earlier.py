"""Texturing that goes on: where frames have only come to those of an earlier run, its atlas stays,
and the statistics of its frames are where the others are added.

Frames come in an order of their own then: those of the earlier run first, as they came there, and
after them the others. A running quantile depends a little on the order; what is made is what all
frames in this order, from the start, would have made on the same atlas, bit for bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from usdbrdf.files.atomic import sha256_of
from usdbrdf.identity import tasks_identity
from usdbrdf.job import cache
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene

_ATLAS, _STATISTICS = "texture-atlas", "texture-statistics"


@dataclass(frozen=True, kw_only=True)
class GoingOn:
    """What a run of texturing has from the one before.

    charts   of the atlas, see ``charts_of_scene``
    order    of the frames, by their numbers
    known    what each frame in this order is, as a hash of its file and its camera
    atlas    what the statistics belong to, as a hash
    lasting  whether there is a run before and one to come
    """

    run: TaskRun
    charts: dict[str, Array]
    order: list[int]
    known: list[str]
    atlas: str
    lasting: bool = True

    @classmethod
    def of(
        cls,
        run: TaskRun,
        scene: Scene,
        frames: Frames,
        parameters: Mapping[str, Any],
        new_charts: Callable[[], Mapping[str, Array]],
    ) -> GoingOn:
        """The atlas of the earlier run where scene, ``parameters`` and program are the same and all
        of its frames are there still; else ``new_charts``."""
        asked = map(str, sorted(parameters.items()))
        made_for = _hash_of([tasks_identity(), *asked, *_told(scene)])
        known = _hashes_of_frames(frames)
        stored = cache.kept(run.asset, _ATLAS)
        first: list[str] = []
        if stored and stored[0].get("made_for") == made_for and len(set(known)) == len(known):
            first = [str(one) for one in stored[0].get("frames", [])]
        if stored and first and set(first) <= set(known):
            charts = stored[1]
        else:
            charts, first = run.checkpoint("charts", new_charts), []
        number = {one: i for i, one in enumerate(known)}
        order = [number[one] for one in first]
        order += [i for i in range(len(frames)) if i not in set(order)]
        known = [known[i] for i in order]
        atlas = _hash_of([made_for, *(array.tobytes() for _, array in sorted(charts.items()))])
        if not first:
            cache.forget(run.asset, _STATISTICS)
        cache.keep(run.asset, _ATLAS, {"made_for": made_for, "frames": known}, charts)
        return cls(run=run, charts=charts, order=order, known=known, atlas=atlas)

    @classmethod
    def afresh(cls, run: TaskRun, frames: Frames, charts: dict[str, Array]) -> GoingOn:
        """All frames from the start on an atlas that others lay out."""
        atlas = _hash_of([array.tobytes() for _, array in sorted(charts.items())])
        order, known = [*range(len(frames))], _hashes_of_frames(frames)
        return cls(run=run, charts=charts, order=order, known=known, atlas=atlas, lasting=False)

    def name(self, what: str) -> str:
        """Of a checkpoint that is of no use with another atlas or in another order."""
        return f"{what}-{_hash_of([self.atlas, *self.known])[:12]}"

    def statistics(self, part: slice) -> tuple[int, dict[str, Array]] | None:
        """How many of the first frames are in the statistics of some texels already, and these; the
        statistics of a number of frames alone are of no use for fewer."""
        stored = cache.kept(self.run.asset, _named(part)) if self.lasting else None
        if stored is None or stored[0].get("atlas") != self.atlas:
            return None
        frames = stored[0].get("frames")
        count = len(frames) if isinstance(frames, list) else 0
        return (count, stored[1]) if count and frames == self.known[:count] else None

    def keep_statistics(self, part: slice, arrays: Mapping[str, Array]) -> None:
        """Those of all frames, for the next run."""
        if self.lasting:
            record = {"atlas": self.atlas, "frames": self.known}
            cache.keep(self.run.asset, _named(part), record, arrays)


def _named(part: slice) -> str:
    return f"{_STATISTICS}-{part.start}-{part.stop}"


def _hashes_of_frames(frames: Frames) -> list[str]:
    gain = np.ones(len(frames)) if frames.gain is None else frames.gain
    lens = np.array(frames.vignetting, np.float64)
    rows = zip(
        frames.world_from_camera, frames.intrinsics, frames.resolution,
        frames.saturation_radiance, frames.noise_floor_radiance, gain, strict=True,
    )  # fmt: skip
    return [
        _hash_of(
            [
                frames.encoding_of(i),
                sha256_of(path),
                *(np.asarray(n).tobytes() for n in (*row, lens)),
            ]
        )
        for i, (path, row) in enumerate(zip(frames.image_paths, rows, strict=True))
    ]


def _told(scene: Scene) -> list[bytes | str]:
    arrays = (scene.points, scene.triangles, scene.face_object)
    return [*(array.tobytes() for array in arrays), *(obj.prim_path for obj in scene.objects)]


def _hash_of(parts: Sequence[bytes | str]) -> str:
    whole = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        whole.update(f"{len(data)}\n".encode())
        whole.update(data)
    return whole.hexdigest()
