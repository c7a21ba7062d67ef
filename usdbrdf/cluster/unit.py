"""What a worker does: one unit of work, from its description to a file with what it found."""

from __future__ import annotations

import os
import platform
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import RLock
from typing import Any

from distributed import get_worker
from threadpoolctl import threadpool_limits

from usdbrdf.cluster.described import Document, restored
from usdbrdf.cluster.object_store import files_at
from usdbrdf.cluster.store import Store
from usdbrdf.errors import EnvironmentFailure, ImageRefused
from usdbrdf.job.arithmetic import arithmetic
from usdbrdf.job.memory import give_back_freed, keep_freed

# What a worker keeps for its next units: of tasks that are done nothing is needed any more, and of
# their scenes, which cost most, seldom more than one.
_KEPT_SHARED, _KEPT_SCENES = 2, 2


class Stranger(EnvironmentFailure):
    """A worker whose results would be others than ours."""


class Unread(EnvironmentFailure):
    """A worker cannot read a photograph, whose ``path`` is that of its file."""

    path: Path | None = None


class _Kept:
    """The latest few of what is costly to make, each made once, whichever thread asks; what is
    not kept any more is ``dropped``."""

    def __init__(self, most: int, dropped: Callable[[Any], object] = lambda _: None) -> None:
        self._most, self._dropped, self._lock = most, dropped, RLock()
        self._found: OrderedDict[str, Any] = OrderedDict()

    def get(self, key: str, make: Callable[[], Any]) -> Any:
        with self._lock:
            if key not in self._found:
                self._found[key] = make()
            self._found.move_to_end(key)
            while len(self._found) > self._most:
                self._dropped(self._found.popitem(last=False)[1])
            return self._found[key]


_shared, _scenes = _Kept(_KEPT_SHARED), _Kept(_KEPT_SCENES)
_stores = _Kept(_KEPT_SHARED, lambda store: store.files.drop_copies())


def _refuse_to_differ(wanted: Mapping[str, str]) -> None:
    """Raise Stranger where this process would give other bytes than the one that asks."""
    own = arithmetic()
    differ = [f"{k} {own.get(k)} instead of {v}" for k, v in wanted.items() if own.get(k) != v]
    if differ:
        raise Stranger(
            f"the worker {os.getpid()} on {platform.node()} has {', '.join(differ)}: its results "
            "would not be the same. Give it the same installation and kind of processor, or leave "
            "it out of the cluster. [cluster.stranger]"
        )


def done(address: str, work: str, piece: Document) -> str:
    """Do a unit: the name of what it found in the store at ``address``, where ``work`` is the name
    of what all units of its kind share."""
    keep_freed()
    store: Store = _stores.get(address, lambda: Store(files_at(address, _copies(address))))

    def value(document: Document) -> Any:
        # One that is known from another store would open its files there, where they may be gone.
        return restored(document, store, lambda told, make: _scenes.get(f"{address}/{told}", make))

    def read() -> Any:
        told = store.document(work)
        _refuse_to_differ(told["arithmetic"])
        give_back_freed()  # by the units of another kind, which are done
        return value(told["unit"]), value(told["shared"])

    unit, shared = _shared.get(f"{address}/{work}", read)
    # As where units are done in one process: BLAS's threads only wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        try:
            return store.keep_result(dict(unit(shared, value(piece))))
        except ImageRefused as error:
            unread = Unread(
                f"the worker {get_worker().address} cannot read a photograph of the capture. Let "
                "all workers see the capture's folder under the same name, or give an object store "
                f"as --shared-folder. {store.files.sentence_told(str(error))}"
            )
            if error.path is not None:
                unread.path = Path(store.files.sentence_told(str(error.path)))
            raise unread from error


def _copies(address: str) -> Path:
    """Where this worker has copies of what is in an object store: Dask deletes its folder with it,
    or when another one starts beside it."""
    return Path(get_worker().local_directory) / Path(address).name
