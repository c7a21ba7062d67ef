"""Folders for a while: gone at the end, or at the next one's beginning; and never another's."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from pathlib import Path

import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.files import scratch
from usdbrdf.files.scratch import PREFIX, scratch_folder, told_as


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_folder_is_there_locked_and_of_this_user_alone_until_its_block_ends(temporary: Path):
    with scratch_folder() as folder:
        assert folder.parent == temporary
        assert folder.name.startswith(PREFIX)
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "file").write_text("x")
        other = os.open(folder, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(other)
        before = len(os.listdir("/proc/self/fd"))
    assert not folder.exists()
    assert len(os.listdir("/proc/self/fd")) == before - 1


def test_what_is_refused_within_names_what_was_to_be_made(temporary: Path, tmp_path: Path):
    final = tmp_path / "asset.usdz"
    with pytest.raises(InputRefused) as caught, scratch_folder(final) as folder:
        raise InputRefused(f"{folder}: no room. Make some. [a.b]")
    assert str(caught.value) == f"{final}: no room. Make some. [a.b]"
    with pytest.raises(InputRefused) as caught, scratch_folder() as folder:
        raise InputRefused(f"{folder}: no room. Make some. [a.b]")
    assert str(caught.value).startswith(str(temporary / PREFIX))


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("/t/x.exr: bad", "/o/y.exr: bad"),
        ("in /t/x.exr.tmp.exr.", "in /o/y.exr."),
        ("/t/x.exr-old and /t/x.exr2", "/t/x.exr-old and /t/x.exr2"),
        ("'/t/x.exr', '/t/x.exr'", "'/o/y.exr', '/o/y.exr'"),
        ("/t/x_exr", "/t/x_exr"),
    ],
)
def test_of_temporary_names_their_own_endings_go_too(said: str, told: str):
    with pytest.raises(InputRefused) as caught, told_as(Path("/t/x.exr"), Path("/o/y.exr")):
        raise InputRefused(said)
    assert str(caught.value) == told


def test_what_nobody_owns_any_more_goes_after_a_minute(temporary: Path):
    ages = {"old": 62, "young": 55, "locked": 62, "file": 62}
    for name in ("old", "young", "locked"):
        (temporary / f"{PREFIX}{name}" / "below").mkdir(parents=True)
    (temporary / f"{PREFIX}file").touch()
    (temporary / "other").mkdir()
    (temporary / f"{PREFIX}link").symlink_to(temporary / "other")
    for name, seconds in ages.items():
        os.utime(temporary / f"{PREFIX}{name}", (0, time.time() - seconds))
    os.utime(temporary / "other", (0, 0))
    held = os.open(temporary / f"{PREFIX}locked", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    scratch._sweep.cache_clear()
    before = len(os.listdir("/proc/self/fd"))
    with scratch_folder():
        pass
    left = {path.name.removeprefix(PREFIX) for path in temporary.iterdir()}
    os.close(held)
    assert left == {"young", "locked", "file", "link", "other"}
    assert len(os.listdir("/proc/self/fd")) == before - 1
    # Once in a process is enough.
    (temporary / f"{PREFIX}again").mkdir()
    os.utime(temporary / f"{PREFIX}again", (0, 0))
    with scratch_folder():
        assert (temporary / f"{PREFIX}again").exists()
    scratch._sweep.cache_clear()
