"""The ladder's rungs: files that are what their checksums say and that can be made again, optima that brute force finds too."""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_handover.errors import ChecksumMismatch, InvalidSetting, MissingFile, UnknownChoice
from marl_handover.task import ladder
from marl_handover.task.episode import play
from marl_handover.task.ladder import EVALUATION, FILE_SEED, SPLITS, TRAINING, RungSource, rung, rungs
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import regret
from marl_handover.task.rules import Outcome, Rules
from tests.oracles.angle_sums import AngleSums
from tests.oracles.layouts import Layout

NAMES = [each.name for each in rungs()]
every_rung = pytest.mark.parametrize("name", NAMES)


def layout_of(of):
    """A rung's cell as the oracle has it."""
    arms = [
        {"name": arm.name, "x_mm": arm.base.x_mm, "y_mm": arm.base.y_mm, "facing_rad": arm.base.facing_rad}
        | {"r_min_mm": arm.r_min_mm, "r_max_mm": arm.r_max_mm, "yaw_range_rad": list(arm.yaw_rad)}
        for arm in of.load_cell().arms
    ]
    return Layout(arms, [{"x_mm": disc.x_mm, "y_mm": disc.y_mm, "radius_mm": disc.radius_mm} for disc in of.cell_config.obstacles])


def test_the_ladder_goes_from_two_exact_arms_to_eight_with_discs():
    arms = [each.load_cell().num_arms for each in rungs()]
    assert arms == sorted(arms)
    assert (arms[0], arms[-1]) == (2, 8)
    low, high = rungs()[0], rungs()[-1]
    assert not low.cell_config.obstacles
    assert low.noise.position_mm == low.noise.yaw_deg == 0
    assert high.cell_config.obstacles
    assert {each.epsilon_deg for each in rungs()} >= {1.0, 2.0, 5.0}
    assert {each.load_cell().config.chart for each in rungs()} == {"paper", "angle"}
    assert sum(each.noise.position_mm > 0 for each in rungs()) >= 2
    assert len(set(NAMES)) == len({each.id for each in rungs()}) == len({each.seed for each in rungs()}) == len(NAMES) >= 8
    for each in rungs():
        assert re.fullmatch(rf"Ladder-{each.load_cell().num_arms}-[A-Z][A-Za-z0-9]*-v\d+", each.id)


@every_rung
def test_optima_are_those_of_brute_force(name):
    of, count = rung(name), 50
    start, goal, optimum = of.fixed.take(slice(count))
    sums = AngleSums(layout_of(of))
    least, known = (sums.fewest(start, goal, math.radians(of.epsilon_deg), 20, outer=outer) for outer in (True, False))
    np.testing.assert_array_equal(optimum, known)
    np.testing.assert_array_equal(optimum, least)


@pytest.mark.slow
@every_rung
def test_optima_of_all_problems_are_those_of_brute_force(name):
    of = rung(name)
    start, goal, optimum = of.fixed
    sums = AngleSums(layout_of(of))
    for outer in (True, False):
        np.testing.assert_array_equal(optimum, sums.fewest(start, goal, math.radians(of.epsilon_deg), 20, outer=outer))


@every_rung
def test_a_file_is_made_again_byte_for_byte(name):
    of = rung(name)
    text = of.file_text()
    assert text.encode() == of.path.read_bytes()
    assert hashlib.sha256(text.encode()).hexdigest() == of.sha256
    assert len(of.fixed.optimum) == of.problems == len(text.splitlines())


@every_rung
def test_poses_are_float32_numbers_that_arms_reach(name):
    of = rung(name)
    for poses in of.fixed[:2]:
        np.testing.assert_array_equal(poses.astype(np.float32).astype(float), poses)
        assert (abs(poses[:, 2]) < math.pi).all()
        assert layout_of(of).reaches(poses).any(-1).all()
    assert len(np.unique(np.concatenate(of.fixed[:2], 1), axis=0)) == of.problems


@every_rung
def test_the_exact_planner_has_no_regret_on_exact_arms(name):
    of = rung(name)
    rules = Rules(of.load_cell(), of.task())
    start, goal, optimum = of.fixed.take(slice(200))
    planner = ExactPlanner(rules)
    ended = play(rules, lambda pose, goal, previous_arm: planner.act(pose, goal), start, goal)
    assert (regret(ended.outcome, ended.transfers, optimum, rules.config.max_steps) == 0).all()


def test_a_file_that_was_changed_is_named(tmp_path, monkeypatch):
    of = rung("pair")
    (tmp_path / "pair.jsonl").write_bytes(of.path.read_bytes().replace(b'"optimum": 3', b'"optimum": 2', 1))
    monkeypatch.setattr(ladder, "resource_path", lambda relative: tmp_path)
    changed = replace(of)  # what is cached stays with the other
    with pytest.raises(ChecksumMismatch, match=r"pair\.jsonl was changed: .* install the package again") as error:
        _ = changed.fixed
    assert error.value.wanted == of.sha256
    assert len(str(error.value)) <= 300
    (tmp_path / "pair.jsonl").unlink()
    with pytest.raises(MissingFile):
        _ = changed.fixed


def test_an_unknown_rung_is_told_with_those_that_are_known():
    with pytest.raises(UnknownChoice) as error:
        rung("pairs")
    assert error.value.choices == tuple(NAMES)


def test_regret_counts_a_failure_as_all_that_was_allowed():
    outcome = np.array([Outcome.SUCCESS, Outcome.SUCCESS, Outcome.WRONG_POSITION, Outcome.TIMEOUT], int)
    transfers, optimum = np.array([3, 5, 1, 20]), np.array([3, 3, 3, 4])
    assert regret(outcome, transfers, optimum, 20).tolist() == [0, 2, 17, 16]
    of_torch = regret(*map(torch.as_tensor, (outcome, transfers, optimum)), 20)
    assert of_torch.tolist() == [0, 2, 17, 16]


@pytest.mark.parametrize("split", SPLITS)
def test_a_source_gives_the_same_however_it_is_asked(split):
    one, other = RungSource(rung("triangle"), split), RungSource(rung("triangle"), split)
    together = one.take(300, iter(range(100)).__next__)
    seeds = iter(range(100)).__next__
    parts = [other.take(count, seeds) for count in (1, 0, 99, 200)]
    for column, pieces in zip(together, zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(column, np.concatenate(pieces))


def test_the_file_begins_again_after_its_last_problem():
    source = RungSource(rung("pair"))
    count = len(source.rung.fixed.optimum)
    taken = source.take(count + 3, lambda: 0)
    for column in taken:
        np.testing.assert_array_equal(column[count:], column[:3])


def test_training_problems_are_no_problems_of_the_file():
    of = rung("triangle_discs")
    source = RungSource(of, TRAINING)
    start, goal, optimum = source.take(500, iter(range(100)).__next__)
    fixed = {tuple(row) for row in np.concatenate(of.fixed[:2], 1)}
    assert not fixed & {tuple(row) for row in np.concatenate([start, goal], 1)}
    assert (optimum > 0).all()
    np.testing.assert_array_equal(optimum, ExactPlanner(Rules(of.load_cell(), of.task())).plan(start, goal).transfers)


@pytest.mark.parametrize("number", [-1, 1000, True, "3", 2.0])
def test_a_problem_that_the_file_does_not_have_is_refused(number):
    with pytest.raises(InvalidSetting, match=r"a number from 0 to 999, in the split evaluation"):
        RungSource(rung("pair")).next(np.random.default_rng(0), {"problem": number})
    with pytest.raises(InvalidSetting, match=EVALUATION):
        RungSource(rung("pair"), TRAINING).next(np.random.default_rng(0), {"problem": 0})


def test_few_problems_are_left_out_for_being_on_an_edge():
    of = rung("line4_1deg")
    rules = Rules(of.load_cell(), of.task())
    kept = len(ladder._clear_problems(rules, torch.Generator().manual_seed(FILE_SEED + of.seed)).optimum)
    assert kept > 0.9 * 256


def test_every_line_is_a_problem_as_problem_files_have_them():
    lines = [json.loads(line) for line in rung("pair").path.read_text().splitlines()]
    assert all(set(line) == {"state", "goal", "optimum"} for line in lines)
