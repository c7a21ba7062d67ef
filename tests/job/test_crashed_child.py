"""What is said of a child that ended by itself, by how it ended and what it said last."""

from __future__ import annotations

import json
import resource
import signal
from pathlib import Path

import pytest

from usdbrdf.errors import CrashedChild, EnvironmentFailure
from usdbrdf.job import child

UNLIMITED = resource.RLIM_INFINITY


def _crash(folder: Path, status: int, said: str = "", limit: int | None = None) -> Exception:
    (folder / "said").write_text(said)
    (folder / "task.json").write_text(json.dumps({"cpu_limit_s": limit}))
    return child._crash(status, folder, "mesh.ply")


@pytest.mark.parametrize(
    ("status", "said", "kind", "sentence"),
    [
        (-9, "", EnvironmentFailure, "was killed from outside or out of memory. Use "),
        (-6, "std::bad_alloc\n", EnvironmentFailure, "was killed from outside or out of memory. "),
        (3, "first\nlast one\n\n", EnvironmentFailure, "could not be started (exit status 3). "),
        (1, "", EnvironmentFailure, "could not be started (exit status 1). Check "),
        (-11, "", CrashedChild, "crashed (SIGSEGV). Repair "),
        (-6, "x" * 300, CrashedChild, "crashed (SIGABRT). "),
    ],
)
def test_the_sentence_tells_how_a_child_ended(
    tmp_path: Path, status: int, said: str, kind: type[Exception], sentence: str
):
    error = _crash(tmp_path, status, said)
    assert type(error) is kind
    assert str(error).startswith(f"mesh.ply {sentence}")
    words = said.strip().splitlines()
    assert ("Its last words" in str(error)) == bool(words)
    if words:
        assert f"Its last words: {words[-1][:200]!r}. " in str(error)


@pytest.mark.parametrize(
    ("own", "shell", "sentence"),
    [
        (100, 60, "longer than this shell allows (60 s)"),
        (None, 60, "longer than this shell allows (60 s)"),
        (60, 60, "longer than it may"),
        (60, 100, "longer than it may"),
        (60, UNLIMITED, "longer than it may"),
        (None, UNLIMITED, "longer than it may"),
    ],
)
def test_the_shell_s_limit_is_told_from_the_child_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: int | None, shell: int, sentence: str
):
    monkeypatch.setattr(resource, "getrlimit", lambda which: (shell, UNLIMITED))
    error = _crash(tmp_path, -signal.SIGXCPU, limit=own)
    assert sentence in str(error)
    assert isinstance(error, CrashedChild) == (sentence == "longer than it may")
