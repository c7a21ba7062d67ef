"""Progress goes to stderr, and nowhere when quiet."""

from __future__ import annotations

import pytest

from usdbrdf.job import progress as module
from usdbrdf.job.progress import progress, say, set_quiet


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


def test_names_cannot_command_the_terminal(capsys):
    say("chair \x1b[2J\u202e椅子")
    assert capsys.readouterr().err == "chair \\x1b[2J\\u202e椅子\n"


def test_quiet(capsys):
    set_quiet(True)
    say("hello")
    assert list(progress(range(2), total=2, label="texture", unit="frames")) == [0, 1]
    assert capsys.readouterr().err == ""
