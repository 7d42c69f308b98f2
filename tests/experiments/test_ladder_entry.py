"""Entries of the ladder: an honest one comes out again, and what was changed in a report or a trace is found."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from marl_handover.cli import main
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.experiments.ladder_entry import UnfitEntry, check_entry
from marl_handover.task.ladder import rung

ROOT = Path(__file__).resolve().parents[2]
ENTRIES = {"pair": "pretrained_b", "triangle": "greedy", "pair_noisy": "exact", "scattered8": "random"}


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    folder = tmp_path_factory.mktemp("entry")
    for name, policy in ENTRIES.items():
        files = [f"json={folder / name}.json", f"trace={folder / name}.jsonl"]
        assert main(["evaluate", f"ladder={name}", f"policy={policy}", *files, "progress=false"]) == 0
    return folder


@pytest.mark.parametrize("name", ENTRIES)
def test_an_honest_entry_comes_out_again(name, entries):
    report = json.loads((entries / f"{name}.json").read_text())
    found = check_entry(entries / f"{name}.json", entries / f"{name}.jsonl")
    assert len(found.regret) == len(rung(name).fixed.optimum)
    assert found.regret.mean() == pytest.approx(report["regret"])
    assert found.solved.mean() == report["success_rate"]
    if name != "pair_noisy":
        assert (found.regret >= 0).all()


def changed(entries, folder, name, change, report=None):
    """Copies of an entry's files: ``change`` takes the trace's lines and may change them in place, or gives others."""
    lines = [json.loads(line) for line in (entries / f"{name}.jsonl").read_text().splitlines()]
    lines = change(lines) or lines
    (folder / "trace.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    content = json.loads((entries / f"{name}.json").read_text()) | (report or {})
    (folder / "report.json").write_text(json.dumps(content))
    return folder / "report.json", folder / "trace.jsonl"


def shorter(lines):
    """An episode without its last line: it was given up."""
    last = max(index for index, line in enumerate(lines) if line["outcome"] == "success")
    return [*lines[:last], *lines[last + 1 :]]


def moved(lines):
    lines[0]["next_state"][0] += 0.01


def turned(lines):
    lines[0]["next_state"][2] += 1e-4


def started_elsewhere(lines):
    lines[0]["state"][1] += 1.0


def aimed_elsewhere(lines):
    lines[0]["goal"][2] += 0.1


def other_place(lines):
    first = next(line for line in lines if not line["final"])
    first["alpha"] = -first["alpha"] + 0.1


def other_arm(lines):
    lines[0]["arm"] = "R" if lines[0]["arm"] == "L" else "L"


def gone_on(lines):
    last = next(index for index, line in enumerate(lines) if line["outcome"])
    return [*lines[: last + 1], lines[last] | {"step": lines[last]["step"] + 1}, *lines[last + 1 :]]


@pytest.mark.parametrize("change", [shorter, moved, turned, started_elsewhere, aimed_elsewhere, other_place, other_arm, gone_on])
def test_what_was_changed_in_a_trace_is_found(change, entries, tmp_path):
    with pytest.raises(UnfitEntry):
        check_entry(*changed(entries, tmp_path, "pair", change))


def test_noise_excuses_what_it_can_make(entries, tmp_path):
    def beside(by_mm):
        def change(lines):
            ends = [line for line in lines if line["outcome"] == "success"]
            line = max(ends, key=lambda line: -np.hypot(line["next_state"][0] - line["goal"][0], line["next_state"][1] - line["goal"][1]))
            line["next_state"][0] = line["goal"][0] + by_mm

        return change

    check_entry(*changed(entries, tmp_path, "pair_noisy", beside(3.0)))
    with pytest.raises(UnfitEntry, match="beside where its command"):
        check_entry(*changed(entries, tmp_path, "pair_noisy", beside(6.5)))


@pytest.mark.parametrize(
    ("report", "told"),
    [
        ({"regret": 0.0}, "regret = 0.0, but the trace has"),
        ({"success_rate": 0.5}, "success_rate = 0.5"),
        ({"architecture": "A"}, "architecture A"),
        ({"episodes": 10}, "number of problems 10"),
        ({"ladder": {"rung": "pair", "sha256": "0" * 64}}, "problems of the SHA-256 000"),
    ],
)
def test_what_a_report_says_otherwise_is_found(report, told, entries, tmp_path):
    with pytest.raises(UnfitEntry, match=told):
        check_entry(*changed(entries, tmp_path, "pair", lambda lines: None, report))


def test_files_that_are_none_are_named(entries, tmp_path):
    report, trace = changed(entries, tmp_path, "pair", lambda lines: lines[1:])
    with pytest.raises(CorruptFile, match=r"line 1: episode 0, step 1 is no next step"):
        check_entry(report, trace)
    with pytest.raises(MissingFile):
        check_entry(report, tmp_path / "none.jsonl")
    report.write_text("{}")
    with pytest.raises(CorruptFile, match="none of evaluate ladder=RUNG"):
        check_entry(report, trace)
    report, trace = changed(entries, tmp_path, "triangle", lambda lines: lines[0].update(arm="south"))
    with pytest.raises(CorruptFile, match="episode 0, step 0 is no command"):
        check_entry(report, trace)


def test_the_script_checks_a_folder(entries, tmp_path):
    script = [sys.executable, str(ROOT / "scripts/check_ladder_entry.py")]
    done = subprocess.run([*script, str(entries)], capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == len(ENTRIES)
    assert "pair.json: 1,000 problems replayed, regret 0.0" in done.stdout
    done = subprocess.run([*script, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "report not found" in done.stderr
