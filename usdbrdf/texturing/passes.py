"""Texels in groups whose running statistics fit into memory; each group is one pass over the
frames. What a texel gets does not depend on its group."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.memory import GIB, give_back_freed, machine_bytes, resident_bytes
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.job.units import Unit
from usdbrdf.model.arrays import Array
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels

# Without --memory this share of the machine's; and of what one pass over all texels leaves, the
# share that decoded frames may take.
_SHARE, _OF_FRAMES = 0.75, 0.5
# Bytes. Of a triangle: Embree's tree. Of a pixel: frames read ahead, and what the present one sees.
# Of the process: interpreter, libraries and compiled code.
_PER_TRIANGLE, _PER_PIXEL = 200, 200
# Of a texel, if nobody says how many there may be: several times what any task holds of it, for
# what fills the memory takes hours too.
_PER_TEXEL = 6000
_PROCESS = GIB // 2
# A pass costs reading all frames: smaller groups than this, and more of them, are not worth it.
_SMALLEST_GROUP, _MOST_PASSES = 250_000, 12
# What one worker does of a pass at least, and at most, texels.
_SMALLEST_SHARE, _LARGEST_SHARE = 4096, 1 << 22


class BytesPerTexel(NamedTuple):
    """grouped: of a texel in the present group; result: of every texel; after: in place of both,
    when all groups are done; always: of every texel, beside these. pixel: of each of a frame's."""

    grouped: int
    result: int
    after: int
    always: int = 0
    pixel: int = _PER_PIXEL


# Running statistics (145), a texel's place among the blocks of texels while these are sorted out,
# and what the next frames show of it; then what becomes of the results while the maps are made.
OF_TEXTURING = BytesPerTexel(grouped=240, result=49, after=200)


def in_passes(
    run: TaskRun,
    name: str,
    groups: Sequence[slice],
    observe: Callable[[slice], Mapping[str, Array]],
) -> dict[str, Array]:
    """Arrays of all texels, of which one pass observes each of the ``groups``; of several passes
    those that are done are kept under ``name`` for a run that goes on."""
    if len(groups) == 1:
        return dict(observe(groups[0]))
    say(f"{run.name}: {len(groups)} passes over the frames, for lack of memory")
    return by_parts(
        groups,
        lambda part: run.checkpoint(f"{name}-{part.start}-{part.stop}", partial(observe, part)),
    )


def shares_of(part: slice, workers: int) -> list[slice]:
    """Consecutive texels of the ``part`` for each of so many workers, as many for one as for
    another; more of them where that would be too much to do twice, when a worker dies."""
    count = part.stop - part.start
    most = min(max(-(-count // workers), _SMALLEST_SHARE), _LARGEST_SHARE)
    return [slice(part.start + own.start, part.start + own.stop) for own in _groups(count, most)]


def among_workers(
    run: TaskRun,
    name: str,
    shares: Sequence[slice],
    unit: Unit,
    given: Any,
    pieces: Sequence[Any],
    label: str,
) -> dict[str, Array]:
    """Arrays of consecutive texels, each of the ``shares`` of which is a unit of work, one pass
    over the frames that show it, with a piece of its own."""
    named = {
        f"{name}-{share.start}-{share.stop}": piece
        for share, piece in zip(shares, pieces, strict=True)
    }
    found = run.units(unit, given, named, label=label, noun="groups of texels")
    return joined(found)


def by_parts(
    parts: Iterable[slice], arrays_of: Callable[[slice], Mapping[str, Array]]
) -> dict[str, Array]:
    """Arrays of all rows, from the ``arrays_of`` consecutive parts of them."""
    return joined([dict(arrays_of(part)) for part in parts])


def joined(found: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Arrays of all rows, from dictionaries of consecutive ones, which are empty afterwards."""
    # One by one, so that no more than one of them is there twice.
    return {name: np.concatenate([some.pop(name) for some in found]) for name in list(found[0])}


def with_rows_beside(texels: Texels, part: slice, rows: int) -> slice:
    """The ``part`` and so many rows of its objects' atlases before and after it: what a texel's
    neighbours say of it does not depend on its group."""
    owner = texels.object_index()[[part.start, part.stop - 1]]
    reach = rows * texels.resolution[owner, 0].astype(np.int64)
    low = max(texels.pixel[part.start] - reach[0], texels.first_pixel[owner[0]])
    high = min(texels.pixel[part.stop - 1] + reach[1] + 1, texels.first_pixel[owner[1] + 1])
    start, stop = np.searchsorted(texels.pixel, [low, high])
    return slice(int(start), int(stop))


def groups_of_texels(
    texels: Texels,
    scene: Scene,
    frames: Frames,
    memory: float | None,
    need: BytesPerTexel = OF_TEXTURING,
) -> list[slice]:
    """As few groups of consecutive texels as fit, with scene and texels, into ``memory`` GiB
    (None: three quarters of the machine's).

    Raises EnvironmentFailure where not even the smallest groups do.
    """
    limit, held, after = _budget(texels, scene, frames, memory, need)
    smallest = _smallest(len(texels))
    needed = max(held + need.grouped * smallest, after)
    if needed > limit:
        raise EnvironmentFailure(
            f"{len(texels):,} texels and {len(scene.triangles):,} triangles need "
            f"{needed / GIB:.1f} GiB, the limit is {limit / GIB:.1f}. Allow more with --memory, "
            "choose a larger --texel-size, or fewer triangles with --decimate. [texturing.memory]"
        )
    return _groups(len(texels), max(smallest, int((limit - held) / need.grouped), 1))


def bytes_for_frames(
    texels: Texels, scene: Scene, frames: Frames, memory: float | None, need: BytesPerTexel
) -> int:
    """What may hold decoded frames without making one pass over all texels into several."""
    limit, held, after = _budget(texels, scene, frames, memory, need)
    return max(0, int(_OF_FRAMES * (limit - max(held + need.grouped * len(texels), after))))


def _budget(
    texels: Texels, scene: Scene, frames: Frames, memory: float | None, need: BytesPerTexel
) -> tuple[float, float, float]:
    """Bytes: the limit, what is held beside the present group, and when all groups are done."""
    limit = memory * GIB if memory else _SHARE * machine_bytes()
    tables = [*vars(scene).values(), *vars(texels).values()]
    held = _PROCESS + sum(table.nbytes for table in tables if isinstance(table, np.ndarray))
    held += _PER_TRIANGLE * len(scene.triangles) + need.always * len(texels)
    # Whoever called may hold more, and an allocator keeps some of what was freed.
    give_back_freed()
    held = max(held, resident_bytes()) + need.pixel * int(frames.resolution.prod(axis=1).max())
    after = held + need.after * len(texels)
    return limit, held + need.result * len(texels), after


def most_texels(memory: float | None) -> int:
    """How many texels a scene may have, so that the tasks hold them in ``memory`` GiB (None: three
    quarters of the machine's)."""
    limit = memory * GIB if memory else _SHARE * machine_bytes()
    return max(1, int((limit - _PROCESS) / _PER_TEXEL))


def smallest_groups(texels: Texels) -> list[slice]:
    """For whom too little memory is no reason to stop."""
    return _groups(len(texels), _smallest(len(texels)))


def _smallest(count: int) -> int:
    """The fewest texels that are worth a pass, of so many."""
    return min(count, max(_SMALLEST_GROUP, -(-count // _MOST_PASSES)))


def _groups(count: int, most: int) -> list[slice]:
    """Consecutive ranges of nearly equal length, none longer than ``most``."""
    number = -(-count // most)
    ends = [k * count // number for k in range(number + 1)]
    return [slice(low, high) for low, high in pairwise(ends)]
