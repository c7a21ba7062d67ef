"""Run the toy task here and in a process that may be killed, and hash what it leaves."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.children import started_program
from tests.fault_injection import VARIABLE
from usdbrdf.files.atomic import sha256_of

TOY = Path(__file__).with_name("toy_task.py")
_AS_SCRIPT = f"import runpy; runpy.run_path({str(TOY)!r}, run_name='__main__')"


@pytest.fixture(scope="session")
def toy() -> ModuleType:
    spec = importlib.util.spec_from_file_location("toy_task", TOY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def toy_process() -> Callable[..., subprocess.CompletedProcess[str]]:
    def run(asset: Path, *arguments: str, fault: str = "") -> subprocess.CompletedProcess[str]:
        words = [str(asset), *arguments]
        process = started_program(_AS_SCRIPT, words, {VARIABLE: fault})
        out, err = process.communicate(timeout=600)
        return subprocess.CompletedProcess(words, process.returncode, out.decode(), err.decode())

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
