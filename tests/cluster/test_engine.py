"""What becomes of units: each once, also where results are equal or workers hang."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.cluster.session import workers_of
from usdbrdf.errors import EnvironmentFailure, ImageRefused
from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.model.arrays import Array

pytest.importorskip("distributed", reason="the extra cluster is not installed")


@pytest.fixture
def client() -> Iterator[Any]:
    """Of two workers without nannies, which are threads of this process."""
    from distributed import Client

    with Client(
        processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as client:
        yield client


@pytest.fixture
def as_ours(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], Any]:
    """Makes a function or class one that workers may be told of."""

    from usdbrdf.cluster import unit as module

    def named(thing: Any) -> Any:
        thing.__module__, thing.__qualname__ = module.__name__, thing.__name__
        monkeypatch.setattr(module, thing.__name__, thing, raising=False)
        monkeypatch.setattr(module, "_shared", module._Kept(1))
        return thing

    return named


def test_units_that_find_the_same_are_done_once_each(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    done = Counter[int]()

    def unit(shared: float, piece: int) -> dict[str, Array]:
        done[piece] += 1
        return {"found": np.full(300, shared)}

    pieces = {f"piece-{i}": i for i in range(40)}
    with workers_of(client=client) as workers:
        found = dict(workers.results(as_ours(unit), 2.5, pieces, tmp_path / "shared", 1))
    assert found.keys() == pieces.keys()
    assert all(np.array_equal(arrays["found"], np.full(300, 2.5)) for arrays in found.values())
    assert done == Counter(range(40))
    assert "done again" not in capfd.readouterr().err
    assert not list((tmp_path / "shared").glob("*.npz"))


def test_workers_use_freed_memory_again(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nannies tell them not to, which costs a quarter of a conversion."""
    from usdbrdf.cluster import unit as module

    kept = Event()
    monkeypatch.setattr(module, "keep_freed", kept.set)

    def unit(shared: None, piece: int) -> dict[str, Array]:
        return {"kept": np.array(kept.is_set())}

    with workers_of(client=client) as workers:
        ((_, found),) = workers.results(as_ours(unit), None, {"0": 0}, tmp_path / "shared", 1)
    assert found["kept"]


def test_a_worker_that_hangs_without_a_nanny_is_dropped(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    begun, ended = Counter[int](), Event()

    def unit(shared: None, piece: int) -> dict[str, Array]:
        begun[piece] += 1
        if piece == 1 and begun[1] == 1:
            ended.wait(20)
        return {"found": np.array([piece])}

    pieces = {f"piece-{i}": i for i in range(6)}
    options = ClusterOptions(unit_limit=1.0)
    try:
        with workers_of(options, client) as workers:
            found = dict(workers.results(as_ours(unit), None, pieces, tmp_path / "shared", 1))
    finally:
        ended.set()
    assert {key: int(arrays["found"][0]) for key, arrays in found.items()} == pieces
    assert capfd.readouterr().err.count("[cluster.hangs]") == 1
    assert len(client.nthreads()) == 1


def test_a_worker_that_gives_back_in_time_is_left_alone_though_units_wait(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def unit(shared: None, piece: int) -> dict[str, Array]:
        time.sleep(1.2)
        return {"found": np.array([piece])}

    client.retire_workers([next(iter(client.nthreads()))])
    with workers_of(ClusterOptions(unit_limit=1.8), client) as workers:
        pieces = {f"piece-{i}": i for i in range(3)}
        assert len(dict(workers.results(as_ours(unit), None, pieces, tmp_path / "s", 1))) == 3
    assert "[cluster.hangs]" not in capfd.readouterr().err


def test_a_unit_that_waits_for_the_work_of_others_is_not_late(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from distributed import Client

    def unit(shared: None, piece: int) -> dict[str, Array]:
        return {"found": np.array([piece])}

    client.retire_workers([next(iter(client.nthreads()))])
    with (
        Client(client.scheduler.address) as other,
        workers_of(ClusterOptions(unit_limit=1), client) as workers,
    ):
        theirs = other.submit(time.sleep, 4)
        while not any(other.processing().values()):
            time.sleep(0.02)
        assert len(dict(workers.results(as_ours(unit), None, {"0": 0}, tmp_path / "s", 1))) == 1
        assert theirs.result(timeout=60) is None
    assert "[cluster.hangs]" not in capfd.readouterr().err


def test_a_unit_that_hangs_is_late_though_others_wait_for_it(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from distributed import Client, get_worker

    begun, ended = list[Any](), Event()

    def unit(shared: None, piece: int) -> dict[str, Array]:
        begun.append(get_worker().address)
        if len(begun) == 1:
            begun.append(other.submit(time.sleep, 0, workers=[begun[0]]))
            ended.wait(20)
        return {"found": np.array([piece])}

    with (
        Client(client.scheduler.address) as other,
        workers_of(ClusterOptions(unit_limit=1), client) as workers,
    ):
        try:
            dict(workers.results(as_ours(unit), None, {"0": 0}, tmp_path / "shared", 1))
        finally:
            ended.set()
    assert capfd.readouterr().err.count("[cluster.hangs]") == 1
    assert begun[2] != begun[0]


def test_a_name_that_does_not_come_is_no_end_of_the_scheduler(
    client: Any,
    as_ours: Callable[[Any], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from distributed import Future, TimeoutError

    result, asked = Future.result, []

    def late_once(future: Any, timeout: float) -> Any:
        asked.append(timeout)
        if len(asked) == 1:
            raise TimeoutError
        return result(future, timeout)

    def unit(shared: None, piece: int) -> dict[str, Array]:
        return {"found": np.array([piece])}

    monkeypatch.setattr(Future, "result", late_once)
    with workers_of(client=client) as workers:
        found = dict(workers.results(as_ours(unit), None, {"0": 7}, tmp_path / "shared", 1))
    assert found["0"]["found"] == 7
    assert "did not say in 60 s" in capfd.readouterr().err


def test_without_workers_a_run_ends_though_all_is_sent(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from usdbrdf.cluster import engine

    monkeypatch.setattr(engine, "_NO_WORKERS", 0.5)
    ended = Event()

    def unit(shared: None, piece: int) -> dict[str, Array]:
        if piece:
            ended.wait(10)
        return {"found": np.array([piece])}

    try:
        with workers_of(client=client) as workers:
            pieces = {"0": 0, "1": 1}
            results = workers.results(as_ours(unit), None, pieces, tmp_path / "shared", 1)
            assert next(results)[0] == "0"
            client.sync(
                client.scheduler.restart_workers,
                workers=[*client.nthreads()],
                wait_for_workers=False,
                stimulus_id="test",
            )
            with pytest.raises(EnvironmentFailure, match=r"no worker came.*\[cluster.workers\]"):
                next(results)
    finally:
        ended.set()


def scheduler_that(answers: Callable[[], Any]) -> Any:
    """A client of one."""
    asked = SimpleNamespace(address="tcp://head:8786", ncores=None, processing=None)
    return SimpleNamespace(scheduler=asked, sync=lambda question, callback_timeout: answers())


@pytest.mark.parametrize("takes_s", [0.0, 1.0])
def test_waiting_for_workers_ends_however_long_starting_some_takes(
    takes_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    from usdbrdf.cluster import engine

    monkeypatch.setattr(engine, "_NO_WORKERS", 0.5)
    client = scheduler_that(dict)
    workers = engine.DaskWorkers(client, None, 60.0, lambda: time.sleep(takes_s))
    with pytest.raises(EnvironmentFailure, match=r"no worker came.*\[cluster.workers\]"):
        workers.elsewhere()


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (OSError, "the scheduler is gone"),
        (asyncio.CancelledError, "the scheduler is gone"),
        # As one that is stopped: the system keeps its connections.
        (TimeoutError, "has not answered for 300 s"),
        (asyncio.TimeoutError, "has not answered for 300 s"),
    ],
)
def test_a_scheduler_that_ends_or_stops_while_workers_are_waited_for_is_no_lack_of_workers(
    failure: type[BaseException], told: str
) -> None:
    from usdbrdf.cluster import engine

    answers = iter([{}, {}])

    def answer() -> dict[str, int]:
        for known in answers:
            return known
        raise failure

    workers = engine.DaskWorkers(scheduler_that(answer), None, 60.0)
    with pytest.raises(EnvironmentFailure, match=rf"{told}.*\[cluster.scheduler\]"):
        workers.elsewhere()


def test_who_listens_and_says_nothing_is_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one that is stopped; Dask waits for its first word without end."""
    from usdbrdf.cluster import session

    monkeypatch.setattr(session, "_ANSWER", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with (
            workers_of(ClusterOptions(scheduler=address)) as workers,
            pytest.raises(EnvironmentFailure, match=r"nothing came in 0.5 s.*cluster.scheduler"),
        ):
            workers.elsewhere()


def test_tls_without_certificates_is_a_sentence() -> None:
    with (
        workers_of(ClusterOptions(scheduler="tls://127.0.0.1:8786")) as workers,
        pytest.raises(EnvironmentFailure, match=r"no scheduler answers \(TLS.*\[cluster.scheduler"),
    ):
        workers.elsewhere()


def test_a_photograph_that_a_worker_alone_cannot_read_is_told_with_the_worker(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path
) -> None:
    seen = tmp_path / "1.exr"
    write_exr(seen, np.ones((4, 4, 3), np.float32))

    def unit(shared: Path, piece: int) -> dict[str, Array]:
        refused = ImageRefused(f"{shared}: cannot be read. [image.unreadable]")
        refused.path = shared
        raise refused

    with (
        workers_of(client=client) as workers,
        pytest.raises(EnvironmentFailure, match=r"inproc://\S+ cannot .*/1.exr.*image.unreadable"),
    ):
        dict(workers.results(as_ours(unit), seen, {"0": 0}, tmp_path / "shared", 1))


def test_a_damaged_photograph_is_refused_in_the_words_of_one_process(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path
) -> None:
    damaged, tries = tmp_path / "1.exr", []
    write_exr(damaged, np.random.default_rng(1).random((40, 40, 3), np.float32))
    damaged.write_bytes(damaged.read_bytes()[:2000])
    with pytest.raises(ImageRefused) as alone:
        read_radiance(damaged)

    def unit(shared: Path, piece: int) -> dict[str, Array]:
        tries.append(piece)
        return {"pixels": read_radiance(shared)}

    with workers_of(client=client) as workers, pytest.raises(ImageRefused) as found:
        dict(workers.results(as_ours(unit), damaged, {"0": 0}, tmp_path / "shared", 1))
    assert str(found.value) == str(alone.value)
    assert tries == [0]


def test_a_photograph_of_an_object_store_is_called_by_its_own_name(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path
) -> None:
    damaged, sound = tmp_path / "1.exr", tmp_path / "2.exr"
    write_exr(damaged, np.random.default_rng(1).random((40, 40, 3), np.float32))
    write_exr(sound, np.ones((4, 4, 3), np.float32))
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:2000])
    options = ClusterOptions(shared_folder=f"file://{tmp_path}/objects")
    with pytest.raises(ImageRefused) as alone:
        read_radiance(damaged)

    def unit(shared: tuple[Path, Path], piece: int) -> dict[str, Array]:
        assert not [path for path in shared if path.is_relative_to(tmp_path)]
        return {"pixels": read_radiance(shared[piece])}

    with workers_of(options, client) as workers:
        given = (unit, (damaged, sound), {"1": 1}, tmp_path / "shared", 1)
        ((_, found),) = workers.results(as_ours(given[0]), *given[1:])
        np.testing.assert_array_equal(found["pixels"], read_radiance(sound))
        with pytest.raises(ImageRefused) as refused:
            dict(workers.results(unit, (damaged, sound), {"0": 0}, tmp_path / "shared", 1))
    assert str(refused.value) == str(alone.value)


def test_a_later_task_reads_photographs_from_its_own_place_in_an_object_store(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path
) -> None:
    """Though workers know its reader of them from an earlier task, whose place is gone."""

    class Reader:
        def __init__(self, paths: tuple[Path, ...]) -> None:
            self.paths = paths

    def unit(shared: Reader, piece: int) -> dict[str, Array]:
        return {"pixels": read_radiance(shared.paths[piece])}

    as_ours(Reader)
    photographs = tmp_path / "0.exr", tmp_path / "1.exr"
    client.retire_workers([next(iter(client.nthreads()))])
    with workers_of(ClusterOptions(shared_folder=f"file://{tmp_path}/objects"), client) as workers:
        for i, photograph in enumerate(photographs):
            write_exr(photograph, np.full((4, 4, 3), i, np.float32))
        for i, task in enumerate((tmp_path / "shade", tmp_path / "fit")):
            results = workers.results(as_ours(unit), Reader(photographs), {"a": i}, task, 1)
            assert next(results)[1]["pixels"].max() == i
            workers.forget(task)


def test_a_photograph_of_which_a_worker_has_a_bad_copy_is_told_with_the_worker(
    client: Any, as_ours: Callable[[Any], Any], tmp_path: Path
) -> None:
    seen = tmp_path / "1.exr"
    write_exr(seen, np.ones((4, 4, 3), np.float32))

    def unit(shared: Path, piece: int) -> dict[str, Array]:
        read_radiance(shared)
        shared.write_bytes(b"damaged")
        return {"pixels": read_radiance(shared)}

    options = ClusterOptions(shared_folder=f"file://{tmp_path}/objects")
    with (
        workers_of(options, client) as workers,
        pytest.raises(EnvironmentFailure, match=rf"inproc://\S+ cannot .* {seen}: "),
    ):
        dict(workers.results(as_ours(unit), seen, {"0": 0}, tmp_path / "shared", 1))
