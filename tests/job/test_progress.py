"""Progress goes to stderr, and nowhere when quiet."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.job import progress as module
from usdbrdf.job.progress import progress, say, set_quiet, warn


@pytest.fixture(autouse=True)
def loud():
    yield
    set_quiet(False)


def test_items_pass_through(capsys):
    assert list(progress(range(3), total=3, label="frames", unit="frames")) == [0, 1, 2]
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def test_log_lines_where_there_is_no_terminal(capsys, monkeypatch):
    monkeypatch.setattr(module, "_SECONDS_BETWEEN_LINES", 0.0)
    assert len(list(progress(range(2), total=2, label="texture", unit="frames"))) == 2
    assert capsys.readouterr().err == "texture: 0 of 2 frames\ntexture: 1 of 2 frames\n"


def test_bar_on_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert list(progress(range(2), total=2, label="texture", unit="frames")) == [0, 1]
    captured = capsys.readouterr()
    assert "texture: 100%" in captured.err
    assert captured.out == ""


def test_the_lines_say_how_much_longer_it_takes(capsys, monkeypatch):
    monkeypatch.setattr(module, "_SECONDS_BETWEEN_LINES", 0.0)
    clock = iter([0.0, 20.0, 40.0, 60.0, 600.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    assert len(list(progress(range(4), total=4, label="fit", unit="objects"))) == 4
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:3] == ["fit: 1 of 4 objects", "fit: 2 of 4 objects, about 60 s left"]
    assert lines[3] == "fit: 3 of 4 objects, about 3 min left"


@pytest.mark.fault("S4")
def test_names_cannot_command_the_terminal(capsys):
    say("chair \x1b[2J\u202e椅子")
    assert capsys.readouterr().err == "chair \\x1b[2J\\u202e椅子\n"


def test_what_is_said_is_one_line_whatever_it_quotes(capsys):
    say("a\nb.exr: gone\r\x1b[31m")
    warn("'a\nwarning: all is well': gone")
    assert capsys.readouterr().err.splitlines() == [
        "a\\nb.exr: gone\\r\\x1b[31m",
        "warning: 'a\\nwarning: all is well': gone",
    ]


def test_warnings_are_told_by_one_function():
    package = Path(module.__file__).parents[1]
    begun = [
        file.relative_to(package).as_posix()
        for file in sorted(package.rglob("*.py"))
        if re.search(r"(say|tell)\(\s*f?\"warning: ", file.read_text("utf-8"))
    ]
    assert begun == ["job/progress.py"]


def test_quiet(capsys):
    set_quiet(True)
    say("hello")
    assert list(progress(range(2), total=2, label="texture", unit="frames")) == [0, 1]
    assert capsys.readouterr().err == ""


@pytest.mark.fault("R16")
def test_no_file_takes_the_number_of_a_closed_stream(tmp_path):
    """Or what a library prints would stand in it."""
    code = """
import os, sys
from usdbrdf.job.progress import fill_closed_streams
fill_closed_streams()
file = os.open(sys.argv[1], os.O_CREAT | os.O_RDWR)
for number in range(3):
    os.write(number, b"printed by a library")
os.write(file, str(file).encode())
"""
    search = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    call = ["/bin/sh", "-c", '"$0" -c "$1" "$2" <&- >&- 2>&-', sys.executable, code]
    subprocess.run(
        [*call, str(tmp_path / "file")], env={**os.environ, "PYTHONPATH": search}, check=True
    )
    assert int((tmp_path / "file").read_text()) > 2


class _Output:
    """A stdout that fails, with a descriptor to send what is left nowhere by."""

    def __init__(self, path: Path, error: OSError) -> None:
        self._file, self._error = path.open("w"), error

    def write(self, text: str) -> None:
        raise self._error

    def fileno(self) -> int:
        return self._file.fileno()

    def close(self) -> None:
        self._file.close()


@pytest.mark.parametrize("whole", [True, False])
def test_a_reader_who_goes_away_has_seen_enough_unless_it_needs_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: bool
):
    gone = _Output(tmp_path / "gone", BrokenPipeError())
    monkeypatch.setattr(sys, "stdout", gone)
    refused = pytest.raises(UsdBrdfError, match=r"its reader went away.*environment\.output")
    with refused if whole else nullcontext():
        module.show("table", whole=whole)
    os.write(gone.fileno(), b"what is left")
    assert (tmp_path / "gone").read_bytes() == b""
    gone.close()
    full = _Output(tmp_path / "full", OSError(28, "No space left on device"))
    monkeypatch.setattr(sys, "stdout", full)
    with pytest.raises(EnvironmentFailure, match=r"cannot be written \(No space left"):
        module.show("table", whole=whole)
    full.close()
    monkeypatch.setattr(sys, "stdout", None)
    refused = pytest.raises(EnvironmentFailure, match=r"stdout is closed")
    with refused if whole else nullcontext():
        module.show("table", whole=whole)


def test_lines_to_stdout_are_there_at_once(capsys: pytest.CaptureFixture[str]):
    module.show("one\ntwo")
    assert capsys.readouterr() == ("one\ntwo\n", "")
