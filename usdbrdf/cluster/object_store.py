"""An object store, such as S3, in the place of a folder that all workers see; fsspec talks to it.

Each task has a prefix of its own there, whose name lies in its folder in the asset: a run that goes
on with the task finds what the one before it uploaded, and nobody else does. Workers see neither
the asset nor the capture: they get copies, whose SHA-256 is checked, and of the user's files those
that they open.
"""

from __future__ import annotations

import configparser
import errno
import os
import re
import secrets
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path, PosixPath
from threading import Lock
from typing import Any, TypeVar

from usdbrdf.cluster.options import is_url
from usdbrdf.cluster.store import DIGITS, Files, Folder, Wanted
from usdbrdf.errors import EnvironmentFailure, UsageError, UsdBrdfError
from usdbrdf.files.atomic import sha256_of, temporary_beside, write_text_atomic
from usdbrdf.job.progress import say

T = TypeVar("T")
# Uploads at a time, and those that wait, for which arrays stay in memory.
_AT_ONCE, _WAITING = 8, 32
# Seconds between tries of what passes: an object of which a part came, or something else, or a
# store that is busy. Whoever was let wait for so long has been tried for long enough.
_BETWEEN_TRIES, _LONGEST_TRY = (0.2, 1.0, 3.0), 30.0
# How a client of S3 waits: 15 s for each of three answers, and a few between. Left alone, its two
# libraries try again one inside the other, 25 times.
_PATIENCE: dict[str, Any] = {
    "connect_timeout": 5, "read_timeout": 15,
    "retries": {"mode": "standard", "total_max_attempts": 3},
}  # fmt: skip
_NOTE = "prefix.txt"


class Objects(Files):
    """Objects under one prefix."""

    def __init__(self, address: str, copies: Path) -> None:
        self.address, self.folder = address, copies
        self._system, self._prefix = _file_system(address)
        self._pool: ThreadPoolExecutor | None = None
        self._uploads: deque[Future[None]] = deque()
        self._broken: UsdBrdfError | None = None  # what went wrong with one of them
        # Our files: how workers are told of them, and how many of them are there.
        self._told: dict[Path, tuple[str, str]] = {}
        self._given = 0

    def put(self, name: str, size: int | None, write: Callable[[Path], object]) -> None:
        if size is None:
            self._put(name, size, write)
        else:
            self._begin(self._put, name, size, write)

    def _begin(self, upload: Callable[..., None], *given: Any) -> None:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max_workers=_AT_ONCE)
        if len(self._uploads) >= _WAITING:
            self._uploads.popleft().result()
        self._uploads.append(self._pool.submit(self._do, upload, *given))

    def _do(self, upload: Callable[..., None], *given: Any) -> None:
        """Those that wait behind one that failed do not each wait for the store again."""
        if self._broken is not None:
            raise self._broken
        try:
            upload(*given)
        except UsdBrdfError as failure:
            self._broken = failure
            raise

    def _put(self, name: str, size: int | None, write: Callable[[Path], object]) -> None:
        if size is not None and self._has(name, size):
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        with temporary_beside(self.folder / name) as staged:
            write(staged)
            self._upload(staged, name)

    def _has(self, name: str, size: int) -> bool:
        """Whether there is an object of this name and size; who may not ask is told when they
        upload."""
        try:
            return bool(self._system.info(self._at(name))["size"] == size)
        except (FileNotFoundError, PermissionError):
            return False
        except Exception as error:
            raise self._failed(error) from error

    def _upload(self, path: Path, name: str) -> None:
        _tried(lambda: self._asked(lambda: self._system.put_file(str(path), self._at(name))))

    def settle(self) -> None:
        uploads, pool = [*self._uploads], self._pool
        self._uploads.clear()
        self._pool = None
        if pool is not None:
            try:
                for upload in uploads:
                    upload.result()
            finally:
                pool.shutdown(cancel_futures=True)
                self._broken = None

    def found(self, name: str) -> Path:
        return self._copied(name, self.folder / name)

    def _copied(self, name: str, to: Path) -> Path:
        if to.is_file() and sha256_of(to) == name[:DIGITS]:
            return to
        to.parent.mkdir(parents=True, exist_ok=True)
        _tried(lambda: self._copy(name, to))
        return to

    def _copy(self, name: str, to: Path) -> None:
        with temporary_beside(to) as staged:
            self._asked(lambda: self._system.get_file(self._at(name), str(staged)))
            if sha256_of(staged) != name[:DIGITS]:
                raise _Passing(
                    f"{self.address}/{name}: is not what its name tells. Delete it in the store, "
                    "then run the same command again. [cluster.objects]"
                )
            staged.replace(to)

    def drop(self, name: str) -> None:
        """What cannot be deleted now goes with all the others."""
        (self.folder / name).unlink(missing_ok=True)
        with suppress(UsdBrdfError):
            self._asked(lambda: self._system.rm_file(self._at(name)))

    def path_told(self, path: Path) -> dict[str, Any]:
        """A file by its content and its own name, by which cameras are called."""
        if path not in self._told:
            if not path.is_file():
                return {"path": str(path)}
            self._told[path] = sha256_of(path), path.name
        return {"file": [*self._told[path]]}

    def path_found(self, told: dict[str, Any]) -> Path:
        if "path" in told:
            return Path(told["path"])
        digest, own = told["file"]
        if not re.fullmatch(r"[0-9a-f]{64}", digest) or own in ("", "..") or "/" in own:
            raise UsdBrdfError(f"{digest!r}, {own!r}: not of a file. [cluster.value]")
        place = self.folder / digest / own
        copy = Copied(place)
        copy.make, copy.lock = lambda: self._copied_of_user(digest, place), Lock()
        return copy

    def _copied_of_user(self, digest: str, to: Path) -> None:
        try:
            self._copied(f"{digest}.file", to)
        except _Missing as missing:
            raise Wanted(str(missing)) from missing

    def give_told(self) -> None:
        if self._given < len(self._told):
            for path, (digest, _) in self._told.items():
                self._begin(self._give, path, f"{digest}.file")
            self.settle()
            self._given = len(self._told)

    def _give(self, path: Path, name: str) -> None:
        if not self._has(name, path.stat().st_size):
            self._upload(path, name)

    def sentence_told(self, text: str) -> str:
        return text.replace(f"{self.folder}/", "")

    def sentence_found(self, text: str) -> str:
        for path, (digest, own) in self._told.items():
            text = text.replace(f"{digest}/{own}", str(path))
        return text

    def drop_copies(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def forget(self) -> None:
        """Delete all objects under the prefix; where that fails somebody is to know."""
        try:
            self._asked(lambda: self._system.rm(self._prefix, recursive=True))
        except _Missing:
            pass
        except UsdBrdfError as failure:
            say(f"{failure} What this task uploaded is still there.")

    def _at(self, name: str) -> str:
        return f"{self._prefix}/{name}"

    def _asked(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except Exception as error:  # of every library its own
            raise self._failed(error) from error

    def _failed(self, error: Exception) -> UsdBrdfError:
        """What a store's refusal means; those that pass were tried again by its library."""
        kind, said = type(error).__name__, " ".join(str(error).split())
        if isinstance(error, FileNotFoundError):
            return _Missing(
                f"{self.address}: no such bucket or object. Make the bucket, and give the same "
                "--shared-folder and credentials to all workers. [cluster.objects]"
            )
        if isinstance(error, PermissionError) or "Credential" in kind or "Auth" in kind:
            return EnvironmentFailure(
                f"{self.address}: access is denied here ({said}). Let this process and all "
                "workers have credentials that may read, write, list and delete there. "
                "[cluster.objects]"
            )
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return EnvironmentFailure(
                f"{self.address}: what lies there does not fit on a disk ({said}). Free space "
                "where copies of it are, in Dask's folder of the worker (--local-directory), then "
                "run the same command again; finished work is kept. [cluster.objects]"
            )
        if "Validation" in kind:  # of the name alone, before anybody is asked
            return UsageError(
                f"--shared-folder {self.address}: is no place in an object store ({said[:200]}). "
                "Correct it. [cluster.objects]"
            )
        return _Passing(
            f"{self.address}: the object store failed ({kind}: {said}). See whether this machine "
            "reaches it, then run the same command again; finished work is kept. [cluster.objects]"
        )


class _Missing(EnvironmentFailure):
    """There is no such object, or nowhere to have one."""


class _Passing(EnvironmentFailure):
    """What another try may not meet again."""


def _tried(call: Callable[[], None]) -> None:
    """Do it, again where that may help; a store that was waited for is not asked again."""
    begun, waits = time.monotonic(), iter(_BETWEEN_TRIES)
    while True:
        try:
            return call()
        except _Passing:
            wait = next(waits, None)
            if wait is None or time.monotonic() - begun > _LONGEST_TRY:
                raise
            time.sleep(wait)


def files_at(address: str | Path, copies: Path) -> Files:
    """Those of a folder or an object store; ``copies`` is where those of the latter go. Raises as
    ``refuse_unknown`` for a store that nothing here can talk to."""
    if is_url(address):
        return Objects(str(address), copies)
    return Folder(Path(address).absolute())


class Copied(PosixPath):
    """A path whose file is there once somebody hands it to the system."""

    make: Callable[[], None] | None = None
    lock: Lock

    def __fspath__(self) -> str:
        if self.make is not None:
            with self.lock:
                if self.make is not None:
                    self.make()
                    self.make = None
        return super().__fspath__()


def address_for(url: str, folder: Path) -> str:
    """Where in the store what workers need for a task is; ``folder`` is the task's own."""
    noted = folder / _NOTE
    if (prefix := _noted(folder)) is None:
        folder.mkdir(parents=True, exist_ok=True)
        prefix = f"usdbrdf-{secrets.token_hex(8)}"
        write_text_atomic(noted, prefix)
    return f"{url.rstrip('/')}/{prefix}"


def forget(url: str, folder: Path) -> None:
    """Delete what ``address_for`` a task's folder holds, if there is any; a failure is told."""
    if (prefix := _noted(folder)) is not None:
        Objects(f"{url.rstrip('/')}/{prefix}", folder).forget()
        (folder / _NOTE).unlink()


def _noted(folder: Path) -> str | None:
    """Whatever stands there is going to be deleted: nothing but a name of ours counts."""
    with suppress(OSError, UnicodeDecodeError):
        text = (folder / _NOTE).read_text("utf-8")
        return text if re.fullmatch(r"usdbrdf-[0-9a-f]{16}", text) else None
    return None


def refuse_unknown(address: str) -> None:
    """UsageError for a store that nothing knows, EnvironmentFailure where what does is not
    installed; nobody is asked for it yet."""
    try:
        from fsspec import get_filesystem_class
    # Files of settings are read first, and what is no table of tables is not looked for.
    except (
        ValueError, TypeError, LookupError, AttributeError, configparser.Error, OSError,
    ) as error:  # fmt: skip
        folder = os.environ.get("FSSPEC_CONFIG_DIR", "~/.config/fsspec")
        raise UsageError(
            f"--shared-folder {address}: a file of fsspec's settings in {folder} cannot be read "
            f"({' '.join(str(error).split())}). Correct it or move it away. [cluster.settings]"
        ) from error

    kind = address.partition("://")[0]
    try:
        get_filesystem_class(kind)
    except ImportError as error:
        raise EnvironmentFailure(
            f"--shared-folder {address}: what talks to {kind}:// is not installed ({error}). Run: "
            "pip install 'usdbrdf[cluster,s3]', or what fsspec needs for others. "
            "[environment.fsspec]"
        ) from error
    except ValueError as error:
        raise UsageError(
            f"--shared-folder {address}: {error}. Give a folder, or a URL that fsspec knows, such "
            "as s3://BUCKET/PREFIX. [cluster.objects]"
        ) from error


def _file_system(address: str) -> tuple[Any, str]:
    """What fsspec has for an address, and the address as that knows it."""
    kind = address.partition("://")[0]
    refuse_unknown(address)
    try:
        from fsspec.config import conf
        from fsspec.core import url_to_fs

        more: dict[str, Any] = {}
        if kind in ("file", "local"):  # folders are made where there are such
            more["auto_mkdir"] = True
        if kind in ("s3", "s3a"):  # a user's own settings of fsspec count before ours
            more["config_kwargs"] = (
                _PATIENCE | _own_settings(conf, "s3") | _own_settings(conf, "s3a")
            )
        system, prefix = url_to_fs(address, use_listings_cache=False, **more)
        if kind in ("s3", "s3a"):
            system.retries = 1  # the client within tries again
    except UsageError:
        raise
    except Exception as error:  # of those that ask their store at once, of every library its own
        raise EnvironmentFailure(
            f"--shared-folder {address}: the object store does not answer "
            f"({type(error).__name__}: {' '.join(str(error).split())}). See whether this machine "
            "reaches it, then run the same command again; finished work is kept. [cluster.objects]"
        ) from error
    return system, str(prefix)


def _own_settings(conf: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """What a user has set of how the client waits, in the environment or a file of fsspec's; of
    what is no JSON fsspec makes a string."""
    settings = conf.get(kind, {})
    own = settings.get("config_kwargs", {}) if isinstance(settings, dict) else settings
    if not isinstance(own, dict):
        raise UsageError(
            f"config_kwargs of {kind}:// in your settings of fsspec: {own!r} is no table of names "
            f"and values. Correct FSSPEC_{kind.upper()}_CONFIG_KWARGS, which holds one as JSON, or "
            "the file in ~/.config/fsspec. [cluster.settings]"
        )
    return own
