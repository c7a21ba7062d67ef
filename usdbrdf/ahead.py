"""Work on one item after the other, of which threads do the next ones meanwhile."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")
# Threads at work, and results that are ready or on their way besides the one that is used.
_THREADS, _AHEAD = 2, 3


def ahead(work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """What ``work`` makes of each item, in their order; that of the next ones, by threads, while
    one is used. What it raises is raised in its turn."""
    with ThreadPoolExecutor(max_workers=_THREADS) as threads:
        rest = iter(items)
        coming = deque(threads.submit(work, item) for item in islice(rest, _AHEAD))
        try:
            for item in rest:
                made = coming.popleft().result()
                coming.append(threads.submit(work, item))
                yield made
            while coming:
                yield coming.popleft().result()
        finally:
            for job in coming:
                job.cancel()
