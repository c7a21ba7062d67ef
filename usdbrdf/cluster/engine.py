"""Dask does units of work: which go where, and what becomes of those whose worker dies or hangs.

Neither arrays nor code go through the scheduler: it hands out names. A unit may be done several
times and gives the same bytes each time, so nothing depends on which of them is heard of.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from distributed import Client, Future, KilledWorker

from usdbrdf.cluster.described import described
from usdbrdf.cluster.object_store import address_for, files_at
from usdbrdf.cluster.options import is_url
from usdbrdf.cluster.store import Files, Store, Wanted
from usdbrdf.cluster.unit import Stranger, Unread, done
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.images import read_radiance
from usdbrdf.job.arithmetic import arithmetic
from usdbrdf.job.progress import say
from usdbrdf.job.units import Unit
from usdbrdf.model.arrays import Array

T = TypeVar("T")
# Seconds: between looks at what has not come back; for which workers are waited for; in which a
# name comes from a worker; in which one says what it does; and in which one that hangs is to be
# gone.
_LOOK, _NO_WORKERS, _NAME, _SAYING, _STOPPING = 1.0, 120.0, 60.0, 5.0, 30.0
# Where there are no workers, seconds between looks for them, and between tries to have some.
_COMING, _ANEW = 0.2, 5.0
# Seconds in which a scheduler answers: one that is stopped stays connected, and says nothing.
_SILENCE = 300.0
# How often a unit may fail with its worker, or for what a machine lacks, until that is believed.
_TRIES = 5
# What calls of a client raise where time runs out, and where the scheduler is gone.
_LATE = (TimeoutError, asyncio.TimeoutError)
_GONE = (OSError, asyncio.CancelledError, concurrent.futures.CancelledError)


@dataclass
class _Sent:
    """A unit that is out, how often it failed, and whether the files that it reads were given."""

    key: str
    failed: int = 0
    given: bool = False


class DaskWorkers:
    """Does units of work on the workers of a Dask cluster."""

    def __init__(
        self,
        client: Client,
        shared_folder: Path | str | None,
        unit_limit_s: float,
        renew: Callable[[], object] = lambda: None,
    ) -> None:
        """shared_folder: which all workers see under this name, or the URL of an object store;
        None: the task's own, in the asset. unit_limit_s: seconds after which a worker is taken to
        hang at a unit. renew: starts workers in the place of those that are gone for good."""
        self._client, self._shared, self._limit = client, shared_folder, unit_limit_s
        self._renew, self._hung = renew, 0
        self._stores: dict[str, Store] = {}
        self._address = str(client.scheduler.address)
        # What of ours each worker had to do at the last look, and since when none came back.
        self._at_work: dict[str, tuple[frozenset[Any], float]] = {}

    def elsewhere(self) -> int:
        """See ``job.units.Workers``; waits for workers if there are none."""
        return self._at_once()

    def results(
        self, unit: Unit, shared: Any, pieces: Mapping[str, Any], folder: Path, at_a_time: int
    ) -> Iterator[tuple[str, Mapping[str, Array]]]:
        """See ``job.units.Workers``. Raises EnvironmentFailure where scheduler or workers are gone
        or workers are not like this process, and whatever the unit raises."""
        store = self._store(folder)
        work = store.keep_document(
            {
                "arithmetic": arithmetic(),
                "unit": described(unit, store),
                "shared": described(shared, store),
            }
        )
        told = {key: described(piece, store) for key, piece in pieces.items()}
        store.files.settle()
        waiting = [_Sent(key) for key in reversed(told)]
        out: dict[Future, _Sent] = {}
        back: SimpleQueue[Future] = SimpleQueue()
        try:
            while waiting or out:
                # One more than can be worked on is out, so that no worker waits for its next.
                while waiting and len(out) <= self._at_once():
                    sent = waiting.pop()
                    future = self._submitted(store.files.address, work, told[sent.key])
                    out[future] = sent
                    future.add_done_callback(back.put)
                try:
                    future = back.get(timeout=_LOOK)
                except Empty:
                    self._look_after(out)
                    continue
                sent = out.pop(future)
                try:
                    found = store.result(name := self._name(future, store.files))
                except Stranger:
                    raise
                except EnvironmentFailure as failure:
                    if isinstance(failure, Wanted) and not sent.given:
                        store.files.give_told()
                        sent.given = True
                        waiting.append(sent)
                        continue
                    sent.failed += 1
                    if sent.failed == _TRIES:
                        raise
                    say(f"{sent.key}: {failure} It is done again.")
                    waiting.append(sent)
                    continue
                yield sent.key, found
                store.files.drop(name)
        finally:
            if out and self._client.status == "running":
                with suppress(*_GONE):
                    self._client.cancel([*out])

    def _store(self, folder: Path) -> Store:
        """That of the task to which a folder belongs."""
        place = self._shared or folder
        address = address_for(str(place), folder) if is_url(place) else str(place)
        if address not in self._stores:
            self._stores = {address: Store(files_at(address, folder))}
        return self._stores[address]

    def _submitted(self, *given: Any) -> Future:
        return self._asked(lambda: self._client.submit(done, *given, pure=False))

    def _at_once(self) -> int:
        """How many units can be worked on; waits for workers if there are none."""
        end, anew = time.monotonic() + _NO_WORKERS, 0.0
        while not (threads := self._told(self._client.scheduler.ncores)):
            if time.monotonic() >= anew:
                self._renew()
                anew = time.monotonic() + _ANEW
            if time.monotonic() >= end:
                raise EnvironmentFailure(
                    f"{self._address}: no worker came in {_NO_WORKERS:.0f} s. Start some for this "
                    "scheduler, then run the same command again; finished work is kept. "
                    "[cluster.workers]"
                )
            time.sleep(_COMING)
        return sum(threads.values())

    def _name(self, future: Future, files: Files) -> str:
        """What a worker called the result of its unit; its failures in our words."""
        if future.status != "error":
            return self._asked(lambda: self._named(future))
        error = future.exception()
        if isinstance(error, KilledWorker):
            worker = getattr(error.last_worker, "address", "unknown")
            hung = f", and allow more with --unit-limit: {self._hung} were restarted by that"
            raise EnvironmentFailure(
                f"{self._address}: workers died at a unit of work, the last was {worker}. See "
                f"whether their memory suffices{hung if self._hung else ''}. [cluster.died]"
            ) from error
        if isinstance(error, ImportError | AttributeError):
            raise Stranger(
                f"{self._address}: a worker cannot load its work ({error}). Install this version "
                "of usdbrdf, with the extra cluster, for all workers. [cluster.stranger]"
            ) from error
        if isinstance(error, Unread) and error.path is not None:
            # The photograph itself, or what the worker sees of it? The former is refused here too.
            read_radiance(Path(files.sentence_found(str(error.path))))
            raise Unread(files.sentence_found(str(error))) from error
        if isinstance(error, OSError | MemoryError):
            raise EnvironmentFailure(
                f"{self._address}: a worker failed ({error}). See whether its disk is full, and "
                "whether it sees the folder of the asset or --shared-folder. [cluster.worker]"
            ) from error
        raise error

    def _named(self, future: Future) -> str:
        """A worker that has died since takes its answer with it, and Dask waits for another."""
        try:
            return str(future.result(timeout=_NAME))
        except _LATE as error:
            raise EnvironmentFailure(
                f"{self._address}: a worker did not say in {_NAME:.0f} s what it found. See "
                "whether it has died, or its network is overloaded. [cluster.worker]"
            ) from error

    def _look_after(self, out: dict[Future, _Sent]) -> None:
        """Restart workers that give nothing back for too long: what they had goes to others."""
        if self._client.status != "running":
            raise self._gone()
        self._at_once()
        self._renew()
        found = self._told(self._client.scheduler.processing)
        ours = {future.key: sent for future, sent in out.items()}
        now, before = time.monotonic(), self._at_work
        self._at_work = {}
        for worker, keys in found.items():
            held = frozenset(key for key in keys if key in ours)
            if len(held) < len(keys):
                held = self._begun(held)
            earlier, since = before.get(worker, (held, now))
            if held:
                self._at_work[worker] = (held, since if earlier <= held else now)
        for worker, (held, since) in [*self._at_work.items()]:
            if now - since > self._limit:
                self._give_up(worker, [ours[key] for key in held])

    def _begun(self, held: frozenset[Any]) -> frozenset[Any]:
        """What is being worked on of the units that a worker has beside the work of others, for
        which the rest may wait as long as that takes; all where it does not say."""
        if not held:
            return held
        ask = self._client.scheduler.call_stack
        try:
            told = self._client.sync(ask, keys=[*held], callback_timeout=_SAYING)
        except (*_LATE, *_GONE, KeyError):  # or it is gone, which the next look will tell
            return held
        return held & {key for stacks in told.values() for key in stacks}

    def _give_up(self, worker: str, late: list[_Sent]) -> None:
        """Restart a worker that hangs, unless others hung at its units before."""
        for sent in late:
            sent.failed += 1
            if sent.failed == _TRIES:
                raise EnvironmentFailure(
                    f"{sent.key}: {_TRIES} workers did not finish it in {self._limit:g} s each. "
                    "Allow more with --unit-limit. [cluster.hangs]"
                )
        say(
            f"{worker}: this worker is at its unit of work for over {self._limit:g} s. It is "
            "restarted, or dropped where it has no nanny, and others do its work. [cluster.hangs]"
        )
        self._hung += 1
        self._restart(worker)
        del self._at_work[worker]

    def _restart(self, worker: str) -> None:
        how = {"timeout": _STOPPING, "raise_for_error": False}
        try:
            self._asked(lambda: self._client.restart_workers([worker], **how))
        except KeyError:  # gone meanwhile
            pass
        except ValueError:  # it has no nanny: the scheduler forgets it, and tells it to end
            scheduler = self._client.scheduler
            self._asked(
                lambda: self._client.sync(
                    scheduler.restart_workers,
                    workers=[worker],
                    wait_for_workers=False,
                    on_error="return",
                    stimulus_id="usdbrdf-hangs",
                )
            )

    def _gone(self) -> EnvironmentFailure:
        return EnvironmentFailure(
            f"{self._address}: the scheduler is gone. Start it, then run the same command again; "
            "finished work is kept. [cluster.scheduler]"
        )

    def _told(self, question: Callable[..., Any]) -> Any:
        """What the scheduler answers; EnvironmentFailure where it is not there, or does not."""
        client = self._client

        def answer() -> Any:
            try:
                return client.sync(question, callback_timeout=_SILENCE)
            except _LATE as error:
                raise EnvironmentFailure(
                    f"{self._address}: the scheduler has not answered for {_SILENCE:g} s. See "
                    "whether it is stopped, or its machine overloaded, then run the same command "
                    "again; finished work is kept. [cluster.scheduler]"
                ) from error

        return self._asked(answer)

    def _asked(self, call: Callable[[], T]) -> T:
        """What a call of the client gives; EnvironmentFailure where there is no scheduler."""
        try:
            return call()
        except _GONE as error:
            raise self._gone() from error
