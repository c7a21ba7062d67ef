"""What `benchmarks/crash_campaign.py` and `mutation_score.py` count, and as what."""

from __future__ import annotations

import json
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import crash_campaign
import crash_cases
import mutation_score
from crash_cases import Campaign, Results, Series, Start
from mutation_score import Copy, Mutation, is_decided

ADDED = Mutation("usdbrdf/files/sums.py", 1, 4, "operator", 4, "a + b", "(a - b)")


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Copy:
    monkeypatch.setattr(mutation_score, "ROOT", tmp_path / "none")
    for folder in ("none", "work/repository/usdbrdf/files", "work/repository/tests/files"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.setattr(mutation_score.subprocess, "run", lambda *_, **__: Listed)
    made = Copy(tmp_path / "work")
    (made.root / ADDED.file).write_text("c = a + b\n")
    return made


class Listed:
    """No file that git keeps."""

    stdout = b""


def ending(monkeypatch: pytest.MonkeyPatch, *statuses: int | str) -> list[Sequence[str]]:
    """Have the tests end so, one run after the other; the files that each ran."""
    left, ran = list(statuses), list[Sequence[str]]()

    def tested(_: Copy, files: Sequence[str]) -> tuple[int | str, str]:
        ran.append(files)
        return left.pop(0), "what they said"

    monkeypatch.setattr(Copy, "tested", tested)
    return ran


@pytest.mark.parametrize("status", [0, 1, 2, "hangs", 3, 4, 5, -9, -11, "undecided"])
def test_only_a_test_that_fails_an_import_or_a_hang_finds_a_mutation(copy, monkeypatch, status):
    ending(monkeypatch, status)
    result = copy.tried(ADDED)
    assert result["found"] == (status in (1, 2, "hangs"))
    assert is_decided(result) == (status in (0, 1, 2, "hangs"))


def test_a_room_whose_tests_fail_already_is_not_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Copy, "__init__", lambda self, folder: setattr(self, "root", tmp_path))
    monkeypatch.setattr(Copy, "tried", lambda *_: pytest.fail("tried"))
    for folder in mutation_score.ROOMS["files"]:
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "test_a.py").touch()
    ran = ending(monkeypatch, 1)
    with pytest.raises(SystemExit, match=r"files: without any mutation .+ 1: what they said"):
        mutation_score.main(["--rooms", "files", "--mutations", "2"])
    assert ran == [["tests/files/test_a.py"]]


def test_what_was_tried_beside_what_is_drawn_does_not_count(monkeypatch, tmp_path, capsys):
    every = mutation_score.all_mutations(mutation_score.ROOT, ["files"])
    other = {"mutation": "usdbrdf/files/no.py:1:1+1:unary", "found": True, "status": 1}
    killed = {"mutation": every[0].name, "found": True, "status": -9}
    known = [{"mutation": each.name, "found": False, "status": 0} for each in every[1:]]
    file = tmp_path / "results"
    file.write_text("".join(json.dumps(each) + "\n" for each in (other, killed, *known)))
    monkeypatch.setattr(Copy, "__init__", lambda *_: None)
    monkeypatch.setattr(Copy, "refuse_failing", lambda *_: None)
    tried = []

    def tries(_: Copy, mutation: Mutation) -> dict[str, object]:
        tried.append(mutation)
        return {
            "mutation": mutation.name, "found": True, "status": 1, "said": "", "seconds": 0,
        }  # fmt: skip

    monkeypatch.setattr(Copy, "tried", tries)
    mutation_score.main(["--rooms", "files", "--mutations", str(len(every)), "--json", str(file)])
    assert tried == [every[0]], "the machine had ended its tests"
    assert f"all           1 of {len(every):>4} found" in capsys.readouterr().out


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Campaign:
    """One without a capture, that keeps its results in a file."""
    monkeypatch.setattr(crash_cases, "in_fork", lambda _: 0)
    (tmp_path / "room").mkdir()
    return Campaign(tmp_path, Results(tmp_path / "results"))


def killed(campaign: Campaign) -> Series:
    start = Start("fit", False, campaign.work / "room", calls=Counter(write=40))
    return Series(start, "kill", (0, 0))


@pytest.mark.parametrize("status", [0, 1, 4])
def test_a_step_that_fails_before_it_is_disturbed_is_a_problem(campaign, status):
    case = campaign.work / "case"
    case.mkdir()
    (case / "said").write_text("why")
    campaign.ended(killed(campaign), 0, "", case, status)
    assert case.exists() == (status != 0)
    problems = campaign.results.tally().get(("fit", "kill"), [])
    assert [(f"with {status} why" in problem) for problem in problems] == [True] * (status != 0)


def test_a_run_that_found_no_time_before_it_was_disturbed_is_tried_again(campaign, capsys):
    case = campaign.work / "case"
    case.mkdir()
    campaign.ended(killed(campaign), 0, "", case, -signal.SIGALRM)
    assert campaign.waiting(killed(campaign), 1) == [0]
    assert not case.exists()
    assert "undecided" in capsys.readouterr().out


def test_a_campaign_goes_on_where_it_was_stopped(campaign, monkeypatch):
    file, series = campaign.work / "results", killed(campaign)
    for case, problem in ((0, ""), (1, None), (3, "other bytes")):
        campaign.results.note(series, case, problem)
    file.write_text(file.read_text() + '{"case": "fit first, ki')  # stopped while it wrote
    again = Campaign(campaign.work, Results(file))
    assert again.waiting(series, 6) == [2, 4, 5]
    assert again.waiting(Series(series.start, "kill", (0, 1)), 2) == [0, 1]
    assert again.results.tally() == {("fit", "kill"): ["", "other bytes"]}
    again.results.note(series, 2, "")
    assert Campaign(campaign.work, Results(file)).waiting(series, 4) == []
    monkeypatch.setattr(crash_cases, "tasks_identity", lambda: "other sources")
    assert Campaign(campaign.work, Results(file)).waiting(series, 2) == [0, 1]


def test_places_are_the_same_in_each_process_and_others_in_each_round(campaign):
    series = killed(campaign)
    places = crash_campaign.spread(series, ("write", "sync"), 6)
    assert len(places) == 6
    assert places == crash_campaign.spread(killed(campaign), ("write", "sync"), 6)
    for seed in ((0, 1), (1, 0)):
        assert places != crash_campaign.spread(Series(series.start, "kill", seed), ("write",), 6)
