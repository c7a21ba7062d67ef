"""Units of work on other processes: the same bytes, whatever happens to those."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import psutil
import pytest

import usdbrdf.job.task as task_module
import usdbrdf.shading.shaded
import usdbrdf.texturing.passes
from tests.scenes import make_capture
from usdbrdf import pipeline
from usdbrdf.asset.layout import Asset
from usdbrdf.cluster import session
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.cluster.session import _Session, workers_of
from usdbrdf.errors import EnvironmentFailure, UsageError
from usdbrdf.files.atomic import sha256_of
from usdbrdf.job.task import TaskRun
from usdbrdf.options import FitOptions, IngestOptions, Sampling, ShadeOptions, TextureOptions

pytest.importorskip("distributed", reason="the extra cluster is not installed")

TEXTURE = TextureOptions(texel_size=0.15)
SHADE = ShadeOptions(sampling=Sampling(max_rays=64), denoise="none")
FIT = FitOptions(max_pixels=60)


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough units for something to happen in between."""
    monkeypatch.setattr(usdbrdf.shading.shaded, "_TILE", 128)
    monkeypatch.setattr(usdbrdf.texturing.passes, "_SMALLEST_SHARE", 128)


@pytest.fixture(scope="module")
def ingested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ingested")
    capture = make_capture(folder / "capture", frames=8)
    with pipeline.working_on(folder / "room") as asset:
        pipeline.ingest([capture.folder], asset, IngestOptions())
    return folder / "room"


@pytest.fixture(scope="module")
def textured(ingested: Path) -> Path:
    asset = copied(ingested, ingested.parent.with_name("textured"))
    pipeline.texture(asset, TEXTURE)
    return asset.folder


def contents(asset: Path) -> dict[str, str]:
    return {
        path.relative_to(asset).as_posix(): sha256_of(path)
        for path in sorted(asset.rglob("*"))
        if path.is_file() and ".usdbrdf" not in path.parts
    }


@pytest.fixture(scope="module")
def alone(textured: Path) -> dict[str, str]:
    """What one process makes."""
    asset = copied(textured, textured.parent.with_name("alone"))
    pipeline.shade(asset, SHADE)
    pipeline.fit(asset, FIT)
    return contents(asset.folder)


@pytest.fixture
def copy(textured: Path, tmp_path: Path) -> Asset:
    return copied(textured, tmp_path / "copy")


def copied(asset: Path, to: Path) -> Asset:
    """With its capture, which lies beside it."""
    return Asset.at(shutil.copytree(asset.parent, to) / asset.name)


def workers_on_this_machine() -> list[int]:
    """Their processes' numbers."""
    children = psutil.Process().children(recursive=True)
    return [child.pid for child in children if "spawn_main" in " ".join(child.cmdline())]


def strike(monkeypatch: pytest.MonkeyPatch, number: int, blow: Callable[[], object]) -> None:
    """Do that once so many units of work are stored."""
    save, count = TaskRun.save, iter(range(1, 1 << 30))

    def and_strike(*given: object, **named: object) -> None:
        save(*given, **named)  # type: ignore[arg-type]
        if next(count) == number:
            blow()

    monkeypatch.setattr(TaskRun, "save", and_strike)


def test_the_bytes_are_the_same_though_workers_die_and_hang(
    copy: Asset,
    alone: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    chosen = ClusterOptions(workers=2, unit_limit=4)
    with workers_of(chosen) as workers:
        # The first seven are no units: panes and light that is found in this process.
        strike(monkeypatch, 8, lambda: os.kill(workers_on_this_machine()[0], signal.SIGKILL))
        pipeline.shade(copy, SHADE, workers)
        assert all(
            connection.laddr.ip == "127.0.0.1"
            for connection in psutil.Process().net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        )
        pids = workers_on_this_machine()
        assert len(pids) == 2
        monkeypatch.undo()
        monkeypatch.setattr(usdbrdf.shading.shaded, "_TILE", 128)
        monkeypatch.setattr(usdbrdf.texturing.passes, "_SMALLEST_SHARE", 128)
        strike(monkeypatch, 1, lambda: os.kill(pids[0], signal.SIGSTOP))
        pipeline.fit(copy, FIT, workers)
    assert contents(copy.folder) == alone
    assert "[cluster.hangs]" in capfd.readouterr().err
    assert not workers_on_this_machine()
    assert not list(copy.folder.glob(".usdbrdf/work/*"))


def test_all_that_is_done_texel_by_texel_is_shared_out_and_gives_the_same_bytes(
    ingested: Path, alone: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asset, done = copied(ingested, tmp_path / "copy"), Counter[str]()
    save = TaskRun.save

    def counted(self: TaskRun, key: str, *given: Any, **named: Any) -> None:
        if "-from-" in key or key.startswith("steps"):
            done[key.split("-")[0]] += 1
        save(self, key, *given, **named)

    monkeypatch.setattr(TaskRun, "save", counted)
    with workers_of(ClusterOptions(workers=3)) as workers:
        pipeline.texture(asset, TEXTURE, workers)
        pipeline.shade(asset, SHADE, workers)
        pipeline.fit(asset, FIT, workers)
    assert contents(asset.folder) == alone
    # Patterns are told with S and without.
    assert done == {"frames": 3, "refined": 3, "steps": 6}


def test_workers_go_on_where_this_process_was_interrupted(
    ingested: Path, textured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asset = copied(ingested, tmp_path / "copy")
    monkeypatch.setattr(task_module, "_SAVE_AFTER", 0.0)
    monkeypatch.setattr(task_module, "_SAVE_SELDOM", 0.0)

    def interrupt() -> None:
        raise KeyboardInterrupt

    # The charts, then frame after frame.
    strike(monkeypatch, 4, interrupt)
    with pytest.raises(KeyboardInterrupt):
        pipeline.texture(asset, TEXTURE)
    begun: list[int] = []
    results = _Session.results

    def noted(self: Any, unit: Any, shared: Any, pieces: Any, *rest: Any) -> Any:
        begun.extend(start for _, start, _ in pieces.values())
        return results(self, unit, shared, pieces, *rest)

    monkeypatch.setattr(_Session, "results", noted)
    with workers_of(ClusterOptions(workers=2)) as workers:
        pipeline.texture(asset, TEXTURE, workers)
    assert begun == [3, 3]
    assert contents(asset.folder) == contents(textured)


def test_workers_of_other_code_are_refused_in_a_sentence(
    copy: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from usdbrdf.cluster import engine

    monkeypatch.setattr(engine, "arithmetic", lambda: {"usdbrdf's code": "another"})
    with (
        workers_of(ClusterOptions(workers=1)) as workers,
        pytest.raises(EnvironmentFailure, match=r"code \w+ instead of another.*cluster.stranger"),
    ):
        pipeline.shade(copy, SHADE, workers)


Cluster: TypeAlias = tuple[str, Callable[..., subprocess.Popen[bytes]]]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """Address of a scheduler, and what starts it as a process of its own, with a worker."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    port = address.rpartition(":")[2]

    def started(program: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{program}", *words, "--no-dashboard"]
        nowhere = subprocess.DEVNULL
        return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, cwd=tmp_path)

    begun: list[subprocess.Popen[bytes]] = []

    def start(*of_worker: str) -> subprocess.Popen[bytes]:
        begun.append(started("dask_scheduler", "--host", "127.0.0.1", "--port", port))
        words = "--nthreads", "1", "--no-nanny", *of_worker
        begun.append(started("dask_worker", address, *words))
        return begun[-2]

    try:
        yield address, start
    finally:
        for process in begun:
            process.kill()
            process.wait()


def test_without_its_scheduler_a_run_ends_in_a_sentence_and_goes_on_from_there(
    copy: Asset, alone: dict[str, str], cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, start = cluster
    # The first seven are no units: panes and light that is found in this process.
    strike(monkeypatch, 8, start().kill)
    with (
        workers_of(ClusterOptions(scheduler=address)) as workers,
        pytest.raises(EnvironmentFailure, match=r"scheduler is gone.*\[cluster.scheduler\]"),
    ):
        pipeline.shade(copy, SHADE, workers)
    assert len(list(copy.folder.glob(".usdbrdf/work/shade-*/*/checkpoints/tile-*"))) >= 1
    with (
        pytest.raises(EnvironmentFailure, match=r"no scheduler answers"),
        workers_of(ClusterOptions(scheduler=address)) as workers,
    ):
        pipeline.shade(copy, SHADE, workers)
    start()
    with workers_of(ClusterOptions(scheduler=address)) as workers:
        pipeline.shade(copy, SHADE, workers)
        pipeline.fit(copy, FIT, workers)
    assert contents(copy.folder) == alone


def test_a_scheduler_that_is_started_anew_meanwhile_changes_no_byte(
    copy: Asset, alone: dict[str, str], cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It knows nothing of the units that are out. The run goes on, or ends in a sentence where the
    new one comes late."""
    address, start = cluster
    first, second = start(), list[int]()

    def renew() -> None:
        first.kill()
        first.wait()
        second.append(start().pid)

    # The first seven are no units: panes and light that is found in this process.
    strike(monkeypatch, 8, renew)
    chosen = ClusterOptions(scheduler=address)
    failures: list[str] = []
    for _ in range(2):
        try:
            with workers_of(chosen) as workers:
                pipeline.shade(copy, SHADE, workers)
        except EnvironmentFailure as failure:
            failures.append(str(failure))
    assert len(failures) < 2
    assert all(re.search(r"\[cluster.scheduler\]$", failure) for failure in failures)
    assert second
    pipeline.fit(copy, FIT)
    assert contents(copy.folder) == alone


_FULL = """
import errno
from usdbrdf.cluster.store import Store

def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")

Store.keep_result = full
"""


def test_a_worker_whose_disk_is_full_is_a_sentence_and_another_goes_on_from_there(
    copy: Asset, alone: dict[str, str], cluster: Cluster, tmp_path: Path
) -> None:
    address, start = cluster
    (tmp_path / "full.py").write_text(_FULL)
    scheduler = start("--preload", str(tmp_path / "full.py"))
    chosen = ClusterOptions(scheduler=address)
    with (
        pytest.raises(EnvironmentFailure, match=r"No space left.*disk is full.*cluster.worker\]"),
        workers_of(chosen) as workers,
    ):
        pipeline.shade(copy, SHADE, workers)
    scheduler.kill()
    scheduler.wait()
    start()
    with workers_of(chosen) as workers:
        pipeline.shade(copy, SHADE, workers)
    pipeline.fit(copy, FIT)
    assert contents(copy.folder) == alone


def test_workers_that_do_not_start_are_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    tries = []

    def dies(**_: object) -> None:
        tries.append(1)
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(distributed, "LocalCluster", dies)
    with (
        pytest.raises(EnvironmentFailure, match=r"do not start.*\[cluster.workers\]"),
        session._local_cluster(2),
    ):
        pass
    assert len(tries) == 3


def test_workers_without_room_for_shared_memory_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask says no more than that a nanny failed, whatever was behind it."""
    import distributed

    def dies(**_: object) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            raise RuntimeError("Nanny failed to start.")  # noqa: B904

    monkeypatch.setattr(distributed, "LocalCluster", dies)
    with (
        pytest.raises(EnvironmentFailure, match=r"No space left.*/dev/shm.*\[cluster.workers\]"),
        session._local_cluster(2),
    ):
        pass


STARTED_IN_A_CAPTURE = """
import os
from usdbrdf.cluster.session import _local_cluster
if __name__ == "__main__":
    with _local_cluster(1) as cluster:
        print(len(cluster.workers))
    print("PYTHONSAFEPATH" in os.environ)
"""


@pytest.mark.fault("S9")
@pytest.mark.skipif(sys.version_info < (3, 11), reason="it is refused there")
def test_workers_run_no_module_that_lies_in_the_current_folder(tmp_path: Path) -> None:
    """A capture by others in which somebody works may hold one that Python looks for first."""
    program, capture = tmp_path / "program" / "start.py", tmp_path / "capture"
    program.parent.mkdir()
    capture.mkdir()
    program.write_text(STARTED_IN_A_CAPTURE)
    for name in ("pickle", "socket", "distributed", "usdbrdf"):
        (capture / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('{name}')")
    found = subprocess.run(
        [sys.executable, str(program)],
        cwd=capture,
        env={
            **{name: told for name, told in os.environ.items() if name != "PYTHONSAFEPATH"},
            "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)),
        },
        capture_output=True,
        text=True,
    )
    assert not (tmp_path / "ran").exists()
    assert found.stdout.split() == ["1", "False"]


def test_where_python_runs_modules_of_the_current_folder_they_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for innocent in ("pickled.py", "select.exr", "usdbrdf.py", "time.py"):
        (tmp_path / innocent).touch()
    (tmp_path / "json").mkdir()
    session.refuse_modules_of(tmp_path)
    (tmp_path / "json" / "__init__.py").touch()
    with pytest.raises(EnvironmentFailure, match=r"/json: .*another folder.*\[cluster.modules\]"):
        session.refuse_modules_of(tmp_path)

    def closed(self: Path) -> object:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", closed)
    session.refuse_modules_of(tmp_path)


def test_workers_leave_nothing_among_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask leaves its locks, and what a worker had that was killed last."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with workers_of(ClusterOptions(workers=1)) as workers:
        assert isinstance(workers, _Session)
        assert workers._started().elsewhere() == 1
        assert [*tmp_path.rglob("worker-*")]
        os.kill(workers_on_this_machine()[0], signal.SIGKILL)
    assert not [*tmp_path.iterdir()]


def test_workers_are_begun_anew_where_their_nannies_gave_up() -> None:
    """As they do where workers die again while they start."""
    with workers_of(ClusterOptions(workers=1)) as workers:
        assert isinstance(workers, _Session)
        engine = workers._started()
        cluster = engine._client.cluster
        (nanny,) = cluster.workers.values()
        cluster.sync(nanny.close)
        assert not engine._client.nthreads()
        assert engine.elsewhere() == 1
        assert len(workers_on_this_machine()) == 1
    assert not workers_on_this_machine()


def test_workers_that_do_not_end_in_time_are_killed_and_hide_no_other_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on a busy machine, where a run that was interrupted ended as a defect of ours."""
    from distributed import LocalCluster

    def late(self: Any, timeout: float | None = None) -> None:
        raise TimeoutError

    close, begun = LocalCluster.close, list[Any]()

    def interrupted() -> None:
        with workers_of(ClusterOptions(workers=1)) as workers:
            assert isinstance(workers, _Session)
            begun.extend([workers._started()._client.cluster, *workers_on_this_machine()])
            monkeypatch.setattr(LocalCluster, "close", late)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    monkeypatch.undo()
    cluster, pid = begun
    with suppress(psutil.NoSuchProcess):
        psutil.Process(pid).wait(10)
    close(cluster)


@pytest.mark.parametrize("place", [Path("shared"), "s3://scans/shared"])
def test_a_place_that_nobody_shares_is_refused(place: Path | str) -> None:
    """This process did all by itself, without a word."""
    with (
        pytest.raises(UsageError, match=r"--shared-folder .*nobody.*--workers.*\[usage.option\]"),
        workers_of(ClusterOptions(shared_folder=place)),
    ):
        pass


def test_workers_of_two_kinds_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="exclude each other"):
        ClusterOptions(workers=2, scheduler="tcp://127.0.0.1:8786")


@pytest.mark.parametrize(
    "said", ["tcp://head\n:8786", "head: 8786", "tcp://", "tcp://head:0", "head:99999", "tcp:///x"]
)
def test_what_is_no_address_of_a_scheduler_is_said_before_any_work(said: str) -> None:
    with pytest.raises(UsageError, match=r"no address of a scheduler.*\[usage.option\]"):
        ClusterOptions(scheduler=said)


@pytest.mark.parametrize(
    "said", ["head", "head:8786", "tls://head:8786", "tcp://[::1]:8786", "inproc://10.0.0.1/7/1"]
)
def test_what_dask_takes_for_an_address_is_one(said: str) -> None:
    assert ClusterOptions(scheduler=said).scheduler == said


def test_one_process_needs_no_dask() -> None:
    told = "import sys, usdbrdf.pipeline; print({'dask', 'distributed'} & {*sys.modules})"
    found = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
