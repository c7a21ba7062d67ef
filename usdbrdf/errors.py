"""The errors a user can meet, each with the exit code that the command line returns for it.

Every message is one sentence or two: what was looked at, what was found, what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any


def first_of(names: Sequence[str], most: int = 3) -> str:
    """The first of some names for a sentence, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class UsdBrdfError(Exception):
    """Root of everything that is raised on purpose; ``exit_code`` is the command line's status.

    found  what an adapter had found of the capture that it refuses (``capture.checks.Findings``)
    """

    exit_code = 1
    found: Any = None


class UsageError(UsdBrdfError):
    """The options contradict each other or name something that does not exist."""

    exit_code = 2


class InputRefused(UsdBrdfError):
    """The capture, mesh, image or stage cannot be used; trying again is useless."""

    exit_code = 3


class ImageRefused(InputRefused):
    """One image cannot be used; a capture with enough others goes on without it.

    path  of its file, where the reader of pixels refused it
    """

    path: Path | None = None


class MeshMissing(InputRefused):
    """No mesh lies where one is to be, or several do."""


class CrashedChild(InputRefused):
    """A child process died of a signal while it worked on the input."""


class EnvironmentFailure(UsdBrdfError):
    """Disk, memory, permission, a missing optional package, time: trying again may help."""

    exit_code = 4


class LateChild(EnvironmentFailure):
    """A child process did not end in time and was stopped."""


class FolderBusy(UsdBrdfError):
    """Another run works in the same output folder."""

    exit_code = 5


class NoLocks(FolderBusy):
    """The file system of the output folder has no working locks: nobody knows who works there."""


class OwnershipConflict(UsdBrdfError):
    """The output folder holds files that are not ours, or ours were edited by hand."""

    exit_code = 6
