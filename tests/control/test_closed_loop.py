"""The closed loop: on exact arms it is the rule book; on others it sees again, tries again, and knows when to stop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.config import LoopConfig, MotionConfig, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.control.closed_loop import ClosedLoop, make_loop
from marl_handover.envs.backends import Execution, KinematicBackend, NoisyBackend
from marl_handover.envs.cycle_check import END_TOLERANCE_MM, Refusal
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.learning.evaluation import random_problems
from marl_handover.motion.path_length_table import cache_file, path_length_table, settings_key
from marl_handover.motion.planner import MotionPlanner
from marl_handover.task.episode import play
from marl_handover.task.rules import Outcome, Rules
from tests.canonical_arms import PARKED_DEG

MOTION = MotionConfig()
EXACT = NoiseConfig()


class Scripted(policies.SupervisorPolicy):
    """Says what it was told to, the last thing for ever, and remembers what it saw."""

    def __init__(self, rules, actions):
        super().__init__(rules, "scripted")
        self.actions, self.seen = [np.array(action, float) for action in actions], []

    def act(self, pose, goal, previous_arm):
        self.seen.append((pose.copy(), int(previous_arm)))
        return self.actions[min(len(self.seen), len(self.actions)) - 1]


class Pushed(NoisyBackend):
    """Arms without noise; a hand displaces the object after the first transfer."""

    def __init__(self, model, shift):
        super().__init__(model, MOTION, noise=EXACT, missed_grasps=0.0)
        self.shift = shift

    def execute(self, arm, paths):
        done = super().execute(arm, paths)
        self.put(done.pose + self.shift)
        self.shift = np.zeros(3)
        return done._replace(pose=self._pose.copy())


class Hopeless(NoisyBackend):
    """Every transfer ends in the same way."""

    def __init__(self, model, refusal):
        super().__init__(model, MOTION, noise=EXACT, missed_grasps=0.0)
        self.refusal = refusal

    def execute(self, arm, paths):
        return super().execute(arm, paths)._replace(refusal=self.refusal)


class Covered(NoisyBackend):
    """An object that nobody sees after a transfer: for a number of looks, then it lies where it was put."""

    same = (0.01, 1e-4)

    def __init__(self, model, looks):
        super().__init__(model, MOTION, noise=EXACT, missed_grasps=0.0)
        self.looks, self.covered = looks, False

    def execute(self, arm, paths):
        before = self._pose.copy()
        done = super().execute(arm, paths)
        if not self.looks:
            return done
        self.covered = True
        return done._replace(pose=before, refusal=Refusal.UNSEEN)

    def watch(self):
        if self.covered:
            self.looks -= 1
        self.covered = self.covered and self.looks > 0
        return None if self.covered else self._pose.copy()


def quiet(model, missed=0.0):
    """Arms that do not count as exact and are."""
    return NoisyBackend(model, MOTION, noise=EXACT, missed_grasps=missed)


def rules_for(model, architecture="B", physical=True, **task):
    return Rules(model.cell, TaskConfig(architecture=architecture, **task), physical=physical)


def scripted(planner, backend, actions, settings=None, **task):
    return ClosedLoop(Scripted(rules_for(planner.model, **task), actions), planner, backend, settings)


START, GOAL = np.array([-120.0, 60.0, 0.4]), np.array([-30.0, 10.0, 0.0])
LEFT, RIGHT, FINAL, HAND_OVER = -1.0, 1.0, 1.0, -1.0


def left_turn(model, goal=GOAL, start=START):
    """What the left arm turns the object by on its way from start to goal."""
    yaw = model.cell.polar(np.stack([start, goal])[:, :2])[1][:, 0]
    return yaw[1] - yaw[0]


def fitting(model):
    """The start from which the left arm alone solves the problem."""
    return np.array([*START[:2], GOAL[2] - left_turn(model)])


@pytest.mark.parametrize(
    ("name", "architecture"),
    [("exact", "A"), ("exact", "B"), ("random", "A"), ("random", "B"), ("pretrained_a", "A"), ("pretrained_b", "B")],
)
def test_on_exact_arms_the_loop_is_the_rule_book(planner, name, architecture, assert_same_angle):
    """The same outcomes, transfers and poses as the batched roll-out, whose motions are never planned."""
    rules = rules_for(planner.model, architecture, physical=False, epsilon_deg=10.0, max_steps=6)
    starts, goals = random_problems(rules, 5, 3)
    compared = 0
    for number, (start, goal) in enumerate(zip(starts, goals, strict=True)):
        truth = play(rules, policies.load(name, rules.cell, rules.config, seed=number).act, start[None], goal[None])
        loop = ClosedLoop(policies.load(name, rules.cell, rules.config, seed=number), planner, KinematicBackend(planner.model, MOTION))
        episode = loop.play(start, goal)
        if any(transfer.result.refusal == Refusal.DECLINED for transfer in episode.first):
            continue  # the rule book knows nothing of arms in the way
        assert (episode.outcome, len(episode.first)) == (truth.outcome[0], truth.transfers[0])
        np.testing.assert_allclose(episode.first[-1].result.pose[:2], truth.pose[0, :2], atol=1e-6)
        assert_same_angle(episode.first[-1].result.pose[2], truth.pose[0, 2], 1e-6)
        if name == "exact":
            assert episode.outcome == Outcome.SUCCESS
        compared += 1
    assert compared >= 3


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_rewards_are_the_rule_books(planner, architecture):
    """Transition for transition, by Rules.step."""
    rules = rules_for(planner.model, architecture, physical=False)
    for start, goal in zip(*random_problems(rules, 4, 1), strict=True):
        loop = ClosedLoop(policies.load("exact", rules.cell, rules.config), planner, KinematicBackend(planner.model, MOTION))
        episode, pose, previous, rewards = loop.play(start, goal), start, np.int64(-1), []
        for _ in range(20):
            result = rules.step(pose, goal, previous, loop.policy.act(pose, goal, previous), transfers_left=np.int64(20 - len(rewards)))
            rewards += [float(result.reward), 0.0][: int(result.transfers)]
            pose, previous = result.pose, result.previous_arm
            if result.terminated:
                break
        assert [transfer.reward for transfer in episode.transfers] == rewards


def test_the_policy_sees_what_is_measured_not_what_was_commanded(planner):
    """An object pushed by hand between two transfers only changes the next observation."""
    push = np.array([4.0, -6.0, 0.3])
    loop = scripted(planner, Pushed(planner.model, push), [[HAND_OVER, LEFT, 0.0, 0.0], [FINAL, RIGHT, 0.0, 0.0]])
    episode = loop.play(START, GOAL)
    (first, _), (second, previous) = loop.policy.seen[:2]
    np.testing.assert_array_equal(first, START)
    np.testing.assert_allclose(second[:2], push[:2], atol=1e-6)
    assert previous == 0
    np.testing.assert_array_equal(episode.transfers[1].before, episode.transfers[0].result.pose)
    np.testing.assert_allclose(episode.transfers[0].result.pose - episode.transfers[0].command.predicted, push, atol=1e-6)


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_a_push_in_mid_episode_is_made_good(planner, architecture):
    rules = rules_for(planner.model, architecture)
    for seed, (start, goal) in enumerate(zip(*random_problems(rules, 6, 7), strict=True)):
        loop = ClosedLoop(policies.load("exact", rules.cell, rules.config), planner, Pushed(planner.model, np.array([3.0, -2.0, 0.8])))
        assert loop.play(start, goal, seed).solved


def test_a_missed_final_grasp_is_a_wrong_position_first_and_made_good_in_the_end(planner):
    backend = quiet(planner.model, missed=0.5)
    loop = scripted(planner, backend, [[FINAL, LEFT, 0.0, 0.0]])
    ends = [loop.play(fitting(planner.model), GOAL, seed) for seed in range(8)]
    assert all(episode.solved for episode in ends)
    outcomes = {episode.outcome for episode in ends}
    assert outcomes == {Outcome.SUCCESS, Outcome.WRONG_POSITION}
    for episode in ends:
        *missed, last = episode.transfers
        assert [transfer.result.refusal for transfer in missed] == [Refusal.MISSED_GRASP] * len(missed)
        assert [transfer.attempt for transfer in episode.transfers] == list(range(len(episode.transfers)))
        assert (last.result.refusal, last.outcome) == (None, Outcome.SUCCESS)
        assert len(episode.first) == 1


def test_a_wrong_orientation_is_not_the_end(planner):
    """Finished the wrong way round; then the exact planner puts it right."""
    model = planner.model
    start = fitting(model) + [0.0, 0.0, 1.0]
    loop = scripted(planner, quiet(model), [[FINAL, LEFT, 0.0, 0.0]])
    exact = policies.load("exact", model.cell, TaskConfig())
    act = loop.policy.act
    loop.policy.act = lambda *seen: act(*seen) if not loop.policy.seen else exact.act(*seen)
    episode = loop.play(start, GOAL)
    assert episode.outcome == Outcome.WRONG_ORIENTATION
    assert episode.solved
    assert [transfer.over for transfer in episode.transfers] == [True, *[False] * (len(episode.transfers) - 2), True]
    final = episode.transfers[-1].result.pose
    assert math.dist(final[:2], GOAL[:2]) <= 5
    assert abs(loop.rules.orientation_error(final[2], GOAL[2])) <= loop.rules.epsilon_rad


def test_an_order_refused_twice_is_stuck(planner):
    """The right arm cannot pick up there, and the supervisor does not learn."""
    episode = scripted(planner, quiet(planner.model), [[FINAL, RIGHT, 0.0, 0.0]]).play(np.array([-150.0, 120.0, 0.0]), GOAL)
    assert (episode.outcome, episode.ended) == (Outcome.WRONG_POSITION, "stuck")
    assert [(t.result.refusal, t.attempt, t.terminated) for t in episode.transfers] == [(Refusal.OUT_OF_REACH, k, True) for k in (0, 1)]
    assert episode.transfers[0].reward == -30


def test_in_architecture_a_a_forbidden_order_costs_a_transfer_as_on_exact_arms(planner):
    loop = scripted(planner, quiet(planner.model), [[0.0, RIGHT, 0.0, 0.0]], architecture="A", epsilon_deg=0.01, max_steps=3)
    episode = loop.play(np.array([-150.0, 120.0, 0.0]), GOAL)
    assert (episode.outcome, episode.ended, len(episode.first)) == (Outcome.TIMEOUT, "stuck", 3)
    assert {transfer.reward for transfer in episode.first} == {-1.0}
    assert [transfer.truncated for transfer in episode.first] == [False, False, True]


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_an_arm_that_declines_is_a_wrong_position(planner, architecture):
    """The arm's joints are where no plan can begin: its hand is in the table."""

    class Jammed(NoisyBackend):
        def joints_rad(self):
            return super().joints_rad() * [1, 0, 1, 1, 1]

    backend = Jammed(planner.model, MOTION, noise=EXACT, missed_grasps=0.0)
    episode = scripted(planner, backend, [[HAND_OVER, LEFT, 0.1, 0.0]], architecture=architecture).play(START, GOAL)
    assert (episode.outcome, episode.ended) == (Outcome.WRONG_POSITION, "stuck")
    first = episode.first[-1]
    assert first.result.refusal == Refusal.DECLINED
    assert first.result.detail
    assert first.reward == (-1.0 if architecture == "A" else -30.0)
    np.testing.assert_array_equal(first.result.pose, START)


@pytest.mark.parametrize("refusal", [Refusal.TIPPED, Refusal.STALLED])
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_what_an_arm_cannot_mend_is_left_to_people(planner, refusal, architecture):
    """At once, also by a policy that would order something else each time."""
    orders = [[HAND_OVER, LEFT, place, 0.0] for place in (-0.4, -0.2, 0.0, 0.2)]
    episode = scripted(planner, Hopeless(planner.model, refusal), orders, architecture=architecture).play(START, GOAL)
    assert (episode.outcome, episode.ended, len(episode.transfers)) == (Outcome.WRONG_POSITION, "stuck", 1)


def test_an_object_out_of_sight_is_no_success_though_it_lay_at_the_goal(planner):
    """Nobody knows where it is now."""
    loop = scripted(planner, Hopeless(planner.model, Refusal.UNSEEN), [[FINAL, LEFT, 0.0, 0.0]])
    episode = loop.play(GOAL, GOAL)
    assert episode.outcome == Outcome.WRONG_POSITION
    assert not episode.solved


@pytest.mark.parametrize(("looks", "ended"), [(1, "success"), (99, "stuck")])
def test_an_object_out_of_sight_is_waited_for_once_more(planner, looks, ended):
    backend = Covered(planner.model, looks)
    episode = scripted(planner, backend, [[FINAL, LEFT, 0.0, 0.0]]).play(fitting(planner.model), GOAL)
    assert episode.transfers[0].result.refusal == Refusal.UNSEEN
    assert episode.ended == ended


def test_a_goal_that_changes_once_the_transfers_are_spent_is_not_reached(planner):
    """Nor is the old one what the episode says it ended at."""
    start, told = fitting(planner.model), [GOAL]
    loop = scripted(planner, quiet(planner.model), [[FINAL, LEFT, 0.0, 0.0]], LoopConfig(transfers=1), max_steps=1)
    assert loop.play(start, GOAL, goals=lambda: told[-1]).ended == "success"
    for shift, ended in ((60.0, "transfers"), (1.0, "success")):
        new = GOAL + (shift, 0.0, 0.0)
        episode = loop.play(start, GOAL, observer=lambda transfer, new=new: told.append(new), goals=lambda: told[-1])
        np.testing.assert_array_equal(episode.goal, new)
        assert episode.ended == ended
        told[:] = [GOAL]


def test_transfers_run_out(planner):
    """To and fro, never final: a time-out first, then the loop's own limit."""
    to_and_fro = [[HAND_OVER, LEFT, 0.5, 0.0], [HAND_OVER, RIGHT, -0.5, 0.0]] * 10
    loop = scripted(planner, quiet(planner.model), to_and_fro, LoopConfig(transfers=7), max_steps=4)
    episode = loop.play(START, GOAL)
    assert (episode.outcome, episode.ended) == (Outcome.TIMEOUT, "transfers")
    assert [transfer.attempt for transfer in episode.transfers] == [0] * 4 + [1] * 3
    assert [transfer.truncated for transfer in episode.transfers] == [False, False, False, True, False, False, True]


@pytest.mark.parametrize("off_mm", [0.4, 0.9])
@pytest.mark.parametrize("rim", ["inner", "outer"])
def test_an_object_just_outside_all_reach_is_still_taken(planner, rim, off_mm):
    """Noise has put it a little off the rim; the policy sees it on the rim, the arm takes it where it is."""
    cell = planner.model.cell
    base, radius = cell.bases[0], cell.r_max_mm + off_mm if rim == "outer" else cell.r_min_mm - off_mm
    angle = base.facing_rad - 1.2
    start = np.array([base.x_mm + radius * math.cos(angle), base.y_mm + radius * math.sin(angle), 0.0])
    assert not cell.reaches(start).any()
    loop = scripted(planner, quiet(planner.model), [[HAND_OVER, LEFT, 0.0, 0.0]], LoopConfig(transfers=1), max_steps=1)
    episode = loop.play(start, GOAL)
    assert episode.transfers[0].result.refusal is None
    assert cell.reaches(loop.policy.seen[0][0]).any()
    far = replace(loop.settings, reach_slack_mm=0.2)
    assert ClosedLoop(loop.policy, planner, loop.backend, far).play(start, GOAL).transfers[0].result.refusal == Refusal.OUT_OF_REACH


def test_every_transfer_is_shown_once_and_judged(planner):
    loop = make_loop(policies.load("exact", task=TaskConfig(architecture="A")), "noisy")
    seen = []
    start, goal = (poses[0] for poses in random_problems(loop.rules, 1, 2))
    episode = loop.play(start, goal, 0, seen.append)
    assert seen == list(episode.transfers)


def test_the_seed_decides(planner):
    loop = make_loop(policies.load("exact"), "noisy")
    start, goal = (poses[0] for poses in random_problems(loop.rules, 1, 5))
    first, again, other = ([t.result.pose.tolist() for t in loop.play(start, goal, seed).transfers] for seed in (3, 3, 4))
    assert first == again
    assert first[0] != other[0]


def test_inexact_arms_keep_away_from_the_edge_of_the_chart():
    policy = policies.load("exact")
    inset = {name: make_loop(policy, name).rules for name in ("kinematic", "noisy")}
    assert (inset["kinematic"].cell.config.chart_inset, inset["kinematic"].tolerance_mm < 0.01) == (1.0, True)
    assert (inset["noisy"].cell.config.chart_inset, inset["noisy"].tolerance_mm) == (LoopConfig().chart_inset, 5.0)
    assert make_loop(policy, "noisy", settings=LoopConfig(chart_inset=1.0)).rules.cell.config.chart_inset == 1.0
    narrow = Rules(policy.rules.cell.with_inset(0.8), policy.rules.config)
    assert make_loop(policy.under(narrow), "noisy").policy.rules.cell.config.chart_inset == 0.8


@pytest.mark.parametrize(
    ("name", "value"),
    [("transfers", 0), ("chart_inset", 1.2), ("reach_slack_mm", -1.0), ("reach_slack_mm", 1.01), ("reach_slack_mm", math.nan)],
)
def test_settings_out_of_their_limits_are_named(name, value):
    with pytest.raises(InvalidSetting, match=rf"loop\.{name}"):
        make_loop(policies.load("exact"), "noisy", settings=LoopConfig(**{name: value}))


def test_the_supervisor_may_be_shown_an_object_as_far_off_as_an_arm_accepts_it():
    LoopConfig(reach_slack_mm=END_TOLERANCE_MM).validate()
    with pytest.raises(InvalidSetting, match=r"loop\.reach_slack_mm"):
        LoopConfig(reach_slack_mm=math.nextafter(END_TOLERANCE_MM, math.inf)).validate()


def test_fewer_transfers_than_the_task_allows_are_refused(planner):
    for name in ("noisy", "kinematic"):
        with pytest.raises(InvalidSetting, match=r"loop\.transfers = 5: must be at least task\.max_steps = 6"):
            make_loop(policies.load("exact", task=TaskConfig(max_steps=6)), name, settings=LoopConfig(transfers=5))
    with pytest.raises(InvalidSetting, match=r"loop\.transfers = 30.* 31"):
        scripted(planner, quiet(planner.model), [[FINAL, LEFT, 0.0, 0.0]], max_steps=31)
    assert make_loop(policies.load("exact", task=TaskConfig(max_steps=5)), "noisy", settings=LoopConfig(transfers=5)).limit == 5


@pytest.mark.parametrize("shift_mm", [0.0, 7.0])
def test_after_a_collision_the_arm_that_moved_the_object_was_the_last_one(planner, shift_mm):
    """Refused either way, and judged so; but an object that was pushed all the same is one that this arm has handled."""

    class Colliding(NoisyBackend):
        def execute(self, arm, paths):
            self.put(self._pose + [shift_mm, 0.0, 0.0])
            return Execution(self._pose.copy(), self.joints_rad(), 0.0, Refusal.COLLISION)

    backend = Colliding(planner.model, MOTION, noise=EXACT, missed_grasps=0.0)
    loop = scripted(planner, backend, [[HAND_OVER, LEFT, 0.1, 0.0], [HAND_OVER, LEFT, 0.2, 0.0]])
    first, second = loop.play(START, GOAL).transfers[:2]
    assert (first.result.refusal, first.outcome) == (Refusal.COLLISION, Outcome.WRONG_POSITION)
    assert second.previous_arm == loop.policy.seen[1][1] == (0 if shift_mm else -1)


class Drooping(NoisyBackend):
    """Servos that hold the arms a little off what they were told."""

    droop = np.zeros((2, 5))

    def joints_rad(self):
        return super().joints_rad() + self.droop


def at_limit(planner):
    """A planner whose parked pose has the wrist at its limit."""
    upper = math.degrees(planner.model.arm.upper_rad[3])
    return MotionPlanner(planner.model, MotionConfig(parked_deg=[*PARKED_DEG[:3], upper, 0.0]))


@pytest.mark.parametrize(("joint", "off_rad"), [(3, 0.008), (4, 0.008), (4, -0.008)])
def test_an_arm_that_droops_past_a_limit_or_rolls_a_little_can_still_start(planner, joint, off_rad):
    planner = at_limit(planner)
    backend = Drooping(planner.model, planner.motion, noise=EXACT, missed_grasps=0.0)
    backend.droop = np.zeros((2, 5))
    backend.droop[0, joint] = off_rad
    assert joint == 4 or not planner.model.arm.within_limits(backend.joints_rad()[0])
    assert scripted(planner, backend, [[HAND_OVER, LEFT, 0.1, 0.0]]).play(START, GOAL).transfers[0].result.refusal is None


def test_an_arm_far_past_a_limit_declines(planner):
    planner = at_limit(planner)
    backend = Drooping(planner.model, planner.motion, noise=EXACT, missed_grasps=0.0)
    backend.droop = np.array([[0.0, 0.0, 0.0, 0.05, 0.0], np.zeros(5)])
    done = scripted(planner, backend, [[HAND_OVER, LEFT, 0.1, 0.0]]).play(START, GOAL).transfers[0].result
    assert (done.refusal, "joint limits" in done.detail) == (Refusal.DECLINED, True)


def test_the_other_arm_is_avoided_where_it_is_measured(planner):
    """Its roll is not taken for 0: the fingers stand as they stand."""
    told = []

    class Asked(MotionPlanner):
        def plan_paths(self, arm, pick_mm, place_mm, joints_rad, other_joints_rad):
            told.append((np.array(joints_rad), np.array(other_joints_rad)))
            return super().plan_paths(arm, pick_mm, place_mm, joints_rad, other_joints_rad)

    backend = Drooping(planner.model, MOTION, noise=EXACT, missed_grasps=0.0)
    backend.droop = np.full((2, 5), 0.01)
    measured = backend.joints_rad()
    scripted(Asked(planner.model, MOTION), backend, [[HAND_OVER, LEFT, 0.1, 0.0]]).play(START, GOAL)
    np.testing.assert_array_equal(told[0][1], measured[1:])
    np.testing.assert_array_equal(told[0][0], [*measured[0, :4], 0.0])


def test_transfers_are_priced_as_these_arms_move(planner, tmp_path, monkeypatch):
    """A table made for other motion settings, kept where the package looks for it, with prices that no real path has."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    motion, cell = MotionConfig(lift_mm=31.0), planner.model.cell
    usual = path_length_table(cell, MotionConfig())
    table = replace(usual, key=settings_key(cell, motion), string_mm=0 * usual.string_mm + 700.0, excess_mm=0 * usual.excess_mm)
    cache_file(table.key).parent.mkdir()
    table.save(cache_file(table.key))
    task = TaskConfig(reward=RewardConfig(motion_weight=0.5))
    for name in ("kinematic", "noisy"):
        loop = make_loop(policies.load("exact", task=task), name, motion)
        order = loop.policy.rules.motion_penalty(np.int64(0), START, GOAL)
        assert order == pytest.approx(0.5 * 700 / 100)
    policy = policies.adapted("exact", motion=motion, reward=task.reward)
    assert policy.rules.motion_penalty(np.int64(0), START, GOAL) == pytest.approx(3.5)


def test_unknown_backends_are_named():
    with pytest.raises(UnknownChoice, match="kinematic, noisy, bullet"):
        make_loop(policies.load("exact"), "gazebo")


def test_a_policy_that_wants_nobody_to_move_has_timed_out_and_is_not_asked_again(planner):
    rules = policies.load("exact").rules
    start, goal = (poses[0] for poses in random_problems(rules, 1, 5))
    policy = Scripted(rules, [[math.nan] * 4])
    episode = ClosedLoop(policy, planner, NoisyBackend(planner.model, MOTION, noise=EXACT, missed_grasps=0.0)).play(start, goal)
    assert (episode.outcome, episode.ended, len(episode.transfers), len(policy.seen)) == (Outcome.TIMEOUT, "stuck", 1, 1)
    assert np.isfinite(episode.transfers[0].command.place_mm).all()
    assert episode.transfers[0].result.pose.tolist() == start.tolist()
