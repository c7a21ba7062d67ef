"""What a user may say about who works."""

from __future__ import annotations

import re
from pathlib import Path

from usdbrdf.errors import UsageError
from usdbrdf.option import Options, is_one_line, option

# Hosts, without a scheme or with any that Dask has learnt, and a port where there is one.
_ADDRESS = re.compile(r"(?!\w*://(?:[/:]|\Z))[^\s/:]\S*", re.ASCII)
_PORT = re.compile(r":(\d+)\Z", re.ASCII)
# What the libraries of object stores read as a pattern, a version, or the end of one URL and the
# begin of another; a host may be in brackets.
_PATTERN = re.compile(r"[^/]*//[^/]*/.*([*?[]|::)", re.DOTALL)
# What may be called a bucket of S3, or an access point to one.
_OF_S3 = re.compile(r"s3a?://(?:[\w.-]{1,255}|arn:[^\s/]+)(?:/.*)?", re.DOTALL | re.ASCII)
# What a URL has between its scheme and a prefix; of files that is the prefix.
_STORE = re.compile(r"(?:(?:file|local):///|[a-z][a-z0-9+.-]*://[^/\s]).*", re.DOTALL | re.ASCII)


def is_url(place: object) -> bool:
    """Whether that is an object store, not a folder."""
    return isinstance(place, str) and "://" in place


class ClusterOptions(Options):
    """Who does the long parts of the work. No result depends on it."""

    workers: int | None = option(
        "--workers N", None, (1, 4096), unset="none, this process does all"
    )
    "do the work in N processes of this machine"
    scheduler: str | None = option("--scheduler ADDRESS", None)
    "do it on the workers of a Dask cluster, such as tls://HOST:8786, that are installed as this is"
    shared_folder: Path | str | None = option(
        "--shared-folder DIR|URL", None, unset="in the asset", url=True, one_line=True
    )
    """folder that all workers see under this name, for what they work with, or an object store,
    such as s3://BUCKET/PREFIX, by which they get photographs too"""
    unit_limit: float = option("--unit-limit S", 1800.0, (1e-3, 1e9))
    """seconds after which a worker is taken to hang at a unit of work, and is restarted while
    others do it"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers is not None and self.scheduler is not None:
            raise UsageError("--workers, --scheduler: they exclude each other. [usage.option]")
        if self.scheduler is not None and not _is_address(self.scheduler):
            raise UsageError(
                f"--scheduler {self.scheduler!r}: is no address of a scheduler. Give one such as "
                "tls://HOST:8786. [usage.option]"
            )
        if is_url(self.shared_folder) and (why := _why_no_store(str(self.shared_folder))):
            raise UsageError(f"--shared-folder {self.shared_folder}: {why}. [usage.option]")

    @property
    def asked(self) -> bool:
        """Whether others than this process are to work."""
        return self.workers is not None or self.scheduler is not None


def _is_address(text: str) -> bool:
    port = _PORT.search(text)
    named = _ADDRESS.fullmatch(text) is not None and is_one_line(text)
    return named and (port is None or 0 < int(port[1]) < 1 << 16)


def _why_no_store(url: str) -> str:
    """Why nobody could share it, and what to give; "" where somebody may."""
    kind, _, rest = url.partition("://")
    if "::" not in kind and kind != kind.lower():
        return f"a kind of store is written in small letters. Give {kind.lower()}://{rest}"
    if "::" in kind:
        return f"is a chain of stores. Give that at its end alone, {url.rpartition('::')[2]}"
    such = "Give a folder, or a store such as s3://BUCKET/PREFIX"
    if not _STORE.fullmatch(url):
        return f"names no bucket or host. {such}"
    if url.startswith(("s3:", "s3a:")) and not _OF_S3.fullmatch(url):
        return f"no bucket can be called so. {such}"
    if _PATTERN.match(url):
        return f"has *, ?, [ or :: in it, which stores read as more than that. {such}"
    if url.startswith("memory:"):
        return f"no other process sees this one's memory. {such}"
    return ""
