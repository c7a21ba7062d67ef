"""How much memory there is, and that it is given back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from usdbrdf.job import memory


def test_a_container_may_have_less_than_the_machine(tmp_path: Path, monkeypatch):
    machine = memory.machine_bytes()
    monkeypatch.setattr(memory, "_CONTAINER", tmp_path / "memory.max")
    for text, expected in (("max", machine), (str(1 << 29), 1 << 29)):
        (tmp_path / "memory.max").write_text(text + "\n")
        assert memory.machine_bytes() == pytest.approx(expected, rel=0.5 if text == "max" else 0)


def test_what_a_process_holds_is_known_where_the_system_tells(tmp_path: Path, monkeypatch):
    if not memory.resident_bytes():
        pytest.skip("this system has no /proc")
    before = memory.resident_bytes()
    held = np.ones(1 << 24)
    assert memory.resident_bytes() - before > 0.9 * held.nbytes
    monkeypatch.setattr(memory, "_OF_PROCESS", tmp_path / "none")
    assert memory.resident_bytes() == 0


def test_freed_memory_goes_back():
    if not memory.resident_bytes():
        pytest.skip("this system has no /proc")
    # Blocks too small to be mapped one by one, the last of which keeps the heap from shrinking.
    blocks = [bytearray(60_000) for _ in range(4000)]
    full = memory.resident_bytes()
    last = blocks.pop()
    blocks.clear()
    memory.give_back_freed()
    assert full - memory.resident_bytes() > 0.8 * 4000 * 60_000
    assert len(last) == 60_000
