"""Run the toy task here and in a process that may be killed, and hash what it leaves."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.fault_injection import VARIABLE
from usdbrdf.files.atomic import sha256_of

TOY = Path(__file__).with_name("toy_task.py")
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def toy() -> ModuleType:
    spec = importlib.util.spec_from_file_location("toy_task", TOY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def toy_process() -> Callable[..., subprocess.CompletedProcess[str]]:
    def run(asset: Path, *arguments: str, fault: str = "") -> subprocess.CompletedProcess[str]:
        search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        return subprocess.run(
            [sys.executable, str(TOY), str(asset), *arguments],
            env={**os.environ, "PYTHONPATH": search, VARIABLE: fault},
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def hashes() -> Callable[[Path], dict[str, str]]:
    """SHA-256 of every file below a folder, the state folder included."""

    def of(folder: Path) -> dict[str, str]:
        return {
            str(path.relative_to(folder)): sha256_of(path)
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    return of
