"""What many tests start from, what none may leave behind for the next, and which take long."""

from __future__ import annotations

import os
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import pytest
from threadpoolctl import threadpool_limits

import usdbrdf.job.child
from tests.children import Children
from tests.remembered import remembered
from tests.synthetic_asset import box, build, make_scan
from usdbrdf.job.processes import granted_cores
from usdbrdf.job.progress import set_quiet
from usdbrdf.tasks import registration

# Files and folders whose tests run the pipeline, kill processes, start other programs, damage whole
# captures, pack whole assets or fit materials; `pytest -m "not slow"` leaves them out.
SLOW = (
    "asset/test_previews.py",
    "asset/test_schema.py",
    "capture/test_adapters.py",
    "cluster/test_workers.py",
    "cluster/test_workers_by_object_store.py",
    "dcc",
    "delivery/test_acescg.py",
    "delivery/test_glb.py",
    "delivery/test_low_poly.py",
    "delivery/test_package_refused.py",
    "delivery/test_package_usdz.py",
    "delivery/test_package_whole.py",
    "delivery/test_publish.py",
    "evaluation",
    "farm/test_work.py",
    "faults/test_bad_captures.py",
    "faults/test_frames_that_disagree.py",
    "faults/test_hostile_files.py",
    "faults/test_kill_resume.py",
    "faults/test_two_at_once.py",
    "faults/test_what_children_open.py",
    "fuzzing",
    "job/test_child.py",
    "job/test_disturbed.py",
    "job/test_kill_resume.py",
    "material/test_fit_lobe.py",
    "material/test_refine.py",
    "material/test_view_model.py",
    "nondestruction",
    "page/test_browser.py",
    "page/test_gone.py",
    "page/test_report.py",
    "paper",
    "physics/test_lobe_samples.py",
    "physics/test_recovery.py",
    "plugins",
    "relighting/test_model.py",
    "relighting/test_relight.py",
    "shading/test_denoise.py",
    "shading/test_denoise_default.py",
    "shading/test_outside.py",
    "tasks/test_directives.py",
    "tasks/test_texture.py",
    "test_cli.py",
    "test_convert.py",
    "test_identity.py",
    "test_lightings.py",
    "test_scales.py",
    "test_units.py",
    "texturing/test_earlier.py",
    "texturing/test_pose_steps.py",
)

# Sweeps whose cases take seconds each: every third runs for each change, the others at night.
SWEEPS = (
    "faults/test_hostile_files.py::test_a_promise_is_refused_and_not_made_room_for",
    "faults/test_hostile_files.py::test_a_stage_that_leads_out_is_refused",
    "faults/test_kill_resume.py::test_killed_step_resumes_to_the_same_bytes",
    "job/test_kill_resume.py::test_killed_run_resumes_to_the_same_bytes",
    "job/test_kill_resume.py::test_full_disk_keeps_the_previous_asset_and_resumes",
    "material/test_fit_lobe.py::test_noise_of_the_rays_does_not_draw_psi_anywhere",
    "material/test_fit_lobe.py::test_rays_too_few_for_a_lobe_are_not_taken_for_enough",
    "material/test_fit_lobe.py::test_the_lobe_comes_back_within_its_errors",
    "material/test_fit_lobe.py::test_what_the_rays_do_is_foretold",
    "nondestruction/test_damage.py::test_a_damaged_binary_layer_is_made_again",
    "nondestruction/test_edits.py::test_edits_hold_after_a_run_with_other_options",
    "nondestruction/test_edits.py::"
    "test_edits_that_cannot_be_read_change_nothing_of_what_is_measured",
)

# Tests of ten seconds and more that watch what seldom changes.
NIGHTLY = (
    "cluster/test_workers.py::"
    "test_without_its_scheduler_a_run_ends_in_a_sentence_and_goes_on_from_there",
    "cluster/test_workers.py::test_a_scheduler_that_is_started_anew_meanwhile_changes_no_byte",
    "dcc/test_nvidia.py::test_it_finds_nothing_in_any_variant_of_a_sound_asset",
    "faults/test_two_at_once.py::test_nobody_sees_half_a_run_and_an_artist_may_save",
    "faults/test_what_children_open.py::"
    "test_children_open_the_capture_and_their_own_libraries_alone",
    "job/test_first_run.py::test_what_a_run_needs_was_compiled",
    "material/test_fit_lobe.py::test_errors_that_frames_share_are_no_lobe",
    "material/test_fit_lobe.py::test_the_footprint_that_fits_is_the_one_that_is_used",
    "material/test_view_model.py::test_the_samples_tell_how_large_their_errors_are",
    "page/test_report.py::test_views_that_evaluate_made_are_taken",
    "physics/test_recovery.py::"
    "test_many_views_find_the_material_without_knowing_the_diffuse_radiance",
    "shading/test_denoise.py::test_the_filter_gives_its_memory_back",
    "test_docs.py::test_the_commands_of_tutorials_run",
    "test_scales.py::test_maps_and_summaries_do_not_know_how_large_the_scene_is",
)

# Tests of how children start, what they import and what they may open: they start fresh.
FRESH = ("faults/test_what_children_open.py", "job/test_child.py")

# Folders whose files share an asset that takes seconds to make: one process runs them all.
TOGETHER = ("evaluation", "nondestruction", "page")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow, and what is for the night; slow files first, of each kind those with the
    most tests."""
    here = Path(__file__).parent
    cases: Counter[str] = Counter()
    for item in items:
        name = f"{item.path.relative_to(here).as_posix()}::{item.name.partition('[')[0]}"
        if name in SWEEPS:
            if cases[name] % 3:
                item.add_marker(pytest.mark.nightly)
            cases[name] += 1
        if name in NIGHTLY:
            item.add_marker(pytest.mark.nightly)
        place = item.path.relative_to(here).as_posix()
        if any(place == slow or place.startswith(f"{slow}/") for slow in SLOW):
            item.add_marker(pytest.mark.slow)
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: ("slow" not in item.keywords, -tests[item.path], item.path))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than cores: a quarter of the time tests wait, for processes, sockets and disks."""
    return granted_cores() + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """As ``--dist loadfile``, but for what stays ``TOGETHER``."""
    from xdist.scheduler import LoadFileScheduling

    class OfFilesAndFolders(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = str(super()._split_scope(nodeid))
            folder = file.rpartition("/")[0]
            return folder if folder in {f"tests/{name}" for name in TOGETHER} else file

    return OfFilesAndFolders(config, log)


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    """Of BLAS, as in the work of a task, and of the kernels, but where a test is about their
    threads: the tests' processes share the cores already."""
    with threadpool_limits(limits=1, user_api="blas"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
        yield


@pytest.fixture(autouse=True, scope="session")
def _registration_remembered():
    """As it is asked by ``ingest``; the tests about it ask it themselves."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("lens_of_frames", "similarity_of_frames", "own_steps_of_frames"):
            patch.setattr(registration, name, remembered(getattr(registration, name)))
        yield


@pytest.fixture(autouse=True, scope="session")
def _not_flushed():
    """A disk takes milliseconds to flush each of the hundreds of files of an asset, and no test
    cuts the power of this one: those about flushing see what is asked of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)  # which refuses what is not open, too
        yield


@pytest.fixture(scope="session")
def _forking():
    children = Children()
    yield children
    children.end()


@pytest.fixture(autouse=True, scope="module")
def _children(_forking, request):
    """Forked, where a test is not about their start."""
    place = request.path.relative_to(Path(__file__).parent).as_posix()
    if place in FRESH or os.environ.get("USDBRDF_FRESH_CHILDREN") or sys.platform != "linux":
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(usdbrdf.job.child, "_started", _forking.started)
        yield


@pytest.fixture(autouse=True)
def _heard():
    """A command with -q silences the process."""
    yield
    set_quiet(False)


@pytest.fixture(scope="session")
def synthetic():
    """How ``built`` is made, for tests that need other assets."""
    return SimpleNamespace(make_scan=make_scan, build=build, box=box)


@pytest.fixture
def built(tmp_path):
    """A small asset with three objects: a box, a wall that nobody saw, and a lamp."""
    return build(tmp_path / "out" / "room", make_scan(tmp_path / "capture"))
