"""``marl-handover evaluate``: its JSON, its trace, its problems file, its errors."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cell import load_cell
from marl_handover.cli import main
from marl_handover.compose import compose
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.learning import evaluation
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.motion.path_length_table import cache_file, path_length_table, settings_key
from marl_handover.task.rules import Rules

FIELDS = {
    *("policy", "architecture", "variant", "backend", "epsilon_deg", "seed", "episodes", "success_rate", "success_ci95", "mean_steps"),
    *("mean_steps_success", "optimal_mean_steps", "steps_ratio", "outcomes", "decision_us", "wall_s"),
}
TRACE_FIELDS = {
    *("episode", "step", "state", "goal", "previous_arm", "arm", "final", "place", "alpha", "beta", "next_state", "reward"),
    *("terminated", "truncated", "outcome", "epsilon_rad"),
    *("symmetry_order", "architecture"),  # which the promise leaves room for
}
OUTCOMES = {"success", "wrong_orientation", "wrong_position", "timeout"}


def strict(text):
    """JSON as the standard has it: no NaN."""
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def evaluated(folder, *arguments):
    """The result and the trace of a command that must succeed."""
    result, trace = folder / "result.json", folder / "trace.jsonl"
    assert main(["evaluate", "progress=false", f"json={result}", f"trace={trace}", *arguments]) == 0
    return strict(result.read_text()), [strict(line) for line in trace.read_text().splitlines()]


@pytest.fixture(scope="module")
def run_b(tmp_path_factory):
    """A run directory of an untrained supervisor of architecture B."""
    folder = tmp_path_factory.mktemp("run")
    config = compose(TrainConfig, ["algorithm.actor_hidden=[16]", "compile=off"], groups={"algorithm": ALGORITHMS})
    Trainer(config, folder).save()
    return folder


@pytest.mark.parametrize(
    ("policy", "architecture"), [("RUN", "B"), *((name, kind) for name in ("exact", "greedy", "random") for kind in "AB")]
)
def test_result_has_the_promised_fields(tmp_path, run_b, policy, architecture):
    name = str(run_b) if policy == "RUN" else policy
    result, _ = evaluated(tmp_path, f"policy={name}", "episodes=120", f"architecture={architecture}", "epsilon_deg=8", "seed=3")
    assert set(result) == FIELDS | {"symmetry_order", "path_mm", "executor_path_mm"}  # which the promise leaves room for
    asked = {"policy": name, "architecture": architecture, "variant": "hierarchical", "backend": "kinematic", "epsilon_deg": 8.0, "seed": 3}
    assert {key: result[key] for key in asked} == asked
    assert set(result["outcomes"]) == OUTCOMES
    assert sum(result["outcomes"].values()) == result["episodes"] == 120
    assert result["success_rate"] == result["outcomes"]["success"] / 120
    low, high = result["success_ci95"]
    assert 0 <= low <= result["success_rate"] <= high + 1e-12 <= 1 + 1e-12
    assert 1 <= result["optimal_mean_steps"] <= 20
    assert 1 <= result["mean_steps"] <= 20
    assert 0 < result["decision_us"]["p50"] <= result["decision_us"]["p99"]
    assert result["wall_s"] > 0
    if policy == "exact":
        assert (result["success_rate"], result["steps_ratio"]) == (1.0, 1.0)
        assert result["mean_steps"] == result["mean_steps_success"] == result["optimal_mean_steps"]
    if result["outcomes"]["success"]:
        assert result["steps_ratio"] >= 1
    else:
        assert result["steps_ratio"] is result["mean_steps_success"] is None


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(8, 10, 0.490162, 0.943318), (0, 10, 0.0, 0.277533), (50, 50, 0.928652, 1.0), (1, 2, 0.094531, 0.905469)],
)
def test_wilson_interval(successes, trials, low, high):
    assert evaluation.wilson_interval(successes, trials) == pytest.approx((low, high), abs=2e-6)


def action_of(line):
    return np.array([1.0 if line["final"] else -1.0, 1.0 if line["arm"] == "R" else -1.0, line["alpha"], line["beta"]])


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("policy", ["exact", "greedy", "random"])
def test_trace_is_what_the_rules_say(tmp_path, policy, architecture, assert_same_angle):
    arguments = (f"policy={policy}", "episodes=150", "epsilon_deg=20", f"architecture={architecture}")
    result, lines = evaluated(tmp_path, *arguments)
    rules = Rules(load_cell(), TaskConfig(architecture="B", epsilon_deg=20.0))  # B executes A's external transfers too
    episodes = [[line for line in lines if line["episode"] == number] for number in range(150)]
    assert sum(map(len, episodes)) == len(lines) == round(result["mean_steps"] * 150)
    ends = []
    for episode in episodes:
        assert [line["step"] for line in episode] == list(range(len(episode)))
        assert episode[0]["previous_arm"] is None
        for index, line in enumerate(episode):
            assert set(line) == TRACE_FIELDS
            assert line["epsilon_rad"] == pytest.approx(math.radians(20))
            state, goal = np.array(line["state"]), np.array(line["goal"])
            truth = rules.step(state, goal, np.int64(-1), action_of(line))
            np.testing.assert_allclose(truth.pose[:2], line["next_state"][:2], atol=1e-6)
            assert_same_angle(truth.pose[2], line["next_state"][2])
            if line["final"]:
                assert line["place"] == line["goal"][:2]
            else:
                np.testing.assert_allclose(rules.cell.chart.to_table(line["alpha"], line["beta"]), line["place"], atol=1e-6)
            last = index == len(episode) - 1
            assert (line["terminated"] != line["truncated"]) is last
            assert (line["outcome"] in OUTCOMES) is last
            if architecture == "B":
                assert line["reward"] == float(truth.reward)
            else:
                solved = (last and line["terminated"]) or (not last and episode[index + 1]["final"])
                assert line["reward"] == (0.0 if solved else -1.0)
                assert line["final"] == (last and line["terminated"])
            if not last:
                following = episode[index + 1]
                assert following["state"] == line["next_state"]
                assert following["goal"] == line["goal"]
                assert following["previous_arm"] == (line["arm"] if bool(truth.feasible) else line["previous_arm"])
        assert episode[-1]["truncated"] == (episode[-1]["outcome"] == "timeout")
        ends.append(episode[-1]["outcome"])
    assert {kind: ends.count(kind) for kind in OUTCOMES} == result["outcomes"]


def problem_lines(count, seed=1):
    rules = Rules(load_cell(), TaskConfig())
    start, goal = evaluation.random_problems(rules, count, seed)
    return [json.dumps({"state": s.tolist(), "goal": g.tolist()}) for s, g in zip(start, goal, strict=True)]


def test_problems_file_replaces_random_problems_in_order(tmp_path):
    lines = problem_lines(7)
    (tmp_path / "problems.jsonl").write_text("\n".join([*lines[:3], "", *lines[3:]]))
    result, trace = evaluated(tmp_path, "episodes=100", f"problems={tmp_path / 'problems.jsonl'}")
    assert result["episodes"] == 7
    firsts = [line for line in trace if line["step"] == 0]
    for line, text in zip(firsts, lines, strict=True):
        problem = json.loads(text)
        np.testing.assert_allclose(line["state"], problem["state"])
        np.testing.assert_allclose(line["goal"], problem["goal"])


def test_other_seeds_are_other_problems(tmp_path):
    traces = [evaluated(tmp_path, "episodes=5", f"seed={seed}")[1] for seed in (0, 0, 1)]
    assert traces[0] == traces[1]
    assert traces[0][0]["state"] != traces[2][0]["state"]


@pytest.mark.parametrize("chunk", [7, 100])
def test_chunks_do_not_change_results(monkeypatch, chunk):
    policy = policies.adapted("greedy", architecture="B")
    problems = evaluation.random_problems(policy.rules, 1100, 0)
    seen = {}
    for size in (1000, chunk):
        monkeypatch.setattr(evaluation, "CHUNK", size)
        watched = []
        part = tuple(poses[:350] for poses in problems) if size == 7 else problems
        result = evaluation.evaluate(policy.rules, policy.act, part, observer=lambda d, watched=watched: watched.extend(d.episode.tolist()))
        seen[size] = result, sorted(watched)
    (whole, whole_seen), (parts, parts_seen) = seen[1000], seen[chunk]
    count = len(parts.optimal)
    for field in ("outcome", "transfers", "pose"):
        np.testing.assert_array_equal(getattr(parts.episodes, field), getattr(whole.episodes, field)[:count])
    assert parts_seen == [number for number in whole_seen if number < count]


def test_a_result_without_any_solvable_problem_is_still_json(tmp_path):
    problem = {"state": [200.0, 150.0, 0.0], "goal": [200.0, -150.0, 0.0]}
    (tmp_path / "problems.jsonl").write_text(json.dumps(problem))
    result, _ = evaluated(tmp_path, f"problems={tmp_path / 'problems.jsonl'}", "task.max_steps=1", "policy=greedy")
    assert result["optimal_mean_steps"] is result["steps_ratio"] is None


BAD_FILES = {
    "nan.jsonl": (b'{"state": [0, 0, NaN], "goal": [0, 0, 0]}', "line 1"),
    "outside.jsonl": (b'{"state": [0, 0, 0], "goal": [0, 0, 0]}\n{"state": [0, 0, 0], "goal": [900, 0, 0]}', "line 2"),
    "broken.jsonl": (b'{"state": [0, 0, 0], "goal": [0, 0, 0]}\n\n{"state": [0, 0', "line 3"),
    "short.jsonl": (b'{"state": [0, 0], "goal": [0, 0, 0]}', "line 1"),
    "keyless.jsonl": (b'{"state": [0, 0, 0]}', "line 1"),
    "list.jsonl": (b"[1, 2, 3]", "line 1"),
    "words.jsonl": (b'{"state": ["a", "b", "c"], "goal": [0, 0, 0]}', "line 1"),
    "huge.jsonl": (b'{"state": [0, 0, 1' + 400 * b"0" + b'], "goal": [0, 0, 0]}', "line 1"),
    "bytes.jsonl": (b"\xff\xfe\x00\x01", "bytes.jsonl"),
    "empty.jsonl": (b"\n\n", "no problem"),
}


def assert_refused(capsys, arguments, *words):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    assert out == ""
    for word in words:
        assert word in err


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_problems_are_refused_with_their_line(tmp_path, capsys, name):
    content, word = BAD_FILES[name]
    (tmp_path / name).write_bytes(content)
    assert_refused(capsys, ["evaluate", "progress=false", f"problems={tmp_path / name}"], word)


@pytest.mark.parametrize(
    ("argument", "word"),
    [
        ("episods=5", "episodes"),
        ("policy=exakt", "exact"),
        ("policy=nowhere/run", "nowhere/run"),
        ("policy=nowhere.npz", "nowhere.npz"),
        ("backend=magic", "kinematic"),
        ("episodes=0", "episodes"),
        ("episodes=many", "episodes"),
        ("seed=-1", "seed"),
        ("seed=100000000000000000000", "seed"),
        ("epsilon_deg=0", "epsilon_deg"),
        ("epsilon_deg=-1", "epsilon_deg"),
        ("epsilon_deg=nan", "epsilon_deg"),
        ("architecture=C", "A, B"),
        ("cell=moon", "paper"),
        ("problems=nowhere.jsonl", "nowhere.jsonl"),
        ("json=nowhere/result.json", "nowhere"),
        ("trace=nowhere/trace.jsonl", "nowhere"),
        ("json=.", "json"),
        ("--episodes", "key=value"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(capsys, argument, word):
    assert_refused(capsys, ["evaluate", "progress=false", "episodes=2", argument], word)


def test_a_supervisor_of_another_architecture_is_refused(capsys, run_b):
    assert_refused(capsys, ["evaluate", f"policy={run_b}", "architecture=A"], "architecture = 'B'", "'A'")
    assert_refused(capsys, ["evaluate", f"policy={run_b}", "task.architecture=A"], "architecture = 'B'", "'A'")


def test_a_corrupt_run_is_refused(capsys, tmp_path, run_b):
    content = (run_b / "checkpoint.pt").read_bytes()
    (tmp_path / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    assert_refused(capsys, ["evaluate", f"policy={tmp_path}"], "checkpoint")


def test_a_typed_default_still_overrides_the_policys_own(tmp_path):
    """Asked for by value, not by difference: 5 degrees is the default, and not what this policy came with."""
    policy = policies.adapted("exact", epsilon_deg=1.0, max_steps=7)
    assert (policy.rules.config.epsilon_deg, policy.rules.config.max_steps) == (1.0, 7)
    for key in ("epsilon_deg=5", "task.epsilon_deg=5"):
        assert evaluated(tmp_path, "policy=pretrained_b", "episodes=5", key)[0]["epsilon_deg"] == 5.0


@pytest.mark.parametrize("policy", ["pretrained_a", "pretrained_b"])
def test_even_the_default_architecture_is_refused_to_the_other_policy(capsys, policy):
    other = {"pretrained_a": "B", "pretrained_b": "A"}[policy]
    for key in ("architecture", "task.architecture"):
        assert_refused(capsys, ["evaluate", f"policy={policy}", f"{key}={other}"], "architecture", other)


def test_a_noisy_external_finish_is_traced_as_what_it_was(tmp_path):
    result, lines = evaluated(tmp_path, "policy=exact", "architecture=A", "episodes=200", "task.noise.yaw_deg=8")
    ends = [line["outcome"] for line in lines if line["terminated"] or line["truncated"]]
    assert {outcome: ends.count(outcome) for outcome in OUTCOMES} == result["outcomes"]
    assert result["outcomes"]["wrong_orientation"] > 0
    assert result["noise"] == {"position_mm": 0.0, "yaw_deg": 8.0}


LOOP_FIELDS = {
    *("success_in_the_end", "ended", "position_error_mm", "orientation_error_deg", "refusals", "transfers", "transfer_error_mm"),
    *("transfer_error_deg", "planning_ms", "cycle_s", "episode_s", "chart_inset", "position_tolerance_mm"),
    "contact_events",
    "mean_time_s",
}
LOOP_TRACE_FIELDS = {"attempt", "refusal", "detail", "planning_ms", "duration_s", "path_mm"}


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_noisy_arms_are_evaluated_in_closed_loop(tmp_path, architecture):
    result, lines = evaluated(
        tmp_path, "backend=noisy", "episodes=12", f"architecture={architecture}", "task.noise.yaw_deg=2", "missed_grasps=0.2"
    )
    assert set(result) == FIELDS | LOOP_FIELDS | {"symmetry_order", "noise", "missed_grasps"}
    assert (result["noise"], result["missed_grasps"]) == ({"position_mm": 0.0, "yaw_deg": 2.0}, 0.2)
    assert result["success_rate"] <= result["success_in_the_end"]
    assert result["refusals"]["missed_grasp"] > 0
    first = [line for line in lines if line["attempt"] == 0]
    assert len(first) == round(result["mean_steps"] * 12)
    ends = [line["outcome"] for line in first if line["terminated"] or line["truncated"]]
    assert {kind: ends.count(kind) for kind in OUTCOMES} == result["outcomes"]
    assert len(lines) == result["transfers"]
    for before, after in itertools.pairwise(lines):
        if before["episode"] == after["episode"]:
            assert after["state"] == before["next_state"]
            assert after["step"] == before["step"] + 1
    assert all(set(line) == TRACE_FIELDS | LOOP_TRACE_FIELDS for line in lines)


def test_noise_that_was_typed_as_zero_is_zero(tmp_path):
    quiet = ("task.noise.position_mm=0", "task.noise.yaw_deg=0", "missed_grasps=0")
    result, _ = evaluated(tmp_path, "backend=noisy", "episodes=2", *quiet)
    assert result["noise"] == {"position_mm": 0.0, "yaw_deg": 0.0}
    assert result["transfer_error_mm"]["p95"] < 1e-6


def test_the_closed_loop_is_repeatable(tmp_path):
    def told(*arguments):
        return [{**line, "planning_ms": 0} for line in evaluated(tmp_path, "backend=noisy", "episodes=2", *arguments)[1]]

    assert told() == told()
    assert told() != told("seed=1")


def test_a_few_problems_in_the_simulated_cell(tmp_path, engine):
    (tmp_path / "problems.jsonl").write_text("\n".join(problem_lines(1)))
    result, lines = evaluated(tmp_path, f"backend={engine}", "grasp=constraint", f"problems={tmp_path / 'problems.jsonl'}")
    assert set(result) == FIELDS | LOOP_FIELDS | {"symmetry_order", "grasp"}
    assert result["success_rate"] == result["success_in_the_end"] == 1.0
    assert result["transfer_error_mm"]["p95"] <= 2.0
    assert result["contact_events"] == 0
    assert 1.0 < result["mean_time_s"] / result["transfers"] < 10.0
    assert 0 < max(math.dist(line["next_state"][:2], line["place"]) for line in lines) < 5.0  # measured, not commanded


def test_the_loops_defaults_may_be_spelled_out_anywhere(tmp_path):
    evaluated(tmp_path, "episodes=2", "loop.transfers=30", "motion.lift_mm=40")


def test_transfers_are_priced_as_the_arms_move(tmp_path, monkeypatch):
    """By a table for these motion settings, kept where the package looks for it, in which every way is 700 mm long."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cell, motion = load_cell(), MotionConfig(lift_mm=31.0)
    usual = path_length_table(cell, MotionConfig())
    table = replace(usual, key=settings_key(cell, motion), string_mm=0 * usual.string_mm + 700.0, excess_mm=0 * usual.excess_mm)
    cache_file(table.key).parent.mkdir(parents=True)
    table.save(cache_file(table.key))
    quiet = ("task.noise.position_mm=0", "task.noise.yaw_deg=0", "missed_grasps=0")
    weight = ("task.reward.motion_weight=0.5", "motion.lift_mm=31")
    plain, priced = (evaluated(tmp_path, "backend=noisy", "episodes=2", *quiet, *extra)[1] for extra in (weight[1:], weight))
    firsts = [next(line for line in lines if line["step"] == 0) for lines in (plain, priced)]
    assert firsts[1]["place"] == firsts[0]["place"]
    assert firsts[0]["reward"] - firsts[1]["reward"] == pytest.approx(0.5 * 700 / 100)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["grasp=friction"], "backend=bullet"),
        (["grasp=friction", "backend=noisy"], "backend=bullet or mujoco"),
        (["engine=mujoco", "backend=bullet"], "backend=twin"),
        (["engine=havok", "backend=twin"], "bullet, mujoco"),
        (["backend=bullet", "missed_grasps=0.1"], "backend=noisy"),
        (["backend=bullet", "task.noise.yaw_deg=1"], "task.noise"),
        (["backend=bullet", "grasp=magnet"], "friction, constraint"),
        (["backend=noisy", "missed_grasps=2"], "missed_grasps"),
        (["backend=noisy", "loop.transfers=0"], "loop.transfers"),
        (["backend=noisy", "motion.lift_mm=nan"], "motion.lift_mm"),
        (["backend=noisy", "motion.parked_deg=[0,0,0,0,0]"], "motion.parked_deg"),
        (["backend=noisy", "loop.reach_slack_mm=2"], "loop.reach_slack_mm"),
        (["backend=noisy", "max_steps=31"], "loop.transfers = 30: must be at least task.max_steps = 31"),
        (["backend=kinematic", "loop.transfers=-4", "motion.method=nonsense", "motion.lift_mm=-5"], "loop.transfers = -4"),
        (["loop.reach_slack_mm=0.5"], "left out with backend=kinematic"),
        (["motion.method=paper"], "motion.method"),
        (["motion.parked_deg=[0,120,-115,70,0]"], "motion.parked_deg"),
        (["motion.lift_mm=nan"], "motion.lift_mm"),
    ],
)
def test_backends_refuse_what_they_cannot_use(capsys, arguments, word):
    assert_refused(capsys, ["evaluate", "progress=false", "episodes=2", *arguments], word)
