"""Training a policy that also moves: true hindsight, the mirror law, what its critic foresees, and the policy it leaves."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover import cli, policies
from marl_handover.baselines.centralised import with_actions
from marl_handover.commands.plan import solve
from marl_handover.control.evaluation import AssessmentConfig, assess
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.learning.algorithm import stepped
from marl_handover.learning.checkpoint import policy_arrays, save_policy
from marl_handover.learning.trainer import Trainer
from marl_handover.learning.variant import make_variant
from marl_handover.motion.batched_paths import mirrored_numbers
from marl_handover.policies import SupervisorPolicy
from marl_handover.simulation.engine import default_engine
from marl_handover.task.observations import observe
from marl_handover.task.rules import Rules
from tests.symmetries import GROUP, flips_x

NUMBERS = 20
VARIANT = "variant=centralised"


@pytest.fixture(scope="module")
def trained(small, tmp_path_factory):
    """A finished run of seconds."""
    folder = tmp_path_factory.mktemp("centralised")
    trainer = Trainer(small("sac", VARIANT, "steps=384", "evaluation_interval=384"), folder)
    trainer.run()
    return trainer


@pytest.fixture(scope="module")
def trainer(small, tmp_path_factory):
    """Many decisions in memory, none learned from; the blind motions are small, so that many are made."""
    made = Trainer(small("sac", VARIANT, "num_envs=64"), tmp_path_factory.mktemp("blind"))

    def explore(observation):
        action = made.algorithm.random_action(observation)
        reach = made.rules.cell.reaches(made.collector.current["achieved_goal"])
        action[:, 1] = torch.where(reach[:, 0], -1.0, 1.0)
        action[:, 4:] *= 0.05
        return action

    for _ in range(50):
        rows = made.collector.collect(explore).rows
        if rows is not None:
            made.replay.extend(rows)
    return made


def test_relabelled_transitions_are_true(trainer):
    batch = trainer.replay.sample(2000)
    previous = batch["previous_arm"][:, 0]
    truth = trainer.rules.step(batch["achieved_goal"], batch["desired_goal"], previous, batch["action"], epsilon_rad=batch["epsilon"][:, 0])
    assert batch["hindsight"].any()
    same = (truth.feasible == batch["feasible"][:, 0]) & (truth.reward == batch["next", "reward"][:, 0])
    assert same.float().mean() > 0.998, "but for motions at the very edge, rounded"
    assert torch.equal(truth.terminated[same], batch["next", "terminated"][same, 0])
    assert not batch["hindsight"][~batch["feasible"]].any()
    shares = batch["feasible"].float().mean()
    assert 0.2 < shares < 0.9


def test_positions_are_read_off_the_observation(trainer, draw):
    start, goal, previous, _ = (torch.tensor(part) for part in draw(trainer.rules.cell, 200, 1))
    seen = observe(trainer.rules, "relative", start, goal, previous).float()
    for found, expected in zip(trainer.algorithm.loss.actor.positions(seen), (start, goal), strict=True):
        torch.testing.assert_close(found, expected[:, :2].float(), atol=1e-3, rtol=0)


def test_the_policy_keeps_the_mirror_law(trainer, draw):
    start, goal, previous, _ = (torch.tensor(part) for part in draw(trainer.rules.cell, 300, 2))
    rules, actor = trainer.rules, trainer.algorithm.actor()
    torch.nn.init.normal_(actor.move[-1].weight, std=0.5)  # it begins with zeros, which every law holds for
    action = trainer.algorithm.act(observe(rules, "relative", start, goal, previous).float())
    assert action[:, 4:].std() > 0.1
    for symmetry in GROUP:
        image = [symmetry.pose(start), symmetry.pose(goal), symmetry.arm(previous)]
        found = trainer.algorithm.act(observe(rules, "relative", *image).float())
        turned = torch.tensor(-1.0 if flips_x(symmetry) != symmetry.swaps else 1.0)
        expected = torch.cat([symmetry.action(action[:, :4]), mirrored_numbers(action[:, 4:], turned.expand(len(action)))], -1)
        alike = (found - expected).abs().max(-1).values < 1e-3
        assert alike.float().mean() > 0.97  # bearings of 0 and two equal branches may fall either way


def test_the_critic_foresees_refusals(trainer):
    """What it learned from a batch holds for another one: refused motions rank above those that were made."""
    algorithm = trainer.algorithm

    def separation():
        batch, _ = with_actions(trainer.replay.sample(1000))
        to = torch.where(
            batch["final"][:, None], batch["goal"][:, :2], trainer.rules.cell.chart.to_table(batch["action"][:, 2], batch["action"][:, 3])
        )
        reach = (trainer.rules.cell.reaches(batch["pose"]) & trainer.rules.cell.reaches(to)).gather(1, batch["arm"][:, None])[:, 0]
        way, sign = algorithm.loss.actor.way(batch["arm"], batch["pose"][:, :2], to)
        logit = algorithm.loss.critic.refused_logit(way, mirrored_numbers(batch["action"][:, Rules.action_size :], sign))[reach]
        refused = ~batch["feasible"][reach]
        return (logit[refused][:, None] > logit[~refused][None]).float().mean().item()

    before, random = separation(), torch.Generator().manual_seed(1)
    for _ in range(100):
        present, following = with_actions(trainer.replay.sample(256))
        noise = torch.randn(256, algorithm.loss.noise_width, generator=random)
        stepped(algorithm.critic_optimizer, algorithm.loss.critic_loss(present, following, noise))
    assert separation() > max(0.75, before + 0.1)


def test_a_motion_that_is_surely_refused_is_worth_the_failure(trainer):
    """The value of a branch lies between its own and that of a failure, by the chance of refusal."""
    loss = trainer.algorithm.loss
    batch, _ = with_actions(trainer.replay.sample(64))
    noise = torch.randn(64, loss.noise_width, generator=torch.Generator().manual_seed(0))
    values = []
    with torch.no_grad():
        loss.log_temperatures.fill_(-30.0)
        bias = loss.critic.refusal[-1].bias
        for sure in (-50.0, 50.0):
            bias.add_(sure)
            values.append(loss.drawn(loss.critic, batch, noise).value)
            bias.sub_(sure)
    assert torch.allclose(values[1], torch.full((64,), loss.failure), atol=1e-3)
    assert (values[0] > values[1]).float().mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sac", "flat_sac"])
def test_one_seed_one_run(small, table, tmp_path, algorithm):
    runs = []
    for name in ("one", "two"):
        Trainer(small(algorithm, VARIANT, "steps=384", "evaluation_interval=384", "centralised.motion=flat"), tmp_path / name).run()
        runs.append(table(tmp_path / name))
    assert runs[0] == runs[1]
    assert float(runs[0][-1]["gradient_step"]) > 0


def test_torchrls_own_call_gives_the_losses(trainer):
    losses = trainer.algorithm.loss(trainer.replay.sample(64))
    assert losses["loss_qvalue"] > 0
    assert losses["loss_actor"].requires_grad


@pytest.mark.parametrize("algorithm", ["sac", "flat_sac"])
@pytest.mark.parametrize("motion", ["flat", "offset"])
def test_numpy_policy_is_the_torch_actor(small, draw, tmp_path, algorithm, motion):
    config = small(algorithm, VARIANT, f"centralised.motion={motion}", "centralised.offset_rad=0.3")
    made = Trainer(config, tmp_path)
    if algorithm == "sac":
        torch.nn.init.normal_(made.algorithm.loss.actor.move[-1].weight, std=0.1)
    save_policy(tmp_path / "policy.npz", policy_arrays(made.algorithm, config, "a test"))
    policy = policies.load(str(tmp_path / "policy.npz"))
    assert policy.variant == "centralised"
    assert policy.rules.settings == config.centralised
    start, goal, previous, _ = draw(policy.rules.cell, 300, 6)
    expected = made.algorithm.act(torch.tensor(observe(policy.rules, "relative", start, goal, previous)).float()).numpy()
    found = policy.act(start, goal, previous)
    assert found.shape == (300, 4 + NUMBERS)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    np.testing.assert_allclose(policy.act(start[0], goal[0], previous[0]), found[0], atol=1e-4)
    others = policy.alternatives(found, start, goal, previous)
    assert others.shape[-1] == 4 + NUMBERS
    if algorithm == "sac":
        np.testing.assert_allclose(others[:, 0], found, atol=1e-6)


def test_a_run_is_evaluated_with_its_motions(trained):
    folder = str(trained.folder)
    done = assess(AssessmentConfig(policy=folder, episodes=40), progress=False)
    assert done.report["variant"] == "centralised"
    assert done.report["episodes"] == 40
    again = assess(AssessmentConfig(policy=f"shielded:{folder}", episodes=40), progress=False)
    assert again.report["success_rate"] >= done.report["success_rate"]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["noisy", "physics"])
def test_executors_do_not_make_its_motions(trained, backend):
    backend = default_engine() if backend == "physics" else backend
    with pytest.raises(InvalidSetting, match="kinematic"):
        assess(AssessmentConfig(policy=str(trained.folder), episodes=1, backend=backend), progress=False)


@pytest.mark.parametrize("prefix", ["", "shielded:"])
def test_it_does_not_play_the_supervisor_of_other_arms(trained, prefix):
    with pytest.raises(InvalidSetting, match="motions are its own"):
        policies.load(f"{prefix}{trained.folder}")({"state": [0.0, 100.0, 1.0], "goal": [10.0, -120.0, -2.0], "previous_arm": 0})


@pytest.mark.parametrize("key", ["motion", "motion_picture"])
@pytest.mark.parametrize("prefix", ["", "shielded:"])
def test_plan_does_not_write_the_executors_motions(trained, tmp_path, capsys, prefix, key):
    file = tmp_path / "motion.png"
    assert cli.main(["plan", f"policy={prefix}{trained.folder}", f"{key}={file}"]) == 2
    assert f"{key} = " in capsys.readouterr().err
    assert not file.exists()


class Scripted(SupervisorPolicy):
    """Always the same action."""

    def __init__(self, rules, action):
        super().__init__(rules, "scripted")
        self.action = action

    def act(self, pose, goal, previous_arm):
        return self.action


def test_plan_tells_the_policys_own_paths_and_why_it_was_refused(trained):
    """A motion of straight first guesses, a wild one, and a pick-up far from the arm."""
    rules, near, far, goal = trained.rules, [0.0, 0.0, 0.0], [0.0, -240.0, 0.0], np.array([150.0, 60.0, 1.0])
    left, straight, tried = [-1.0, -1.0, 0.2, 0.3], np.zeros(NUMBERS), np.sign(np.random.default_rng(0).normal(size=(50, NUMBERS)))
    commands = rules.decode(np.concatenate([np.tile(left, (50, 1)), tried], -1))
    wild = tried[~rules.transfer(np.tile(near, (50, 1)), np.tile(goal, (50, 1)), commands)[1]][0]
    plans = [
        solve(Scripted(rules, np.concatenate([left, motion])), np.array(start), goal)
        for start, motion in ((near, straight), (near, wild), (far, straight))
    ]
    first = [plan["transfers"][0] for plan in plans]
    assert [transfer["refusal"] for transfer in first] == [None, "motion", "out_of_reach"]
    assert [transfer["refused"] for transfer in first] == [False, True, True]
    ends = (np.array([first[0][key][:2]]) for key in ("from", "to"))
    assert first[0]["path_mm"] == pytest.approx(rules.path_mm(np.array([0]), *ends, straight[None])[0])
    assert first[0]["path_mm"] > np.linalg.norm(np.subtract(first[0]["to"], first[0]["from"])[:2]) + 0.1
    assert first[1]["path_mm"] == 0.0


def test_a_saved_run_goes_on_as_it_would_have(small, table, tmp_path):
    settings = small("sac", VARIANT, "steps=512", "evaluation_interval=256")
    whole = Trainer(settings, tmp_path / "whole")
    whole.run()
    first = Trainer(settings, tmp_path / "parts")
    first.folder.mkdir()
    first.curriculum.enter(0)
    while first.counters.step < 240:
        first._advance()
    first.save()
    second = Trainer(settings, tmp_path / "parts")
    second.restore()
    second.run()
    assert table(tmp_path / "parts")[-1] == table(tmp_path / "whole")[-1]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ("task.architecture=A", "architecture"),
        ("task.reward.motion_weight=1", "motion_weight"),
        ("replay.symmetry=true", "symmetry"),
        ("replay.symmetry=true", "does not mirror motions"),
        ("source=aec", "source"),
        ("decentralised.learners=shared", "decentralised.learners"),
        ("centralised.offset_rad=0", "offset_rad"),
        ("centralised.control_points=5", "control_points"),
    ],
)
def test_what_it_cannot_do_is_refused_by_name(small, changed, named):
    with pytest.raises(InvalidSetting, match=named):
        small("sac", VARIANT, changed).validate()


@pytest.mark.parametrize("algorithm", ["td3", "ppo"])
def test_other_algorithms_are_refused_by_name(small, algorithm):
    config = small(algorithm, VARIANT)
    variant = make_variant("centralised")
    env = variant.env(config, torch.device("cpu"))
    with pytest.raises(UnknownChoice, match=algorithm):
        variant.algorithm(env.rules, config, torch.Generator())


def test_a_block_that_is_put_down_where_it_stands_leaves_the_gradients_finite(trainer):
    """At the corners of the chart the tanh saturates, and a policy that likes one orders exactly the place the block was put at before."""
    cell, loss = trainer.rules.cell, trainer.algorithm.loss
    corner = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [0.3, -0.2]], requires_grad=True)
    place = cell.chart.to_table(corner[:, 0], corner[:, 1])
    way, _ = loss.actor.way(torch.tensor([0, 1, 0]), place.detach(), place)
    assert (way[:, -1] == 0).all()
    loss.actor.motion(way)[0].sum().backward()
    assert corner.grad.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in loss.actor.move.parameters())
    loss.actor.zero_grad()
