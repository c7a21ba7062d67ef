"""SIGKILL inside each of the four steps, then the same command: the same bytes as undisturbed.

The undisturbed run uses the program as it is; the disturbed ones cut shading into small tiles, so
that there is something in between to be killed, and differ in nothing else.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest

import usdbrdf.geometry.unwrap
import usdbrdf.material.fit_objects
import usdbrdf.shading.shaded
import usdbrdf.texturing.lit_texture
from tests.children import Program, started_program
from tests.fault_injection import VARIABLE, inject
from tests.scenes import make_capture
from usdbrdf.cli import main
from usdbrdf.files.atomic import TEMPORARY_PREFIX, sha256_of
from usdbrdf.job.ownership import edited_files

TILE = 64  # texels
PROGRAM = f"""
import sys
import usdbrdf.shading.shaded
usdbrdf.shading.shaded._TILE = {TILE}
from usdbrdf.cli import main
from tests.fault_injection import arm_from_environment
arm_from_environment()
sys.exit(main(sys.argv[1:]))
"""
NUM_FRAMES = 20
# Enough for four objects and a lamp, and for pixels to fit to.
OPTIONS = {
    "ingest": [],
    "texture": ["--texel-size", "0.25"],
    "shade": ["--rays", "16"],
    "fit": ["--max-pixels", "60"],
}
STEPS = tuple(OPTIONS)
FAULTS = {
    "ingest": [
        "ingest:before_write:1",
        "ingest:before_publish",
        "publish:before_replace:3",  # after job.json and the journal: scan.usdc
        "ingest:mid_publish",
    ],
    "texture": ["image:before_write:7", "texture:mid_publish:9", "texture:before_stamp"],
    "shade": [
        "publish:before_replace:2",  # the second tile
        "image:before_write:5",
    ],
    "fit": [
        "fit:checkpoint:1",  # target frames
        "fit:before_write",
        "fit:mid_publish",
    ],
}
# More places are in the tests of what is computed again.
IN_STEPS = [(step, fault) for step, faults in FAULTS.items() for fault in faults]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A folder with the capture; assets are BASE/<case>/room, all equally far from it."""
    folder = tmp_path_factory.mktemp("kill")
    make_capture(folder / "scan", frames=NUM_FRAMES, size=(24, 18), subdivisions=1)
    return folder


@pytest.fixture(scope="module")
def undisturbed(base):
    """Asset after each step by its name, and what was there "before" the first."""
    stages = {"before": base / "before" / "room"}
    stages["before"].mkdir(parents=True)
    for before, step in zip(("before", *STEPS), STEPS, strict=False):
        stages[step] = base / f"after-{step}" / "room"
        shutil.copytree(stages[before], stages[step])
        assert main(command(step, base, stages[step])) == 0
    return stages


@pytest.fixture
def small_tiles(monkeypatch):
    monkeypatch.setattr(usdbrdf.shading.shaded, "_TILE", TILE)


@pytest.fixture
def case(base, undisturbed, small_tiles, request):
    """Makes the asset of this test as it was before a step."""
    folder = base / f"case-{request.node.name}".replace("/", "-").replace(":", "-")

    def before(step: str) -> Path:
        asset = folder / "room"
        shutil.copytree(undisturbed[("before", *STEPS)[STEPS.index(step)]], asset)
        return asset

    yield before
    shutil.rmtree(folder, ignore_errors=True)


def command(name: str, base: Path, asset: Path) -> list[str]:
    place = [str(asset)] if name in STEPS[1:] else [str(base / "scan"), "-o", str(asset)]
    options = [option for step in STEPS if name in (step, "convert") for option in OPTIONS[step]]
    return [name, "-q", *place, *options]


def start(arguments: list[str], fault: str = "") -> Program | subprocess.Popen[bytes]:
    return started_program(PROGRAM, arguments, {VARIABLE: fault})


def killed_at(arguments: list[str], fault: str) -> None:
    process = start(arguments, f"kill@{fault}")
    _, said = process.communicate(timeout=600)
    assert process.returncode == -signal.SIGKILL, said.decode()


def hashes(asset: Path) -> dict[str, str]:
    """SHA-256 of every file, the state folder's too; none of them is litter."""
    files = [path for path in sorted(asset.rglob("*")) if path.is_file()]
    assert not [path for path in files if path.name.startswith(TEMPORARY_PREFIX)]
    assert not list((asset / ".usdbrdf" / "work").iterdir())
    return {path.relative_to(asset).as_posix(): sha256_of(path) for path in files}


@pytest.mark.fault("R2")
@pytest.mark.parametrize(("step", "fault"), IN_STEPS)
def test_killed_step_resumes_to_the_same_bytes(base, undisturbed, case, step, fault):
    asset = case(step)
    call = command(step, base, asset)
    killed_at(call, fault)
    assert edited_files(asset) == []
    assert main(call) == 0
    assert hashes(asset) == hashes(undisturbed[step])


@pytest.mark.fault("R2")
def test_a_convert_killed_once_in_every_step_ends_in_the_same_bytes(base, undisturbed, case):
    asset = case("ingest")
    call = command("convert", base, asset)
    for step in STEPS:
        killed_at(call, f"{step}:mid_publish")
    assert main(call) == 0
    assert hashes(asset) == hashes(undisturbed["fit"])


# Finished pieces are not computed again


@pytest.fixture
def calls(monkeypatch):
    """Counts the calls of functions, by name; and the frame that texturing begins with."""
    counted: Counter[str] = Counter()

    def count(module, name):
        function = getattr(module, name)

        def counting(*arguments, **options):
            counted[name] += 1
            if name == "samples_from_frames":
                counted["first frame"] = arguments[3][0]
            return function(*arguments, **options)

        monkeypatch.setattr(module, name, counting)

    count(usdbrdf.geometry.unwrap, "unwrap")
    count(usdbrdf.texturing.lit_texture, "samples_from_frames")
    count(usdbrdf.shading.shaded, "irradiance_at")
    count(usdbrdf.material.fit_objects, "choose_target_frames")
    count(usdbrdf.material.fit_objects, "fit_object")
    return counted


@pytest.fixture
def resumed(base, undisturbed, case, calls):
    """Kills a step and runs it again, to the same bytes; returns the calls of the second run."""

    def after(step: str, fault: str) -> Counter[str]:
        asset = case(step)
        call = command(step, base, asset)
        killed_at(call, f"{step}:{fault}")
        calls.clear()
        assert main(call) == 0
        assert hashes(asset) == hashes(undisturbed[step])
        return Counter(calls)

    return after


def test_texturing_goes_on_after_the_last_saved_frame(resumed):
    found = resumed("texture", "checkpoint:2")  # the first are the charts; then the first frame
    assert found == {"samples_from_frames": 1, "first frame": 1}


@pytest.mark.fault("R2")
def test_shading_traces_only_the_tiles_that_are_missing(base, case, calls, resumed):
    asset = case("shade")
    assert main(command("shade", base, asset)) == 0
    tiles = calls["irradiance_at"]
    assert tiles > 6
    shutil.rmtree(asset)
    # The first checkpoints are panes, the light from outside, of hidden surfaces and of lamps that
    # no frame shows, both twice, and of hidden surfaces in the light of all lamps.
    assert resumed("shade", "checkpoint:10") == {"irradiance_at": tiles - 3}


def test_fitting_fits_only_the_objects_that_are_missing(resumed):
    # The first checkpoint are the target frames; then a first look at each of 5 objects.
    assert resumed("fit", "checkpoint:8") == {"fit_object": 5 - 2}


def test_a_step_that_was_being_published_is_not_computed_again(resumed):
    assert not resumed("shade", "mid_publish:6")


# Other ways to be interrupted


@pytest.mark.fault("R1")
@pytest.mark.parametrize("fault", ["before_publish", "mid_publish:3"])
def test_full_disk_while_publishing(base, undisturbed, case, monkeypatch, capsys, fault):
    asset = case("fit")
    before = hashes(asset)
    call = ["shade", str(asset), *OPTIONS["shade"], "--seed", "1"]
    with monkeypatch.context() as patch:
        inject(f"enospc@shade:{fault}", patch)
        assert main([*call]) == 4
    assert "No space left on device" in capsys.readouterr().err
    now = {name: sha256_of(asset / name) for name in before}
    changed = {name for name in before if now[name] != before[name]}
    # What is not the old file is the new one, and whole.
    assert len(changed - {".usdbrdf/lock"}) == (3 if fault.startswith("mid") else 0)
    assert edited_files(asset) == []
    assert main(call) == 0
    after = hashes(asset)
    assert {name: after[name] for name in changed} == {name: now[name] for name in changed}
    assert main(["shade", str(asset), *OPTIONS["shade"]]) == 0
    assert hashes(asset) == before


@pytest.mark.fault("R3")
@pytest.mark.fault("R6")
def test_a_second_run_is_refused_and_the_first_stops_when_told_to(base, undisturbed, case):
    asset = case("ingest")
    call = command("convert", base, asset)
    first = start(call)
    _wait_for(lambda: (asset / ".usdbrdf/lock").is_file() and (asset / ".usdbrdf/lock").read_text())
    assert main(call) == 5
    _wait_for(lambda: any((asset / ".usdbrdf" / "work").glob("texture-*")))
    first.terminate()
    _, said = first.communicate(timeout=300)
    assert first.returncode == 143, said.decode()
    assert main(call) == 0
    assert hashes(asset) == hashes(undisturbed["fit"])


def _wait_for(condition) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)
