"""Random cells in a suite: by the number of arms stands what the runs say; runs that were trained elsewhere are taken if they fit."""

from __future__ import annotations

import json
import math
import shutil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cli import main
from marl_handover.errors import CorruptFile
from marl_handover.experiments.statistics import mean_interval, share_interval
from marl_handover.experiments.suite import load_suite
from marl_handover.experiments.tables import make_tables
from marl_handover.learning.evaluation import wilson_interval

SUITE = """
seeds: 2
rows: [{name: exact, policy: exact}, {name: greedy, policy: greedy}]
evaluations:
  - {name: few, arguments: ["layouts.arms=[2,3]", layouts.count=6, episodes=40]}
  - {name: more, arguments: ["layouts.arms=[4,4]", layouts.count=3, episodes=20]}
  - {name: one, arguments: [episodes=20]}
  - {name: outage, arguments: ["layouts.arms=[3,4]", layouts.count=4, episodes=20, outage.arm=random]}
figures: [{name: growth, kind: arms, evaluations: [few, more]}]
tables: [{name: by_arms, kind: arms, evaluations: [few, more]}, {name: outage, kind: outage}]
"""
TINY = (
    "compile=off steps=512 num_envs=16 evaluation_interval=256 evaluation_episodes=20 checkpoint_interval=512 "
    "algorithm.learning_starts=200 algorithm.batch_size=16 algorithm.actor_hidden=[16] algorithm.critic_hidden=[16]"
)


def compared(folder, text, *arguments, status=0):
    (folder / "mine.yaml").write_text(text)
    command = ["compare", f"suite={folder / 'mine.yaml'}", f"out={folder / 'out'}", "jobs=1", "progress=false", *arguments]
    assert main(command) == status
    return json.loads((folder / "out/results.json").read_text()) if status == 0 else None


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("suite")
    return compared(folder, SUITE), folder / "out"


def test_what_stands_by_the_number_of_arms_is_what_the_runs_say(results):
    content, out = results
    for row in content["rows"]:
        assert set(row["by_arms"]) == {"few", "more", "outage"}
        for name, found in ((name, row["by_arms"][name]) for name in ("few", "more")):
            reports = [json.loads((out / row["name"] / f"seed{seed}/{name}.json").read_text()) for seed in (0, 1)]
            assert sum(part["episodes"] for part in found.values()) == sum(report["episodes"] for report in reports)
            for arms, part in found.items():
                shares = [report["by_arms"][arms]["success_rate"] for report in reports if arms in report["by_arms"]]
                assert part["success_rate"]["value"] == pytest.approx(sum(shares) / len(shares))
                if row["name"] == "exact":
                    assert part["success_rate"]["value"] == part["steps_ratio"]["value"] == 1.0
                    assert part["success_rate"]["low"] < 1.0


def test_the_table_and_the_figure_have_every_number_of_arms(results):
    content, out = results
    table = make_tables(content)[0]
    assert [cells[0].text for cells in table.rows] == ["2", "2", "3", "3", "4", "4"]
    assert {cells[1].text for cells in table.rows} == {"exact", "greedy"}
    assert (out / "figures/growth.png").is_file()
    assert content["empty_figures"] == []


def test_the_table_of_outages_tells_of_those_that_stayed_solvable(results):
    content, out = results
    for row, cells in zip(content["rows"], make_tables(content)[1].rows, strict=True):
        parts = [json.loads((out / row["name"] / f"seed{seed}/outage.json").read_text())["outage"] for seed in (0, 1)]
        assert [cell.values[0] for cell in cells[3:5]] == [sum(part[key] for part in parts) for key in ("episodes", "solvable")]
        assert cells[5].values[0] == pytest.approx(sum(part["solved_share"] for part in parts) / 2)
    assert content["rows"][0]["outages"]["outage"]["solved_share"]["value"] == 1.0


@pytest.mark.slow
def test_the_same_seeds_make_the_same_table(results, tmp_path):
    def timeless(table):
        return [[cell.text for cell in cells[:-1]] for cells in table.rows]

    assert timeless(make_tables(compared(tmp_path, SUITE))[0]) == timeless(make_tables(results[0])[0])


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (("kind: arms, evaluations: [few, more]}]\ntables", "kind: arms}]\ntables"), "the kind arms names some in random cells: few, more"),
        (("{name: by_arms, kind: arms, evaluations: [few, more]}", "{name: t, kind: arms, evaluations: [one]}"), "few"),
    ],
)
def test_evaluations_of_one_cell_have_no_place_there(tmp_path, broken, words):
    (tmp_path / "mine.yaml").write_text(SUITE.replace(*broken))
    with pytest.raises(CorruptFile, match=words):
        load_suite(str(tmp_path / "mine.yaml"))


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(50, 60)), min_size=1, max_size=6))
def test_the_interval_of_a_share_holds_the_mean_and_what_all_episodes_tell(runs):
    shares, episodes = [solved / count for solved, count in runs], [count for _, count in runs]
    found = share_interval(shares, episodes)
    assert 0.0 <= found.low <= found.value <= found.high <= 1.0
    low, high = wilson_interval(sum(solved for solved, _ in runs), sum(episodes))
    assert found.low <= low + 1e-12
    assert found.high >= high - 1e-12


def test_students_interval_by_hand():
    found = mean_interval([1.0, 2.0, 3.0])
    half = 4.302653 / math.sqrt(3)  # the 97.5th percentile with two degrees of freedom, a deviation of 1
    assert (found.low, found.value, found.high) == pytest.approx((2 - half, 2.0, 2 + half))
    assert mean_interval([5.0]) == (5.0, None, None)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with one finished run."""
    folder = tmp_path_factory.mktemp("trained")
    assert main(["train", *TINY.split(), "progress=false", f"out={folder / 'first'}"]) == 0
    return folder


MINE = f"""
seeds: 1
train: [{", ".join(repr(argument) for argument in TINY.split())}]
rows: [{{name: mine, train: []}}, {{name: other, train: [replay.symmetry=true]}}]
evaluations: [{{name: kinematic, arguments: [episodes=20]}}]
"""


def test_a_run_that_was_trained_elsewhere_is_taken_and_judged(trained, tmp_path):
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    content = compared(tmp_path, MINE, "rows=[mine]", f"trained.mine={trained}")
    (row,) = content["rows"]
    assert row["runs"][0]["trained"]["step"] == json.loads((trained / "first/summary.json").read_text())["step"]
    assert row["evaluations"]["kinematic"]["runs"] == 1
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before
    checkpoint = tmp_path / "out/mine/seed0/run/checkpoint.pt"
    assert checkpoint.read_bytes() == (trained / "first/checkpoint.pt").read_bytes()
    written = checkpoint.stat().st_mtime_ns
    compared(tmp_path, MINE, "rows=[mine]", f"trained.mine={trained}")
    assert checkpoint.stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["rows=[other]", "trained.other={folder}"], "first has replay.symmetry = False, not True"),
        (["rows=[mine]", "seeds=2", "trained.mine={folder}"], "finished run for mine/seed1 not found: {folder}; train seed=1 there first"),
        (["rows=[mine]", "trained.mine={folder}/none"], "folder of run directories not found"),
        (["rows=[mine]", "trained.other={folder}"], "trained = 'other' is not known; choose one of: mine"),
    ],
)
def test_a_run_that_does_not_fit_is_not_taken(trained, tmp_path, capsys, arguments, words):
    compared(tmp_path, MINE, *(argument.format(folder=trained) for argument in arguments), status=2)
    assert words.format(folder=trained) in capsys.readouterr().err


def test_an_unfinished_run_is_not_taken(trained, tmp_path, capsys):
    shutil.copytree(trained, tmp_path / "runs")
    (tmp_path / "runs/first/summary.json").unlink()
    compared(tmp_path, MINE, "rows=[mine]", f"trained.mine={tmp_path / 'runs'}", status=2)
    assert "finished run for mine/seed0 not found" in capsys.readouterr().err
