"""Settings that take something away from training or from what is seen: each does what its name says, and nothing else."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.config import NoiseConfig, TaskConfig
from marl_handover.envs import SupervisorEnv
from marl_handover.errors import InvalidSetting
from marl_handover.learning.checkpoint import policy_arrays, save_policy
from marl_handover.learning.evaluation import evaluate, random_problems
from marl_handover.learning.trainer import Trainer
from marl_handover.learning.variant import make_variant
from marl_handover.policies import SupervisorPolicy
from marl_handover.policies.registry import ExactPolicy
from marl_handover.task.observations import ARM_FIELDS, RAW_FIELDS, observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules


@pytest.mark.parametrize("layout", ["raw", "object", "relative"])
def test_a_hidden_previous_arm_hides_just_that(paper, rules_of, draw, layout):
    start, goal, previous, _ = draw(paper, 500, 1)
    seen, hidden = (observe(rules_of(paper, previous_arm=shown), layout, start, goal, previous) for shown in (True, False))
    names = RAW_FIELDS if layout == "raw" else (*"xyt", "previous_arm") if layout == "object" else 2 * ARM_FIELDS
    about = np.array(["previous" in name for name in names])
    np.testing.assert_array_equal(hidden[:, ~about], seen[:, ~about])
    np.testing.assert_array_equal(hidden[:, about], 0)
    assert (seen[:, about] != 0).any()


def test_previous_arm_is_hidden_from_learner_memory_and_policy_alike(small, paper, draw, tmp_path):
    trainer = Trainer(small("sac", "algorithm.previous_arm=false"), tmp_path)
    trainer.curriculum.enter(0)
    while len(trainer.replay) < 200:
        trainer._advance()
    columns = [index for index, name in enumerate(2 * ARM_FIELDS) if "previous" in name]
    batch = trainer.replay.sample(500)
    for vector in (batch["observation"], batch["next", "observation"], trainer.collector.current["observation"]):
        assert not vector[:, columns].any()
    assert (batch["next", "previous_arm"] >= 0).any()
    save_policy(tmp_path / "policy.npz", policy_arrays(trainer.algorithm, trainer.config, "a test"))
    start, goal, previous, _ = draw(paper, 200, 2)
    for task in (None, TaskConfig()):
        policy = policies.load(str(tmp_path / "policy.npz"), task=task)
        np.testing.assert_array_equal(policy.act(start, goal, previous), policy.act(start, goal, 0 * previous - 1))


def test_previous_arm_is_the_learners_setting(small):
    with pytest.raises(InvalidSetting, match=r"algorithm\.previous_arm"):
        small("sac", "task.previous_arm=false").validate()
    config = small("sac", "algorithm.previous_arm=false")
    config.validate()
    config.validate()  # as a resumed run does
    assert not config.task.previous_arm


def test_files_of_older_versions_load(small, paper, draw, tmp_path):
    trainer = Trainer(small("sac"), tmp_path)
    arrays = policy_arrays(trainer.algorithm, trainer.config, "a test")
    about = json.loads(str(arrays["about"]))
    del about["task"]["previous_arm"], about["task"]["noise"]["observed_mm"], about["task"]["noise"]["observed_deg"]
    save_policy(tmp_path / "new.npz", arrays)
    save_policy(tmp_path / "old.npz", {**arrays, "about": np.array(json.dumps(about))})
    old, new = (policies.load(str(tmp_path / f"{name}.npz")) for name in ("old", "new"))
    assert old.rules.config == new.rules.config
    problem = draw(paper, 100, 3)[:3]
    np.testing.assert_array_equal(old.act(*problem), new.act(*problem))


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_exploration_by_area_is_that_of_the_blind_start_and_of_random_places(small, algorithm, tmp_path):
    """Where the shared space is narrow, at the tips, fewer places are drawn."""
    share = "random_place" if algorithm == "sac" else "random_action"
    tips = {}
    for name in ("chart", "area"):
        (tmp_path / name).mkdir()
        own = (f"algorithm.{share}=1", "algorithm.deterministic_env_fraction=0") if algorithm == "sac" else (f"algorithm.{share}=1",)
        learner = Trainer(small(algorithm, f"algorithm.exploration={name}", *own), tmp_path / name).algorithm
        observation = torch.randn(4000, 38, generator=torch.Generator().manual_seed(0))
        for when, action in (("blind", learner.random_action(observation)), ("later", learner.explore(observation))):
            alpha = action[:, 2]
            tips[name, when] = (alpha.abs() > 0.8)[alpha.abs() < 1].float().mean().item()  # sac puts a share on the very edge
    for when in ("blind", "later"):
        assert tips["chart", when] == pytest.approx(0.2, abs=0.03)
        assert tips["area", when] < 0.5 * tips["chart", when]


SEEN = NoiseConfig(observed_mm=2.0, observed_deg=3.0)


def test_the_supervisor_sees_the_object_displaced_and_the_truth_goes_on():
    quiet, noisy = (SupervisorEnv(20_000, task=TaskConfig(layout="raw", noise=noise), seed=0) for noise in (NoiseConfig(), SEEN))
    state = noisy.reset()
    cell = noisy.rules.cell
    scale = torch.tensor([cell.r_max_mm, cell.r_max_mm + cell.config.base_distance_mm / 2, math.pi])
    offset = state["observation"][:, :3] * scale - state["achieved_goal"]
    offset = offset[offset[:, 2].abs() < 1]  # but for turns that wrapped
    assert len(offset) > 19_000
    assert offset.std(0).tolist() == pytest.approx([2, 2, math.radians(3)], rel=0.04)
    assert (offset.mean(0).abs() < 0.1).all()
    action = torch.rand(20_000, 4, generator=torch.Generator().manual_seed(1)) * 2 - 1
    start, goal, previous = (state[key] for key in ("achieved_goal", "desired_goal", "previous_arm"))
    expected = quiet.rules.step(start, goal, previous[:, 0], action, transfers_left=torch.tensor(20))
    state["action"] = action
    after = noisy.step(state)["next"]
    torch.testing.assert_close(after["achieved_goal"], expected.pose)
    assert torch.equal(after["outcome"][:, 0], expected.outcome)
    assert torch.equal(after["reward"][:, 0], expected.reward)
    again = observe(noisy.rules, "raw", after["achieved_goal"], goal, after["previous_arm"][:, 0], state["epsilon"][:, 0])
    assert torch.equal(after["observation"][:, 3:], again[:, 3:]), "the goal is seen as it is"
    assert (after["observation"][:, :2] != again[:, :2]).all()


def test_memory_shows_the_noise_anew_and_judges_the_truth(small, tmp_path):
    trainer = Trainer(small("flat_sac", "algorithm.layout=raw", "task.noise.observed_mm=5", "replay.hindsight.strategy=none"), tmp_path)
    trainer.curriculum.enter(0)
    while len(trainer.replay) < 300:
        trainer._advance()
    batch = trainer.replay.sample(3000)
    offset = batch["observation"][:, 0] * trainer.rules.cell.r_max_mm - batch["achieved_goal"][:, 0]
    assert offset.std().item() == pytest.approx(5, rel=0.08)
    verdict = trainer.rules.judge(
        batch["next", "achieved_goal"],
        batch["desired_goal"],
        batch["final"][:, 0],
        batch["next", "previous_arm"][:, 0] == batch["arm"][:, 0],
        batch["epsilon"][:, 0],
    )
    same = (verdict.reward == batch["next", "reward"][:, 0]).float().mean()
    assert same > 0.9  # all but those refused after the same arm's transfer


class Recording(SupervisorPolicy):
    """Another policy, which remembers what it was shown first."""

    def __init__(self, inner):
        super().__init__(inner.rules, inner.name)
        self.inner, self.shown = inner, None

    def act(self, pose, goal, previous_arm):
        self.shown = pose if self.shown is None else self.shown
        return self.inner.act(pose, goal, previous_arm)


@pytest.mark.parametrize("noise", ["{position_mm:2,yaw_deg:2}", "{observed_mm:4,observed_deg:4}"])
@pytest.mark.parametrize("variant", ["hierarchical", "decentralised"])
def test_validation_plays_with_the_noise_of_the_task(paper, small, variant, noise):
    """An exact policy, watched as a run watches its learner: perfect without noise, and the same imperfect result each time with it."""
    start, goal = sample_problems(paper, 300, torch.Generator().manual_seed(2), torch.float32)
    formulation, results = make_variant(variant), []
    for given in ([], [f"task.noise={noise}"]):
        config = small("sac", f"variant={variant}", "task.epsilon_deg=3", *given)
        learner = formulation.algorithm(formulation.rules(paper, config.task, config), config, torch.Generator())
        exact = ExactPolicy(Rules(paper, config.task))
        formulation.policy = lambda algorithm, exact=exact: lambda *problem: torch.tensor(exact.act(*(part.numpy() for part in problem)))
        played = [formulation.play(learner, start, goal) for _ in range(2)]
        assert torch.equal(played[0].outcome, played[1].outcome)
        results.append(float((played[0].outcome == int(Outcome.SUCCESS)).float().mean()))
    assert results[0] > 0.99
    assert 0.2 < results[1] < 0.95


def test_evaluation_shows_the_policy_a_displaced_object(paper):
    clear, misty = (Rules(paper, TaskConfig(noise=noise)) for noise in (NoiseConfig(), SEEN))
    problems = random_problems(clear, 1000, 0)
    exact, mistaken = (Recording(policies.load("exact", paper).under(rules)) for rules in (clear, misty))
    perfect, first, second = (
        evaluate(rules, policy.act, problems, seed=4).episodes for rules, policy in ((clear, exact), (misty, mistaken), (misty, mistaken))
    )
    np.testing.assert_array_equal(exact.shown, problems[0])
    offset = mistaken.shown - problems[0]
    offset = offset[abs(offset[:, 2]) < 1]
    assert offset.std(0) == pytest.approx([2, 2, math.radians(3)], rel=0.1)
    np.testing.assert_array_equal(first.outcome, second.outcome)
    assert (perfect.outcome == int(Outcome.SUCCESS)).all()
    assert 0.5 < (first.outcome == int(Outcome.SUCCESS)).mean() < 0.99
    right = first.outcome == int(Outcome.SUCCESS)
    error = misty.orientation_error(first.pose[:, 2], problems[1][:, 2])
    assert (abs(error[right]) <= misty.epsilon_rad + 1e-9).all(), "the truth is judged"
    assert not misty.noisy, "what arms do is exact"


def test_noise_is_reported_as_it_is():
    assert NoiseConfig(1.0, 2.0).report() == {"position_mm": 1.0, "yaw_deg": 2.0}
    assert SEEN.report() == {"position_mm": 0.0, "yaw_deg": 0.0, "observed_mm": 2.0, "observed_deg": 3.0}
    for name in ("observed_mm", "observed_deg"):
        with pytest.raises(InvalidSetting, match=rf"noise\.{name}"):
            TaskConfig(noise=NoiseConfig(**{name: -1.0})).validate()
