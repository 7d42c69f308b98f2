"""An arm that goes out of order in mid-episode: the others go on with what they can solve, and it is said what they cannot."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover import policies
from marl_handover.cell import load_cell
from marl_handover.cell.batch import LayoutPool
from marl_handover.cli import main
from marl_handover.config import LayoutConfig, OutageConfig, TaskConfig
from marl_handover.control.closed_loop import make_loop
from marl_handover.control.evaluation import AssessmentConfig, assess
from marl_handover.control.outage import Outage, OutageRun, policy_without
from marl_handover.learning.evaluation import Trace, random_problems
from marl_handover.policies import ResigningPolicy
from marl_handover.task.episode import begin, go_on, play
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problem_file import PosedProblems
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules


def posed(rules: Rules, count: int) -> PosedProblems:
    return PosedProblems(rules.cell, False, np.arange(count), *random_problems(rules, count, 0))


def check_episodes(run: OutageRun, trace: Trace, outcome: np.ndarray) -> None:
    """By the lines of the trace and another planner: who moved when, and what could be solved when the arm failed."""
    cell, (start, goal) = run.policy.rules.cell, run.problems
    struck, solvable = np.zeros(len(start), bool), np.zeros(len(start), bool)
    external = run.policy.rules.external_finish
    for number, (arm, after) in enumerate(zip(*run.outages, strict=True)):
        lines, name = trace.episodes.get(number, []), cell.labels[arm]
        assert [line["step"] for line in lines] == list(range(len(lines)))
        # A decision of architecture A is a transfer and, if an arm can finish then, the final one, too.
        finished = external and any(line["final"] for line in lines[after : after + 1])
        struck[number] = after == 0 or not (len(lines) < after or lines[after - 1]["outcome"] or finished)
        if struck[number]:
            assert all(name not in (line["arm"], line["previous_arm"]) for line in lines[after + 1 :])
            assert all(line["arm"] != name for line in lines[after:])
            pose = np.array(lines[after - 1]["next_state"]) if after else start[number]
            left = Rules(cell.with_arms([each for each in cell.names if each != cell.names[arm]]), run.policy.rules.config)
            needed = int(ExactPlanner(left).plan(pose, goal[number]).transfers)
            solvable[number] = 0 < needed <= left.config.max_steps - after
    solved = outcome == int(Outcome.SUCCESS)
    assert run.struck == (struck.sum(), solvable.sum(), (solvable & solved).sum())
    assert not (struck & ~solvable & solved).any()


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("name", ["paper", "triangle", "line4"])
@pytest.mark.parametrize("policy", ["exact", "greedy", "pretrained_any"])
def test_the_others_go_on(name, policy, architecture):
    """The exact policy solves all that can be solved; the arm that is out moves nothing any more."""
    supervisor = policies.load(policy, load_cell(name), TaskConfig(architecture=architecture))
    trace = Trace(supervisor.rules)
    run = OutageRun(supervisor, posed(supervisor.rules, 300), OutageConfig(), trace=trace)
    check_episodes(run, trace, run.evaluate().episodes.outcome)
    assert run.struck.episodes > 40
    if policy == "exact":
        assert run.struck.solved == run.struck.solvable
    if policy == "pretrained_any":
        assert run.struck.solved >= 0.95 * run.struck.solvable


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(3, 6), st.integers(0, 2), st.none() | st.integers(0, 3))
def test_the_exact_policy_solves_what_stays_solvable_in_any_cell(seed, arms, obstacles, after):
    layouts = LayoutConfig(arms=[arms, arms], obstacles=[obstacles, obstacles])
    cell = LayoutPool.random(layouts, 1, np.random.default_rng(seed)).cell(0)
    supervisor = policies.load("exact", cell)
    trace = Trace(supervisor.rules)
    run = OutageRun(supervisor, posed(supervisor.rules, 60), OutageConfig(after=after, seed=seed), trace=trace)
    check_episodes(run, trace, run.evaluate().episodes.outcome)
    assert run.struck.solved == run.struck.solvable


@pytest.mark.parametrize("name", ["paper", "triangle"])
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_an_interrupted_batch_goes_on_as_if_it_had_not_been(name, kind):
    rules = Rules(load_cell(name), TaskConfig())
    start, goal = (kind(each.numpy()) for each in sample_problems(rules.cell, 400, torch.Generator().manual_seed(1)))
    planner = ExactPlanner(rules)
    act = lambda pose, goal, previous: planner.act(pose, goal)  # noqa: E731
    whole = play(rules, act, start, goal)
    episodes, seen = begin(start, goal), []
    for until in ([1] * 400, [2] * 400, range(400), [30] * 400):
        for rows in (np.arange(400) % 2 == 0, np.arange(400) % 2 == 1):
            episodes = go_on(rules, act, episodes, observer=seen.append, rows=kind(rows), until=kind(np.array(until)))
            running = np.asarray(episodes.outcome) == int(Outcome.NONE)
            assert (np.asarray(episodes.transfers)[running & rows] >= np.array(until)[running & rows]).all()
    for one, other in zip(whole, episodes[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)  # torch rounds a row by where it is in a batch
    assert sum(len(decision.episode) for decision in seen) == int(whole.transfers.sum())


def test_a_policy_resigns_only_where_nobody_can_solve_it():
    cell = load_cell("line4").with_arms(["first", "second", "fourth"])
    rules = Rules(cell, TaskConfig())
    start, goal = random_problems(rules, 500, 0)
    previous, solvable = np.full(500, -1), ExactPlanner(rules).plan(start, goal).transfers > 0
    assert 100 < solvable.sum() < 400
    for inner in (policies.load("exact", cell), policies.load("greedy", cell), policies.load("shielded:greedy", cell)):
        resigning = ResigningPolicy(inner)
        action = resigning.act(start, goal, previous)
        np.testing.assert_array_equal(action[solvable], inner.act(start, goal, previous)[solvable])
        np.testing.assert_array_equal(np.isnan(action).all(-1), ~solvable)
        np.testing.assert_array_equal(resigning.act(start[0], goal[0], previous[0]), action[0])
        for row in range(20):
            assert bool(resigning.unsolvable_because(start[row], goal[row])) != solvable[row]
        assert (resigning.name, resigning.any_cell) == (inner.name, True)
        other = resigning.under(Rules(load_cell("triangle").with_arms(["west"]), TaskConfig()))
        assert other.rules.cell.names == ("west",)


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("name", ["paper", "triangle"])
def test_the_loop_does_what_the_batch_does(name, architecture):
    """Exact arms, one problem after the other, beside the same problems at once."""
    supervisor = policies.load("exact", load_cell(name), TaskConfig(architecture=architecture))
    problems = posed(supervisor.rules, 20)
    run = OutageRun(supervisor, problems, OutageConfig(seed=1))
    expected = run.evaluate().episodes
    said = 0
    with make_loop(supervisor, "kinematic") as loop:
        for row, (start, goal) in enumerate(zip(*run.problems, strict=True)):
            outage = Outage(int(run.outages.arm[row]), int(run.outages.after[row]))
            episode = loop.play(start, goal, outage=outage)
            assert episode.outcome == expected.outcome[row]
            if episode.lost_at is not None:
                after = episode.transfers[episode.lost_at :]
                assert all(each.command.arm != outage.arm for each in after if each.result.refusal is None)
            if episode.ended == "unreachable":
                said += 1
                assert "the goal cannot be reached any more, with" in episode.transfers[-1].result.detail
                assert episode.outcome is Outcome.TIMEOUT
            else:
                assert len(episode.transfers) == expected.transfers[row]
                np.testing.assert_allclose(episode.transfers[-1].result.pose, expected.pose[row], atol=1e-6)
    assert said == run.struck.episodes - run.struck.solvable


def test_the_loop_tells_the_arms_that_are_left_by_their_places_in_the_whole_cell():
    cell = load_cell("paper")
    right = policies.adapted("exact", cell.with_arms(["right"]).config)
    start, goal = (poses.numpy() for poses in sample_problems(right.rules.cell, 300, torch.Generator().manual_seed(0)))
    solvable = ExactPlanner(right.rules).plan(start, goal).transfers > 0
    with make_loop(right, "kinematic") as loop:
        assert loop.planner.model.cell.num_arms == loop.rules.cell.num_arms == 2
        for row in [*np.flatnonzero(solvable)[:2], *np.flatnonzero(~solvable)[:2]]:
            episode = loop.play(start[row], goal[row])
            assert episode.ended == ("success" if solvable[row] else "unreachable")
            assert not solvable[row] or [transfer.command.arm for transfer in episode.transfers] == [1]


def test_evaluate_reports_what_stayed_solvable(tmp_path, capsys):
    report, trace = tmp_path / "report.json", tmp_path / "trace.jsonl"
    assert main(["evaluate", "cell=triangle", "episodes=2000", "outage.arm=east", "outage.seed=3", f"json={report}", f"trace={trace}"]) == 0
    written = json.loads(report.read_text())
    outage = written["outage"]
    assert (outage["arm"], outage["after"], outage["seed"]) == ("east", None, 3)
    assert outage["solved"] == outage["solvable"] > 1000
    assert outage["unreachable"] == outage["episodes"] - outage["solvable"] == written["outcomes"]["timeout"]
    assert f"the goals of the other {outage['unreachable']} cannot be reached any more" in capsys.readouterr().out
    assert {"north", "west", "east"} == {json.loads(line)["arm"] for line in trace.read_text().splitlines()}


def test_problems_bring_their_cells(tmp_path):
    """Each fails an arm of its own cell, whatever stands around it in the file."""
    pool = LayoutPool.random(LayoutConfig(arms=[3, 5], obstacles=[0, 1]), 6, np.random.default_rng(0))
    lines = []
    for number in range(30):
        cell = pool.cell(number % 6)
        start, goal = (poses.numpy()[0].tolist() for poses in sample_problems(cell, 1, torch.Generator().manual_seed(number)))
        arms = [
            {"name": arm.name, "x_mm": arm.base.x_mm, "y_mm": arm.base.y_mm, "facing_rad": arm.base.facing_rad}
            | {"r_min_mm": arm.r_min_mm, "r_max_mm": arm.r_max_mm, "yaw_range_rad": list(arm.yaw_rad)}
            for arm in cell.arms
        ]
        discs = [{"x_mm": each.x_mm, "y_mm": each.y_mm, "radius_mm": each.radius_mm} for each in cell.config.obstacles]
        lines.append(json.dumps({"state": start, "goal": goal, "arms": arms, "obstacles": discs}) + "\n")
    file, single = tmp_path / "problems.jsonl", tmp_path / "single.jsonl"
    file.write_text("".join(lines))
    done = assess(AssessmentConfig(problems=str(file), outage=OutageConfig()))
    outage = done.report["outage"]
    assert outage["solved"] == outage["solvable"] > 5
    assert outage["episodes"] > 20
    parts = []
    for first in (0, 15):
        single.write_text("".join(lines[first : first + 15]))
        parts.append(assess(AssessmentConfig(problems=str(single), outage=OutageConfig(arm="a1", after=1))).report["outage"])
    together = assess(AssessmentConfig(problems=str(file), outage=OutageConfig(arm="a1", after=1))).report["outage"]
    assert [sum(part[key] for part in parts) for key in ("episodes", "solvable")] == [together["episodes"], together["solvable"]]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["outage.arm=top"], "'top' is not known; choose one of: left, right, random"),
        (["outage.after=-1"], "outage.after = -1"),
        (["policy=pretrained_b", "outage.arm=left"], "must be one that acts in any cell under an outage"),
        (["outage.arm=left", "arms.enabled=[left]"], "left out in a cell with one arm that is in order"),
        (["outage.arm=left", "arms.enabled=[right]"], "'left' is not known; choose one of: right, random"),
        (["outage.seed=1", "task.reward.motion_weight=1"], "no lengths of paths are known without it"),
        (["policy=greedy", "backend=noisy", "outage.arm=top"], "'top' is not known"),
        (["policy=exact", "cell=triangle", "backend=twin"], "must be wiring of the cell's arms, north, west, east, each by its name"),
        (["policy=pretrained_b", "backend=noisy", "outage.seed=1"], "must be one that acts in any cell"),
    ],
)
def test_an_outage_that_cannot_be_is_told_in_one_line(words, said, capsys):
    assert main(["evaluate", "episodes=5", *words]) == 2
    line = capsys.readouterr().err.strip()
    assert said in line
    assert "\n" not in line
    assert len(line) <= 300


def test_an_arm_that_fails_is_one_of_the_policys_cell():
    supervisor = policies.load("exact", load_cell("triangle").with_arms(["north", "east"]))
    assert policy_without(supervisor, 0).rules.cell.names == ("east",)
