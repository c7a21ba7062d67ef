"""When a task runs again and when it does not."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict, UsdBrdfError
from usdbrdf.job import arithmetic as arithmetic_module
from usdbrdf.job import stamp as stamp_module
from usdbrdf.job import task as task_module
from usdbrdf.job.task import TaskRun, run_task

STAMP = ".usdbrdf/stamps/20-toy.json"


@pytest.fixture
def asset(tmp_path, toy):
    toy.run_toy(tmp_path / "room")
    return tmp_path / "room"


def test_second_run_does_nothing_and_gives_the_same_summary(asset, toy):
    first = toy.run_toy(asset, 2)
    second = toy.run_toy(asset, 2)
    assert first.reran
    assert not second.reran
    assert second.summary == first.summary


def test_nothing_but_the_outputs_and_the_stamp_is_left(asset, hashes):
    assert sorted(hashes(asset)) == [
        ".usdbrdf/job.json",
        ".usdbrdf/lock",
        STAMP,
        "edits.usda",
        "layers/toy.usda",
        "layers/toy_uv.usdc",
        "textures/box0.lit.exr",
        "textures/box1.lit.exr",
        "textures/box2.lit.exr",
    ]
    assert list((asset / ".usdbrdf/work").iterdir()) == []


@pytest.mark.fault("R7")
@pytest.mark.fault("R12")
def test_touched_times_rerun_nothing(asset, toy):
    for path in asset.rglob("*"):
        os.utime(path, (4e9, 4e9))
    assert not toy.run_toy(asset).reran


@pytest.mark.fault("R7")
@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "list", "newer", "escape", "gone"])
def test_damaged_stamp_is_an_absent_one(asset, toy, hashes, damage):
    before = hashes(asset)
    path = asset / STAMP
    text = path.read_text()
    damaged = {
        "cut": text[: len(text) // 2],
        "flip": text.replace('"textures": 3', '"textures": 2', 1),
        "empty": "",
        "list": "[]",
        "newer": text.replace('"schema": 1', '"schema": 2'),
        "escape": text.replace("layers/toy.usda", "../toy.usda"),
        "gone": None,
    }[damage]
    assert damaged != text
    path.unlink() if damaged is None else path.write_text(damaged)
    result = toy.run_toy(asset)
    assert result.reran
    assert result.reason == "not done before"
    assert hashes(asset) == before


@pytest.mark.fault("R7")
@pytest.mark.parametrize(
    "changes",
    [
        {"outputs": ["layers/toy.usda"]},
        {"outputs": {"layers/toy.usda": 5}},
        {"inputs": "x"},
        {"parameters": [1]},
        {"summary": 3},
        {"once": {"edits.usda": 1}},
        {"once": [5]},
        {"earlier": {"layers/toy.usda": "ab"}},
        {"stage": None},
    ],
)
def test_a_stamp_of_other_types_is_an_absent_one(asset, toy, hashes, changes):
    """Whoever alters it can reckon its hash."""
    before, path = hashes(asset), asset / STAMP
    record = json.loads(path.read_text()) | changes
    told = {key: value for key, value in record.items() if key not in ("schema", "check")}
    path.write_text(json.dumps(record | {"check": stamp_module._sha256_of_json(told)}))
    assert stamp_module.known_hashes(asset / ".usdbrdf") == {}
    assert toy.run_toy(asset).reason == "not done before"
    assert hashes(asset) == before


@pytest.mark.fault("R9")
@pytest.mark.parametrize("name", ["textures/box1.lit.exr", "layers/toy.usda", STAMP, "textures"])
@pytest.mark.parametrize("known", [True, False])
def test_a_folder_in_the_place_of_a_file_stops_nothing_half_way(
    tmp_path, asset, toy, hashes, name, known
):
    """Nor does a file in the place of a folder; when it is gone the same command ends the work."""
    before = hashes(asset)
    folder = asset if known else tmp_path / "new"
    if not known:
        toy.run_toy(folder)  # the folder is ours, and knows no file
        shutil.rmtree(folder / "textures")
        (folder / STAMP).unlink()
    place = folder / name
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.write_text("x") if name == "textures" else place.mkdir(parents=True)
    with pytest.raises(OwnershipConflict, match=f"{place}: this is .*ownership.place"):
        toy.run_toy(folder)
    assert not list(folder.glob(".usdbrdf/publishing-*"))
    place.unlink() if place.is_file() else place.rmdir()
    assert toy.run_toy(folder).reran
    assert hashes(folder) == before


@pytest.mark.fault("R8")
def test_changed_parameter_reruns_and_says_so(asset, toy):
    assert toy.run_toy(asset, 2).reason == "parameters changed: seed"


def test_no_folder_stays_of_which_all_files_are_gone(tmp_path):
    """Objects that have another name lie in another folder."""

    def run(*names):
        def work(run):
            for name in names:
                run.output(f"objects/{name}/{name}.usda").write_text(name)
            return {}

        run_task(tmp_path, "one", order=1, parameters={"names": names}, inputs={}, work=work)
        return sorted(path.name for path in tmp_path.glob("objects/*"))

    assert run("chair", "wall") == ["chair", "wall"]
    (tmp_path / "objects/chair/mine.txt").write_text("what somebody put there")
    assert run("stool", "wall") == ["chair", "stool", "wall"]
    assert run("stool") == ["chair", "stool"]
    (tmp_path / "objects/chair/mine.txt").unlink()
    (tmp_path / "objects/chair").rmdir()
    assert run() == []
    assert not (tmp_path / "objects").exists()


@pytest.mark.fault("R8")
def test_changed_input_and_version_rerun(tmp_path, monkeypatch):
    def run(sha256):
        return run_task(
            tmp_path,
            "one",
            order=1,
            parameters={"size": np.float32(0.5), "names": ("a",)},
            inputs={"scan": sha256},
            work=lambda run: run.output("layers/a.usda").write_text("x") and {},
        )

    assert run("aa").reran
    assert not run("aa").reran
    assert run("bb").reason == "inputs changed: scan"
    with monkeypatch.context() as another:
        another.setattr(stamp_module, "tasks_identity", lambda: "another")
        assert run("bb").reason == "code changed"
    assert run("bb").reason == "code changed"
    monkeypatch.setattr(stamp_module, "code_version", lambda: "9")
    assert run("bb").reason.startswith("version 9 instead of ")


@pytest.mark.fault("R7")
@pytest.mark.parametrize("path", ["layers/toy.usda", "textures/box1.lit.exr", "edits.usda"])
def test_deleted_output_is_made_again(asset, toy, hashes, path):
    before = hashes(asset)
    (asset / path).unlink()
    assert toy.run_toy(asset).reason == f"output missing: {path}"
    assert hashes(asset) == before


def test_edited_output_reruns_but_the_artists_file_stays(asset, toy):
    (asset / "edits.usda").write_text("#usda 1.0\n# mine\n")
    (asset / "layers/toy.usda").write_text("#usda 1.0\n# mine\n")
    assert toy.run_toy(asset).reason == "output changed: layers/toy.usda"
    assert "mine" not in (asset / "layers/toy.usda").read_text()
    assert "mine" in (asset / "edits.usda").read_text()


def test_output_no_longer_made_is_deleted_unless_edited(asset, toy):
    toy.run_toy(asset, textures=2)
    assert not (asset / "textures/box2.lit.exr").exists()
    toy.run_toy(asset, textures=3)
    (asset / "textures/box2.lit.exr").write_bytes(b"mine")
    toy.run_toy(asset, textures=2)
    assert (asset / "textures/box2.lit.exr").read_bytes() == b"mine"


def test_outputs_of_refused_work_are_not_published(tmp_path):
    def work(run):
        run.output("layers/a.usda").write_text("x")
        raise InputRefused("no")

    with pytest.raises(InputRefused):
        run_task(tmp_path, "one", order=1, parameters={}, inputs={}, work=work)
    assert not (tmp_path / "layers").exists()
    assert not (tmp_path / ".usdbrdf/stamps/1-one.json").exists()


@pytest.mark.parametrize("relative", ["../a", "/a", ".usdbrdf/a", "", "a/../../b"])
def test_output_outside_the_asset_is_our_bug(tmp_path, relative):
    with pytest.raises(UsdBrdfError, match=r"not a path inside the asset. \[task.output\]"):
        run_task(
            tmp_path,
            "one",
            order=1,
            parameters={},
            inputs={},
            work=lambda run: {"path": str(run.output(relative))},
        )


def test_output_that_was_not_written_is_our_bug(tmp_path):
    with pytest.raises(UsdBrdfError, match=r"did not write layers/a\.usda"):
        run_task(
            tmp_path,
            "one",
            order=1,
            parameters={},
            inputs={},
            work=lambda run: {"path": str(run.output("layers/a.usda"))},
        )


@pytest.mark.parametrize("error", [MemoryError(), OSError("1920000 requested and 524256 written")])
def test_what_the_machine_lacks_is_an_environment_failure(tmp_path, error):
    def work(run):
        raise error

    with pytest.raises(EnvironmentFailure, match=r"^one: .+ \[environment\.(memory|io)\]$"):
        run_task(tmp_path, "one", order=1, parameters={}, inputs={}, work=work)


def test_checkpoints_give_the_arrays_back_bit_for_bit(tmp_path):
    arrays = {
        "file": np.array([np.nan, -0.0, np.inf]),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "scalar": np.array(3, dtype=np.uint8),
        "empty": np.zeros((0, 3), dtype=np.float32),
    }
    loaded = {}

    def work(run):
        run.save("é/@0.x", arrays)
        loaded.update(run.checkpoint_if("é/@0.x"))
        assert run.checkpoint_if("é") is None
        assert run.latest("é/@0.x") is None
        return {}

    run_task(tmp_path, "one", order=1, parameters={}, inputs={}, work=work)
    assert list(loaded) == list(arrays)
    for key, array in arrays.items():
        assert loaded[key].dtype == array.dtype
        assert loaded[key].tobytes() == array.tobytes()


def test_a_running_state_is_not_saved_all_the_time(tmp_path, monkeypatch):
    clock, saved = [0.0], []
    monkeypatch.setattr(task_module.time, "monotonic", lambda: clock[0])

    def state():
        saved.append(clock[0])
        clock[0] += 1  # a second to save
        return {"sum": np.zeros(3)}

    def work(run):
        for frame in range(120):
            clock[0] += 1
            run.save_latest_in_time("sum", frame, state)
        return {}

    run_task(tmp_path, "one", order=1, parameters={}, inputs={}, work=work)
    assert saved[0] == 1
    assert np.diff(saved).min() >= 20
    assert 3 <= len(saved) <= 6


def test_stamp_has_no_time_and_no_absolute_path(asset):
    text = (asset / STAMP).read_text()
    assert str(asset.parent) not in text
    assert set(json.loads(text)) == {
        "check",
        "code",
        "earlier",
        "inputs",
        "once",
        "outputs",
        "parameters",
        "schema",
        "stage",
        "summary",
        "version",
    }


def test_outputs_that_take_long_are_made_once(tmp_path):
    """An interrupted run leaves those that it finished to the next, and none to another task."""
    asset, made = tmp_path / "room", []
    (asset / ".usdbrdf").mkdir(parents=True)

    def run(until, seed=0):
        def write(name, place):
            made.append(name)
            place.write_text(f"{name} {seed}")

        def work(run):
            for name in ("a", "b/c", "d")[:until]:
                run.output_kept(f"frames/{name}.exr", lambda place, name=name: write(name, place))
            if until < 3:
                raise InputRefused("killed")
            return {}

        arguments = {"parameters": {"seed": seed}, "inputs": {}, "work": work}
        return run_task(asset, "toy", order=20, **arguments)

    with pytest.raises(InputRefused):
        run(2)
    assert made == ["a", "b/c"]
    assert not (asset / "frames").exists()
    kept = next((asset / ".usdbrdf/work").glob("toy-*/*/kept/*a.exr*"))
    kept.write_text("damaged")
    assert run(3).reran
    assert made == ["a", "b/c", "a", "d"]
    assert (asset / "frames/b/c.exr").read_text() == "b/c 0"
    assert (asset / "frames/a.exr").read_text() == "a 0"
    assert not run(3).reran
    (asset / "frames/d.exr").unlink()
    assert "missing" in run(3).reason
    run(3, seed=1)
    assert (asset / "frames/a.exr").read_text() == "a 1"
    assert list((asset / ".usdbrdf/work").iterdir()) == []


@pytest.mark.fault("R2")
@pytest.mark.parametrize("stop", ["write_stamp", "move", "flush_folder"])
def test_outputs_that_took_long_are_not_made_again_after_a_stop_at_publishing(
    tmp_path, monkeypatch, stop
):
    """Before the journal is written, and before the first output is moved, or after all are."""
    asset, made = tmp_path / "room", []
    (asset / ".usdbrdf").mkdir(parents=True)

    def work(run):
        for name in ("a", "b/c"):
            run.output_kept(
                f"frames/{name}.exr", lambda place, name=name: made.append(place.write_text(name))
            )
        run.output("layers/a.usda").write_text("x")
        return {}

    def stopped(*_):
        raise KeyboardInterrupt

    task = {"order": 20, "parameters": {}, "inputs": {}, "work": work}
    monkeypatch.setattr(task_module, stop, stopped)
    with pytest.raises(KeyboardInterrupt):
        run_task(asset, "toy", **task)
    monkeypatch.undo()
    assert run_task(asset, "toy", **task).reran
    assert len(made) == 2
    assert (asset / "frames/b/c.exr").read_text() == "b/c"
    assert (asset / "layers/a.usda").read_text() == "x"
    assert list((asset / ".usdbrdf/work").iterdir()) == []


def test_no_kind_of_machine_goes_on_with_the_pieces_of_another(tmp_path, monkeypatch):
    """But with its own, where both try in turn; what either has finished is finished for both."""
    asset, made = tmp_path / "room", []
    (asset / ".usdbrdf").mkdir(parents=True)

    def piece(machine, name):
        made.append(f"{name} of {machine}")
        return {"found": np.arange(3)}

    def run_on(machine, stops):
        def work(run):
            for name in ("a", "b"):
                run.checkpoint(name, lambda name=name: piece(machine, name))
                run.output_kept(f"{name}.exr", lambda place: place.write_text(machine))
                if stops:
                    raise KeyboardInterrupt
            return {}

        processor = {"processor": machine}
        monkeypatch.setattr(arithmetic_module, "arithmetic", lambda: processor)
        return run_task(asset, "toy", order=20, parameters={}, inputs={}, work=work)

    for machine in ("zen", "lake"):
        with pytest.raises(KeyboardInterrupt):
            run_on(machine, stops=True)
    with monkeypatch.context() as patched:
        patched.setattr(task_module, "move", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run_on("zen", stops=False)
    assert made == ["a of zen", "a of lake", "b of zen"]
    assert run_on("lake", stops=False).reason == "publish interrupted"
    assert not run_on("lake", stops=False).reran
    assert [(asset / f"{name}.exr").read_text() for name in "ab"] == ["zen", "zen"]
    assert len(made) == 3


def _threads_of_blas() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_blas_keeps_to_one_thread_in_the_work(tmp_path):
    told = []

    def work(_: object) -> dict[str, int]:
        told.append(_threads_of_blas())
        return {}

    with threadpool_limits(limits=2, user_api="blas"):
        run_task(tmp_path / "room", "toy", order=20, parameters={}, inputs={}, work=work)
        assert told == [{1}]
        assert _threads_of_blas() == {2}


def test_states_are_saved_every_two_seconds_or_thirty_times_what_saving_takes(
    tmp_path, monkeypatch
):
    run = TaskRun(tmp_path, "toy", tmp_path / "work")
    saved, now, takes = [], 100.0, 0.0

    def save(key, index, arrays):
        nonlocal now
        now += takes
        saved.append((key, index, arrays))

    monkeypatch.setattr(task_module.time, "monotonic", lambda: now)
    monkeypatch.setattr(run, "save_latest", save)
    run._saved = now, 0.0
    for wait, seconds, index in (
        (1.9, 0.0, None), (0.1, 0.5, 1), (14.9, 0.5, None), (0.1, 0.01, 3), (1.9, 9.0, None),
        (0.1, 0.0, 5),
    ):  # fmt: skip
        now, takes = now + wait, seconds
        before = len(saved)
        run.save_latest_in_time("sum", index or 0, lambda: {"made": "once"})
        assert len(saved) - before == (index is not None)
    assert saved == [("sum", index, {"made": "once"}) for index in (1, 3, 5)]
