"""What a task hands to its workers, and how those of this process go about it."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tests.job.toy_task import run_toy
from usdbrdf.job.ownership import owned_folder
from usdbrdf.job.task import run_task
from usdbrdf.job.units import HERE, ThisProcess


def squared(shared: float, piece: int) -> dict[str, np.ndarray]:
    return {"square": np.array(shared + piece**2)}


class Noting(ThisProcess):
    """Does units here, last first, and notes what it was given."""

    def __init__(self) -> None:
        self.given = []

    def results(self, unit, shared, pieces, folder, at_a_time):
        self.given.append(({**pieces}, at_a_time))
        rest = dict(reversed(pieces.items()))
        return super().results(unit, shared, rest, folder, at_a_time)


def run(asset, work, workers=HERE):
    with owned_folder(asset):
        return run_task(
            asset, "units", order=21, parameters={}, inputs={}, work=work, workers=workers
        )


def test_only_what_is_missing_is_handed_out_one_at_a_time_and_comes_back_in_its_order(tmp_path):
    noting = Noting()
    pieces = {f"tile/{k}": k for k in range(4)}

    def work(task, **chosen):
        found = task.units(squared, 0.5, pieces, label="toy", noun="tiles", **chosen)
        return {"squares": [float(one["square"]) for one in found]}

    def stopped(task):
        task.save("tile/1", {"square": np.array(-1.0)})
        work(task)
        assert task.checkpoint_if("tile/3") is not None
        work(task)
        raise KeyboardInterrupt

    # In a folder that nothing was published into yet, checkpoints go with it.
    run_toy(tmp_path / "room")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "room", stopped, noting)
    # All were there the second time.
    assert noting.given == [({"tile/0": 0, "tile/2": 2, "tile/3": 3}, 1)]
    done = run(tmp_path / "room", lambda task: work(task, at_a_time=3), noting)
    assert len(noting.given) == 1
    assert done.summary == {"squares": [0.5, -1.0, 4.5, 9.5]}


def test_as_many_work_at_a_time_as_were_asked_for(tmp_path):
    together = threading.Barrier(3, timeout=20)

    def unit(_shared, piece):
        together.wait()
        return {"own": np.array(piece)}

    pieces = {str(k): k for k in range(6)}
    found = dict(HERE.results(unit, None, pieces, tmp_path, 3))
    assert {key: int(one["own"]) for key, one in found.items()} == pieces


def test_after_a_failure_nothing_more_is_begun(tmp_path):
    begun = []

    def unit(_shared, piece):
        begun.append(piece)
        time.sleep(0.02)
        raise ZeroDivisionError

    pieces = {str(k): k for k in range(200)}
    with pytest.raises(ZeroDivisionError):
        list(HERE.results(unit, None, pieces, tmp_path, 2))
    assert len(begun) < 100
