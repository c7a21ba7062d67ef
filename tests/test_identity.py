"""Edits of any source take effect, and compiled kernels are kept where nothing can go wrong."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from usdbrdf import identity
from usdbrdf import kernel as kernels

ROOT = Path(__file__).resolve().parents[1]

# A kernel two modules away from what is edited: its own file never changes.
_PROBE = """
from usdbrdf.kernel import kernel
from usdbrdf.transport.warps import shifts_of
@kernel
def probe(numbers):
    return shifts_of(numbers, 2, 7)
"""
_RUN = """
import numpy as np
from usdbrdf.transport.probe import probe
found = probe(np.arange(3))
kept = "compiled" if probe.stats.cache_misses else "loaded"
print(kept, probe.stats.cache_path, found.sum())
"""
_TOLD = """
import numpy as np
from usdbrdf.kernel import when_compiling
from usdbrdf.transport.probe import probe
told = []
with when_compiling(lambda: told.append(1)):
    probe(np.arange(3))
print(len(told) > 0)
"""
_TASK = """
import pathlib
from usdbrdf.job.stamp import stamp_of, stamp_path, why_rerun, write_stamp
asset, wanted = pathlib.Path("asset"), stamp_of("one", {}, {})
print(why_rerun(asset, 1, wanted) or "done")
file = stamp_path(asset, 1, "one")
file.parent.mkdir(parents=True, exist_ok=True)
write_stamp(file, wanted)
"""


@pytest.fixture
def copy(tmp_path):
    """A checkout of its own, with a kernel that calls another room's kernels."""
    for name in ("usdbrdf", "schemas"):
        shutil.copytree(
            ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "asset.new")
        )
    (tmp_path / "usdbrdf/transport/probe.py").write_text(_PROBE)
    return tmp_path


def _start(copy: Path, code: str, **environment: str) -> subprocess.Popen[str]:
    kept_out = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    usual = {name: value for name, value in os.environ.items() if name not in kept_out}
    given = {"PYTHONPATH": str(copy), "HOME": str(copy / "home"), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=copy,
        env={**usual, **given, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _output(process: subprocess.Popen[str]) -> tuple[list[str], str]:
    out, err = process.communicate(timeout=900)
    assert process.returncode == 0, err
    return out.split(), err


def _run(copy: Path, code: str = _RUN, **environment: str) -> list[str]:
    words, err = _output(_start(copy, code, **environment))
    assert err == ""
    return words


def _edit(file: Path, old: str, new: str) -> None:
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), "utf-8")


def test_an_edit_of_what_a_kernel_calls_takes_effect(copy):
    first = _run(copy)
    assert first[0] == "compiled"
    assert _run(copy) == ["loaded", *first[1:]]
    # Of the same length, and as old as the kernels: contents count, not sizes and times.
    warps = copy / "usdbrdf/transport/warps.py"
    times = warps.stat()
    _edit(warps, "2.0**-53", "2.0**-54")
    os.utime(warps, ns=(times.st_atime_ns, times.st_mtime_ns))
    edited = _run(copy)
    assert edited[0] == "compiled"
    assert float(edited[2]) == pytest.approx(float(first[2]) / 2)
    _edit(warps, "2.0**-54", "2.0**-53")
    assert _run(copy) == ["loaded", *first[1:]]
    # What the kernel does not import leaves it alone.
    _edit(copy / "usdbrdf/asset/layout.py", '"""', '"""Edited. ')
    assert _run(copy) == ["loaded", *first[1:]]


@pytest.mark.parametrize("source", ["transport/warps.py", "calibration.json", "capture/parts.py"])
def test_an_edit_of_any_source_runs_the_tasks_again(copy, source):
    assert _run(copy, _TASK) == ["not", "done", "before"]
    (copy / "usdbrdf" / source).touch()
    # Whose subject is finished assets, no task depends on.
    _edit(copy / "usdbrdf/evaluation/metrics.py", '"""', '"""Edited. ')
    assert _run(copy, _TASK) == ["done"]
    with (copy / "usdbrdf" / source).open("a") as file:
        file.write("\n")
    assert _run(copy, _TASK) == ["code", "changed"]
    assert _run(copy, _TASK) == ["done"]


def test_what_has_to_be_compiled_is_told(copy):
    assert _run(copy, _TOLD) == ["True"]
    assert _run(copy, _TOLD) == ["False"]


def test_damaged_kernels_are_compiled_again(copy):
    first = _run(copy)
    for damage in ("cut", "flip", "empty", "garbage", "gone"):
        files = sorted((copy / "home/.cache/usdbrdf/kernels").rglob("*.nbc"))
        assert len(files) >= 2
        for file in files:
            content = bytearray(file.read_bytes())
            middle = len(content) // 2
            content[middle] ^= 16
            damaged = {
                "cut": bytes(content[:middle]),
                "flip": bytes(content),
                "empty": b"",
                "garbage": b"not a kernel " * 9,
            }
            file.write_bytes(damaged[damage]) if damage in damaged else file.unlink()
        assert _run(copy) == first
    assert _run(copy) == ["loaded", *first[1:]]


def test_processes_that_compile_at_once_agree(copy):
    together = [_start(copy, _RUN) for _ in range(4)]
    found = [_output(process) for process in together]
    assert {words[2] for words, _ in found} == {_run(copy)[2]}
    # Three waited for the one that had begun.
    assert sorted(words[0] for words, _ in found) == ["compiled", *["loaded"] * 3]
    assert [err for _, err in found] == [""] * 4
    kernels = copy / "home/.cache/usdbrdf/kernels"
    assert {file.suffix for file in kernels.rglob("*") if file.is_file()} == {".nbc"}


def test_states_of_the_code_that_nobody_uses_are_deleted(copy):
    kernels = copy / "home/.cache/usdbrdf/kernels"
    for age in range(20):
        old = kernels / f"transport.probe-{age:016x}"
        old.mkdir(parents=True)
        os.utime(old, (1e9 - age, 1e9 - age))
    (kernels / "transport.probe-other-0123").mkdir()
    kernels.chmod(0o700)
    _run(copy)
    left = sorted(folder.name for folder in kernels.glob("transport.probe-*"))
    assert len(left) == 17
    assert f"transport.probe-{0:016x}" in left
    assert f"transport.probe-{19:016x}" not in left
    assert "transport.probe-other-0123" in left


def test_the_place_can_be_chosen(copy):
    assert _run(copy, NUMBA_CACHE_DIR=str(copy / "chosen"))[1].startswith(str(copy / "chosen"))
    assert not (copy / "home").exists()


def test_without_a_home_kernels_are_kept_for_the_time_being(copy):
    (copy / "tmp").mkdir()
    without = {"HOME": os.devnull, "TMPDIR": str(copy / "tmp")}
    for kept in ("compiled", "loaded"):
        words, err = _output(_start(copy, _RUN, **without))
        assert words[0] == kept
        assert len(err.splitlines()) == 1
        assert err.startswith(f"usdbrdf: compiled kernels are kept in {copy / 'tmp'}")


@pytest.mark.fault("R16")
@pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can become another user"
)
def test_another_user_without_a_home(copy):
    """Whose interpreter may be out of reach after the change: what is needed is imported before."""
    code = """
import os, sys, numba, numpy as np, tempfile
sys.path.insert(0, sys.argv[1] if len(sys.argv) > 1 else ".")
numba.njit(lambda x: x + 1)(np.arange(3))
import usdbrdf.kernel
from usdbrdf.transport.probe import probe
os.setgid(65534); os.setuid(65534)
print(probe(np.arange(3)).sum(), probe.stats.cache_path)
"""
    home = Path(tempfile.mkdtemp(prefix="usdbrdf-home-"))  # root's own, closed to others
    public = Path(tempfile.mkdtemp(prefix="usdbrdf-tmp-"))
    try:
        public.chmod(0o1777)
        for folder in (copy, *copy.parents[:2]):
            folder.chmod(0o755)
        words, err = _output(_start(copy, code, HOME=str(home), TMPDIR=str(public)))
        assert words[1].startswith(str(public / "usdbrdf-kernels-65534"))
        assert len(err.splitlines()) == 1
        assert list(public.rglob("*.nbc"))
        assert not list(home.iterdir())
    finally:
        shutil.rmtree(public)
        shutil.rmtree(home)


def test_a_place_that_others_can_write_is_not_used(tmp_path):
    assert kernels._is_private(tmp_path / "a" / "b")
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    assert not kernels._is_private(tmp_path / "open")
    (tmp_path / "link").symlink_to(tmp_path / "a" / "b")
    assert not kernels._is_private(tmp_path / "link")


def test_with_no_place_at_all_kernels_run_unkept(monkeypatch, caplog):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def refuse(_folder: Path) -> bool:
        raise PermissionError

    monkeypatch.setattr(kernels, "_is_private", refuse)
    kernels._say_once.cache_clear()
    assert kernels._root.__wrapped__() is None
    assert "compiled kernels are not kept" in caplog.text


def test_the_hash_is_cheap_and_covers_every_module():
    names = set(identity._sources())
    assert {"usdbrdf.kernel", "usdbrdf.transport", "usdbrdf.transport.brdf"} <= names
    probed = identity.kernels_identity(ROOT / "usdbrdf/transport/warps.py")
    assert len(probed) == 16
    assert probed != identity.kernels_identity(ROOT / "usdbrdf/transport/brdf.py")


@pytest.mark.parametrize(
    "statement",
    [
        "from usdbrdf.model.arrays import Float",
        "import usdbrdf.model.arrays",
        "import usdbrdf.model.arrays as a, sys",
        "from usdbrdf.model import arrays as a",
        "from usdbrdf.model import (\n    mesh,\n    arrays,\n)",
        "def late():\n    from usdbrdf.model import arrays",
    ],
)
def test_every_way_to_import_is_followed(monkeypatch, statement):
    monkeypatch.setattr(identity, "_content", lambda _name: statement.encode())
    found = identity._imported.__wrapped__("usdbrdf.kernel")
    assert {"usdbrdf.model", "usdbrdf.model.arrays"} <= found
    assert "usdbrdf" not in found
