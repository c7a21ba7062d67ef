"""USDZ: a zip archive without compression, its content aligned so that it can be read in place."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf, Tf, Usd

from usdbrdf.asset.readers.compose import in_one_line
from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.files.atomic import publish, temporary_beside

# The archive stores local times; one and the same everywhere, so that equal content is equal bytes.
_PINNED_TIME = (2000, 1, 1, 0, 0, 0, 0, 1, -1)


def write_usdz(path: Path, folder: Path, members: Sequence[str]) -> None:
    """Pack files of a folder, the root layer first; opened and checked before it gets its name.

    Exactly these are packed: USD's own packager also takes whatever a layer happens to name.
    """
    pinned = time.mktime(_PINNED_TIME)
    with temporary_beside(path) as staged:
        try:
            writer = Sdf.ZipFileWriter.CreateNew(str(staged))
            for member in members:
                os.utime(folder / member, (pinned, pinned))
                writer.AddFile(str(folder / member), member)
            done = writer.Save()
        except Tf.ErrorException as error:
            raise EnvironmentFailure(
                f"{path}: the package could not be written ({in_one_line(error)}). Free disk space "
                "or correct the permission. [package.write]"
            ) from error
        if not done or not staged.is_file():
            raise EnvironmentFailure(
                f"{path}: the package could not be written. Free disk space or correct the "
                "permission. [package.write]"
            )
        _check(staged, path)
        publish(staged, path)


def _check(staged: Path, path: Path) -> None:
    stage = Usd.Stage.Open(str(staged))
    problems = [in_one_line(problem) for problem in stage.GetCompositionErrors()]
    for prim in stage.TraverseAll():
        for attribute in prim.GetAuthoredAttributes():
            value = attribute.Get()
            if isinstance(value, Sdf.AssetPath) and value.path and not value.resolvedPath:
                problems.append(f"<{attribute.GetPath()}> finds no {value.path}")
    if problems:
        raise UsdBrdfError(
            f"{path}: the package does not compose: {problems[0]}. This is a defect of usdbrdf; "
            "please report it. [package.composition]"
        )
