"""Stages of epsilon."""

from __future__ import annotations

import math

import pytest

from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import InvalidSetting
from marl_handover.learning.settings import Curriculum, StageConfig
from marl_handover.learning.trainer import Trainer


def curriculum(paper, *stages):
    return Curriculum([StageConfig(*stage) for stage in stages], SupervisorEnv(1, paper))


@pytest.mark.parametrize("count", [1, 2, 3, 10])
def test_stages_end_at_their_steps(paper, count):
    stages = curriculum(paper, *[(20.0 - index, 20.0 - index, 100 * (index + 1)) for index in range(count)])
    stage = 0
    for step in range(0, 1500, 50):
        stage = stages.stage_after(stage, step, 0.0)
        assert stage == min(step // 100, count - 1)
    assert stages.stage_after(0, 10**9, 0.0) == count - 1  # all at once


def test_one_success_ends_one_stage(paper):
    stages = curriculum(paper, (20.0, 20.0, 0, 0.9), (10.0, 10.0, 0, 0.9), (5.0, 5.0, 0, 0.9))
    assert stages.stage_after(0, 100, 0.89) == 0
    assert stages.stage_after(0, 100, 0.9) == 1
    assert stages.stage_after(1, 100, 0.95) == 2
    assert stages.stage_after(2, 10**9, 1.0) == 2


def test_step_or_success_whichever_comes_first(paper):
    stages = curriculum(paper, (20.0, 20.0, 1000, 0.8), (5.0, 5.0))
    assert [stages.stage_after(0, step, rate) for step, rate in ((500, 0.5), (500, 0.8), (1000, 0.0))] == [0, 1, 1]


def test_entering_a_stage_sets_the_range_that_episodes_draw_from(paper):
    stages = curriculum(paper, (2.0, 30.0), (1.0, 1.0))
    stages.enter(0)
    drawn = stages.env.draw_epsilon(4000)
    assert math.radians(2) <= drawn.min() < math.radians(2.2)
    assert math.radians(27) < drawn.max() <= math.radians(30.01)
    assert float(drawn.log().mean()) == pytest.approx(math.log(math.radians(math.sqrt(60))), abs=0.06)  # log-uniform
    stages.enter(1)
    assert stages.env.draw_epsilon(3).tolist() == pytest.approx([math.radians(1)] * 3)


def test_training_goes_through_its_stages(small, table, tmp_path):
    given = ((40, 256), (20, 512), (10, 0))
    stages = ",".join(f"{{epsilon_low_deg:{deg},epsilon_high_deg:{deg},until_step:{step}}}" for deg, step in given)
    Trainer(small("sac", f"curriculum=[{stages}]", "evaluation_interval=128", "steps=768"), tmp_path).run()
    rows = [(int(row["step"]), round(float(row["epsilon_low_deg"]), 3)) for row in table(tmp_path)]
    expected = [(step, 40 if step <= 256 else 20 if step <= 512 else 10) for step in range(128, 769, 128)]
    assert rows == expected


def test_the_accuracy_that_training_is_asked_for_reaches_its_rewards(small, table, tmp_path):
    """The last stage goes down to it, no stage goes below, and validation judges at it."""
    config = small("sac", "epsilon_deg=9")
    config.validate()
    ranges = [(stage.epsilon_low_deg, stage.epsilon_high_deg) for stage in config.curriculum]
    assert ranges == [(9.0, 15.0), (9.0, 12.0), (9.0, 12.0), (9.0, 12.0)]
    config = small("sac", "epsilon_deg=0.5")
    config.validate()
    assert (config.curriculum[-1].epsilon_low_deg, config.curriculum[-1].epsilon_high_deg) == (0.5, 12.0)
    trainer = Trainer(small("sac", "epsilon_deg=9", "curriculum=[{until_step:256},{}]", "evaluation_interval=256", "steps=512"), tmp_path)
    assert trainer.rules.epsilon_rad == pytest.approx(math.radians(9))
    trainer.run()
    assert {float(row[f"epsilon_{end}_deg"]) for row in table(tmp_path) for end in ("low", "high")} == {9.0}
    batch = trainer.replay.sample(2000)
    assert batch["epsilon"].unique().tolist() == pytest.approx([math.radians(9)])
    turned = (batch["next", "achieved_goal"] - batch["desired_goal"])[:, 2].abs()
    near = batch["final"][:, 0] & (batch["next", "reward"][:, 0] > 0)
    assert math.radians(5) < turned[near].max() <= math.radians(9)


def test_asking_twice_asks_for_the_same(small):
    config = small("sac", "epsilon_deg=3")
    config.validate()
    stages = config.curriculum
    config.validate()
    assert config.curriculum == stages
    with pytest.raises(InvalidSetting, match=r"task\.epsilon_deg = 2"):
        small("sac", "epsilon_deg=3", "task.epsilon_deg=2").validate()


def test_without_the_last_stage_the_latest_actor_is_kept(small, tmp_path):
    stages = "curriculum=[{epsilon_low_deg:40,epsilon_high_deg:40,until_success:0.9999},{epsilon_low_deg:1,epsilon_high_deg:1}]"
    trainer = Trainer(small("sac", stages, "evaluation_interval=128", "steps=640"), tmp_path)
    trainer.run()
    assert trainer.counters.stage == 0
    for name, value in trainer.algorithm.actor().state_dict().items():
        assert value.equal(trainer.best["actor"][name])
