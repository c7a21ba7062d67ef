"""A cluster for the time of a command: one of our own on this machine, or one that is there."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usdbrdf.cluster.options import ClusterOptions, is_url
from usdbrdf.errors import EnvironmentFailure, UsageError
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.progress import say
from usdbrdf.job.units import HERE, Unit, Workers
from usdbrdf.job.versions import refuse_version
from usdbrdf.model.arrays import Array

if TYPE_CHECKING:
    from distributed import Client

    from usdbrdf.cluster.engine import DaskWorkers

# Seconds in which a scheduler answers.
_ANSWER = 20.0
# What Dask raises where it takes longer.
_LATE = (TimeoutError, asyncio.TimeoutError)
# Of what is no name of a folder, whoever asks.
_NO_FOLDERS = (
    errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL,
)  # fmt: skip
# What a folder for shared memory says, /dev/shm, that is full, locked or not there.
_NO_SHARED_MEMORY = (errno.ENOSPC, errno.EROFS, errno.ENOSYS)
# Dask looks at every thread's stack a hundred times a second, which takes time from the work.
_UNWATCHED = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
}
# In which a worker that died is to be back before it is given up: a busy machine takes long to
# start one, and who begins anew all the time never ends.
_PATIENT = {"distributed.deploy.lost-worker-timeout": "60s"}
# What tells Python since 3.11 to look for modules where it is told to alone.
_SAFE_PATH = "PYTHONSAFEPATH"
# Of a terminal's Ctrl-C, which all its processes get, this one tells and ends the others.
_DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"


@contextmanager
def workers_of(options: ClusterOptions | None = None, client: Any = None) -> Iterator[Workers]:
    """Who does units of work in here: this process, or the workers that the options name, or those
    of ``client``, a ``distributed.Client`` that stays the caller's. Workers of our own start when
    they are first needed. Raises EnvironmentFailure where Dask is not installed, and UsageError
    for what cannot be shared."""
    chosen = options or ClusterOptions()
    if client is None and not chosen.asked:
        if chosen.shared_folder is not None:
            raise UsageError(
                f"--shared-folder {chosen.shared_folder}: nobody to share it with. Ask for "
                "--workers or a --scheduler too, or leave it out. [usage.option]"
            )
        yield HERE
        return
    _need_dask()
    _check_place(chosen.shared_folder)
    with ExitStack() as stack:
        yield _Session(chosen, client, stack)


def _check_place(place: Path | str | None) -> None:
    """Raise, before any work, what makes a folder or a store none that workers can share."""
    if isinstance(place, str) and is_url(place):
        from usdbrdf.cluster.object_store import refuse_unknown

        refuse_unknown(place)
    elif place is not None:
        refuse_version(Path(place))
        try:
            Path(place).mkdir(parents=True, exist_ok=True)
            if not os.access(place, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        except OSError as error:
            kind = UsageError if error.errno in _NO_FOLDERS else EnvironmentFailure
            raise kind(
                f"--shared-folder {place}: nothing can be written there ({error.strerror}). Give a "
                "folder that all workers see, under the same name, or a store. [cluster.folder]"
            ) from error


class _Session:
    """Workers that are there once the first units are."""

    def __init__(self, options: ClusterOptions, client: Any, stack: ExitStack) -> None:
        self._options, self._client, self._stack = options, client, stack
        self._workers: DaskWorkers | None = None

    def elsewhere(self) -> int:
        # Of workers of our own what was asked for, though one may be starting anew.
        return self._options.workers or self._started().elsewhere()

    def results(
        self, unit: Unit, shared: Any, pieces: Mapping[str, Any], folder: Path, at_a_time: int
    ) -> Iterator[tuple[str, Mapping[str, Array]]]:
        return self._started().results(unit, shared, pieces, folder, at_a_time)

    def _started(self) -> DaskWorkers:
        if self._workers is None:
            from usdbrdf.cluster import engine

            options = self._options
            client = self._client or self._stack.enter_context(_client(options))
            given = client, options.shared_folder, options.unit_limit
            if self._client is None and options.workers:
                renew = partial(_renew, client.cluster, options.workers)
                self._workers = engine.DaskWorkers(*given, renew)
            else:
                self._workers = engine.DaskWorkers(*given)
        return self._workers

    def forget(self, folder: Path) -> None:
        place = self._options.shared_folder
        if is_url(place):
            from usdbrdf.cluster.object_store import forget

            forget(str(place), folder)


def _need_dask() -> None:
    if find_spec("distributed") is None:
        raise EnvironmentFailure(
            "workers need Dask, which is not installed. Run: pip install 'usdbrdf[cluster]'. "
            "[environment.dask]"
        )


@contextmanager
def _client(options: ClusterOptions) -> Iterator[Client]:
    from distributed import Client

    # What it logs of deaths and lost connections is told in our words.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if options.scheduler is None:
            client = Client(stack.enter_context(_local_cluster(options.workers or 1)))
        else:
            try:
                _hear(options.scheduler)
                client = Client(options.scheduler, timeout=_ANSWER)
            except (OSError, ValueError, TypeError, ImportError, *_LATE) as error:
                why = str(error) or f"nothing came in {_ANSWER:g} s"
                raise EnvironmentFailure(
                    f"--scheduler {options.scheduler}: no scheduler answers ({why}). Check the "
                    "address, whether it runs, and for tls:// the certificates in Dask's "
                    "configuration. [cluster.scheduler]"
                ) from error
        try:
            _say_dashboard(client)
            yield client
        finally:
            with suppress(*_LATE):
                client.close(timeout=_ANSWER)


def _hear(address: str) -> None:
    """Raise what a client would, and TimeoutError where someone listens who says nothing, such as
    a scheduler that is stopped: for its first word a client waits without end."""
    from distributed import Security
    from distributed.comm import connect

    async def hear() -> None:
        given = Security().get_connection_args("client")
        comm = await asyncio.wait_for(connect(address, timeout=_ANSWER, **given), _ANSWER)
        comm.abort()

    with ThreadPoolExecutor(1) as aside:  # a notebook's thread has a loop already
        aside.submit(lambda: asyncio.run(hear())).result()


@contextmanager
def _local_cluster(count: int) -> Iterator[Any]:
    """So many worker processes, whose threads are this machine's cores shared out. Nobody else can
    reach them: they listen on this machine alone, and to who holds this session's certificate."""
    threads = str(max(1, (os.cpu_count() or 1) // count))
    from dask import config

    given = {"NUMBA_NUM_THREADS": threads}
    with ExitStack() as stack:
        stack.enter_context(_no_modules_of_the_current_folder())
        stack.enter_context(config.set(_PATIENT))
        if not config.get("temporary-directory", None):
            # Dask would leave its locks behind, and what workers had that were killed last.
            scratch = str(stack.enter_context(scratch_folder()))
            stack.enter_context(config.set({"temporary-directory": scratch}))
        cluster = _started(count, given)
        try:
            say(f"cluster: {count} workers on this machine, each with {threads} of its cores")
            yield cluster
        finally:
            _end(cluster)


@contextmanager
def _no_modules_of_the_current_folder() -> Iterator[None]:
    """Interpreters that are started in here run nothing that lies in the current folder, which may
    be a stranger's capture: Dask starts its own with "-c", which looks for modules there first."""
    if sys.version_info < (3, 11):
        refuse_modules_of(Path.cwd())
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_SAFE_PATH, None)
        else:
            os.environ[_SAFE_PATH] = before


def refuse_modules_of(folder: Path) -> None:
    """EnvironmentFailure where Python would take a file or folder for a module of its own. Those
    that are built into it, such as time, nothing stands in for."""
    own = sys.stdlib_module_names.difference(sys.builtin_module_names)
    try:
        entries = [entry for entry in folder.iterdir() if entry.name.partition(".")[0] in own]
    except PermissionError:  # of a folder that cannot be listed Python imports nothing either
        return
    found = sorted(
        entry.name
        for entry in entries
        if entry.suffix in (".py", ".pyc", ".so") or any(entry.glob("__init__.*"))
    )
    if found:
        raise EnvironmentFailure(
            f"{folder / found[0]}: Python would run this in the place of its own module when "
            "workers start here. Run the same command in another folder, or with Python 3.11 or "
            "later. [cluster.modules]"
        )


def _end(cluster: Any) -> None:
    """However long a busy machine takes, which is no failure of what was done or is told: workers
    that do not end by then are killed."""
    nannies = [*cluster.workers.values()]
    with suppress(*_LATE):
        cluster.close(timeout=_ANSWER)
        return
    for pid in filter(None, [nanny.pid for nanny in nannies]):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _started(count: int, environment: Mapping[str, str]) -> Any:
    """A LocalCluster. A worker that dies while it starts is no reason to give up."""
    from dask import config
    from distributed import LocalCluster, Security

    for last in (False, False, True):
        try:
            with config.set(_UNWATCHED):
                return LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    security=Security.temporary(),
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    # Pages of mapped files would count, which the system may take back.
                    memory_limit=0,
                    env=environment,
                    preload=[_DEAF],
                )
        except (OSError, RuntimeError, TimeoutError) as error:
            if last:
                raise _no_start(count, error) from error
    raise AssertionError  # not reached


def _no_start(count: int, error: BaseException) -> EnvironmentFailure:
    """With what is behind what Dask says, which is not much."""
    said, behind = [str(error)], error
    while (cause := behind.__cause__ or behind.__context__) and cause is not behind:
        behind = cause
    if behind is not error:
        said.append(str(behind) or type(behind).__name__)
    cure = "Run the same command again, with fewer if memory is short."
    if isinstance(behind, OSError) and behind.errno in _NO_SHARED_MEMORY:
        cure = "Make room in /dev/shm, which they share, or leave --workers out."
    return EnvironmentFailure(
        f"--workers {count}: they do not start on this machine ({' '.join(said)}). {cure} "
        "[cluster.workers]"
    )


def _renew(cluster: Any, count: int) -> None:
    """Start workers in the place of those whose nanny is gone: it ends where they die while they
    start, and Dask ends it where they take too long to come back."""
    from distributed.core import Status

    async def renew() -> None:
        for name, nanny in [*cluster.workers.items()]:
            if nanny.status in (Status.closed, Status.failed):
                del cluster.workers[name]
        cluster.scale(count)

    cluster.sync(renew)


def _say_dashboard(client: Client) -> None:
    if "dashboard" in client.scheduler_info()["services"]:
        say(f"cluster: its dashboard is {client.dashboard_link}")
