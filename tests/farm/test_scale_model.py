"""The simulation behind docs/scale.md, where its answer is known beforehand."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("simpy", reason="needs the extra dev")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from scale_model import Cluster, Measured, Scan, Step, farmed, played, steps_of

EXACT = Cluster(workers=10, cores=2, scheduler=0.0, spread=0.0, slow=0.0)
# 100 units of 3 s on two cores, after 7 s that one thread takes.
STEP = Step(name="x", alone=7.0, cpu=600.0, units=100, read=0.0, written=0.0)


def test_without_loss_the_clock_is_work_over_workers():
    done = played([STEP], EXACT)
    assert done.seconds == pytest.approx(7 + 30)
    assert done.efficiency == pytest.approx((7 + 300) / (10 * 37))
    assert done.lost["alone"] == pytest.approx(7 * 9 / 370, abs=1e-3)
    assert done.core_hours == pytest.approx(37 * 10 * 2 / 3600)


def test_the_slowest_of_scheduler_and_storage_sets_the_pace():
    slow = played([STEP], replace(EXACT, scheduler=1.0))
    assert slow.seconds == pytest.approx(7 + 100 * 1.0 + 3, abs=0.1)
    # 10 GB each over eight lanes of 1.25 GB/s: 13 rounds of 8 s.
    heavy = played([replace(STEP, read=10e9)], replace(EXACT, workers=100))
    assert heavy.seconds == pytest.approx(7 + 13 * 8 + 3)


def test_equal_scans_on_a_farm_come_in_rounds():
    one = farmed([16e6], EXACT, Measured()).seconds
    three = farmed([16e6] * 30, EXACT, Measured()).seconds
    assert three == pytest.approx(3 * one, rel=0.02)


def test_one_worker_takes_what_was_measured():
    # The run that the figures are from: 4,980 CPU seconds, of which ingest and charts 267.
    steps = steps_of(Scan(texels=16e6, readers=1.0), replace(EXACT, workers=1), Measured())
    assert sum(step.cpu for step in steps) == pytest.approx(4980, rel=0.05)
