"""How far the grip travels: priced by the table where executors move, computed where the policy has motions of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover.cell import build_cell, cell_config, load_cell
from marl_handover.config import CellConfig, CentralisedConfig, MotionConfig, TaskConfig
from marl_handover.control.evaluation import AssessmentConfig, PathLengths, assess
from marl_handover.envs.centralised import CentralisedRules
from marl_handover.envs.cycle_check import CycleCheck
from marl_handover.learning.evaluation import random_problems
from marl_handover.motion.batched_paths import ends_of
from marl_handover.motion.path_length_table import known_table
from marl_handover.policies import load
from marl_handover.task.episode import Decision, play


def test_executors_travel_what_the_table_says():
    report = assess(AssessmentConfig(policy="exact", episodes=200)).report
    policy, ways = load("exact"), []

    def watch(decision):
        command = decision.result.command
        to = np.where(command.final[:, None], decision.goal[:, :2], command.place_mm)
        ways.append((command.arm, decision.pose[:, :2], to))

    play(policy.rules, policy.act, *random_problems(policy.rules, 200, 0), observer=watch)
    arm, start, end = (np.concatenate(parts) for parts in zip(*ways, strict=True))
    table = known_table(policy.rules.cell, MotionConfig())
    assert report["path_mm"] == report["executor_path_mm"] == pytest.approx(float(table(policy.rules.cell, arm, start, end).mean()))
    assert report["path_mm"] > np.hypot(*(end - start).T).mean()


def test_a_cell_without_a_table_is_not_priced():
    rules = load("exact", load_cell(CellConfig(base_distance_mm=380.0))).rules
    paths = PathLengths(rules)
    assert paths.table is None
    assert paths.report() == {}


def test_own_motions_are_measured_as_the_motion_layer_measures_paths():
    model = build_cell(cell_config("paper"))
    rules = CentralisedRules(model.cell, TaskConfig(), CentralisedConfig(motion="offset"))
    draw = np.random.default_rng(0)
    start, goal = (model.cell.chart.to_table(*draw.uniform(-0.9, 0.9, (2, 60))) for _ in range(2))
    arm = draw.integers(0, 2, 60)
    motion = draw.uniform(-0.1, 0.1, (60, rules.action_size - 4))
    lengths = rules.path_mm(arm, start, goal, motion)
    numbers, check = rules.numbers, CycleCheck(model, MotionConfig())
    ends = ends_of(model.cell, *(torch.tensor(part) for part in (arm, start, goal)))
    points = numbers.points(ends, torch.tensor(motion)).double().numpy()
    for row in range(0, 60, 7):
        spline = np.concatenate([points[row], np.zeros((len(points[row]), 1))], -1)
        assert lengths[row] == pytest.approx(check.path_mm(int(arm[row]), spline), rel=1e-6)


def test_nothing_is_counted_of_refused_transfers():
    policy = load("exact")
    paths = PathLengths(policy.rules)
    start, goal = np.array([[0.0, 60.0, 0.0]]), np.array([[0.0, -60.0, 0.0]])
    refused = policy.rules.step(start, goal, np.array([-1]), np.array([[-1.0, -1.0, 0.0, 0.0]]))
    refused = refused._replace(feasible=np.array([False]))
    paths(Decision(np.array([0]), start, goal, np.array([-1]), np.array([0]), refused))
    assert paths.report() == {}
