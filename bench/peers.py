"""Stable-Baselines3 SAC + HerReplayBuffer on our Gymnasium environment: one variant, one seed.

python bench/peers.py variant=paper_g1 seed=0 steps=650000 max_wall_s=1500 out=runs/peers/paper_g1

A variant's name says what differs from the paper's table: ``paper`` or ``relative`` features, ``done`` if relabelling also corrects the
end flag, ``g1`` or ``g-1`` gradient steps every 16 environment steps (-1: as many as environment steps).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import csv
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import commit, machine, milestones, parse
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import Tensor

from marl_handover.arrays import one_where
from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules

VARIANTS = ("relative_done_g1", "paper_g1", "paper_done_g1", "relative_done_g-1", "paper_g-1", "paper_done_g-1")
DEFAULTS = {"variant": "paper_g1", "seed": 0, "steps": 650_000, "max_wall_s": 1500.0, "out": "", "evaluate_every": 10_000}
THREADS = 1
EPSILON_DEG, FIRST_EPSILON_DEG, SWITCH_STEP = 5.0, 15.0, 150_000
PROBLEMS, PROBLEM_SEED = 1000, 12345
COLUMNS = ("steps", "gradient_steps", "wall_s", "cpu_s", "success_rate", "mean_steps", "epsilon_deg")
TABLE: dict[str, Any] = {
    "learning_rate": 5e-4,
    "gamma": 0.99,
    "buffer_size": 100_000,
    "batch_size": 128,
    "learning_starts": 1000,
    "train_freq": 16,
    "tau": 0.01,
}
"""The paper's table for architecture B; the entropy coefficient, not in it, is SB3's ``auto``."""


class Layout(BaseFeaturesExtractor):
    """A named layout, computed from the goal environment's dict so that it follows a relabelled ``desired_goal``.

    ``raw`` is the paper's seven numbers once (``achieved_goal`` repeats the pose), ``relative`` our features; epsilon is the rules' present
    one.
    """

    def __init__(self, observation_space: spaces.Dict, rules: Rules, layout: str) -> None:
        super().__init__(observation_space, observation_size(layout))
        self.rules, self.layout = rules, layout

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        previous = observations["observation"][..., 3]  # -1 for L, 0 for none, 1 for R
        arm = torch.where(previous == 0, -1, torch.where(previous > 0, 1, 0))
        return observe(self.rules, self.layout, observations["achieved_goal"], observations["desired_goal"], arm)


class StockBuffer(HerReplayBuffer):
    """SB3's own, except that it stores only the part of ``info`` that rewards need: it deep-copies them at each sample."""

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        keys = ("feasible", "final", "TimeLimit.truncated")
        super().add(obs, next_obs, action, reward, done, [{key: info[key] for key in keys if key in info} for info in infos])


class DoneCorrectingBuffer(StockBuffer):
    """A relabelled transition also gets the end flag of its new goal."""

    def _get_virtual_samples(self, batch_indices: np.ndarray, env_indices: np.ndarray, env: Any = None) -> DictReplayBufferSamples:
        data = super()._get_virtual_samples(batch_indices, env_indices, env)
        assert self.env is not None
        ended = self.env.env_method(
            "compute_terminated",
            data.next_observations["achieved_goal"].cpu().numpy(),
            data.observations["desired_goal"].cpu().numpy(),
            self.infos[batch_indices, env_indices],
            indices=[0],
        )[0]
        return data._replace(dones=self.to_torch(np.asarray(ended, np.float32)).reshape(-1, 1))


class Evaluation(NamedTuple):
    """Success rate, and mean transfers of the successful episodes."""

    success_rate: float
    mean_steps: float


@torch.no_grad()
def evaluate(model: SAC, rules: Rules, starts: Tensor, goals: Tensor) -> Evaluation:
    """Play all problems at once with the deterministic policy, at the rules' present epsilon."""
    pose, goal, count = starts.clone(), goals, len(starts)
    previous, alive = torch.full((count,), -1), torch.ones(count, dtype=torch.bool)
    won, used = torch.zeros(count, dtype=torch.bool), torch.zeros(count)
    model.policy.set_training_mode(False)
    for _ in range(rules.config.max_steps):
        vector = observe(rules, "object", pose, goal, previous)
        inputs = {"observation": vector.float(), "achieved_goal": pose.float(), "desired_goal": goal.float()}
        action = model.policy._predict(inputs, deterministic=True).to(pose.dtype)
        result = rules.step(pose, goal, previous, action)
        used += alive
        won |= alive & (result.outcome == int(Outcome.SUCCESS))
        pose = one_where(alive, result.pose, pose)
        previous = torch.where(alive, result.previous_arm, previous)
        alive &= ~result.terminated
        if not bool(alive.any()):
            break
    return Evaluation(float(won.float().mean()), float(used[won].mean()) if bool(won.any()) else math.nan)


class Recorder(BaseCallback):
    """Curriculum, evaluation and clock. The clock runs while training only."""

    def __init__(self, rules: Rules, out: Path, max_wall_s: float, every: int) -> None:
        super().__init__()
        self.rules, self.out, self.max_wall_s, self.every = rules, out, max_wall_s, every
        self.problems = sample_problems(rules.cell, PROBLEMS, torch.Generator().manual_seed(PROBLEM_SEED))
        self.rows: list[dict[str, float]] = []
        self.ended = "steps"
        self.paused_wall_s = self.paused_cpu_s = 0.0
        with (out / "metrics.csv").open("w", newline="") as file:
            csv.writer(file).writerow(COLUMNS)

    def _on_training_start(self) -> None:
        self.started_wall_s, self.started_cpu_s = time.perf_counter(), time.process_time()

    @property
    def wall_s(self) -> float:
        return time.perf_counter() - self.started_wall_s - self.paused_wall_s

    def _on_step(self) -> bool:
        degrees = FIRST_EPSILON_DEG if self.num_timesteps < SWITCH_STEP else EPSILON_DEG
        self.rules.epsilon_rad = math.radians(degrees)
        over = self.wall_s > self.max_wall_s
        if over or self.num_timesteps % self.every == 0:
            self.record(degrees)
        if over:
            self.ended = "wall"
        return not over

    def record(self, degrees: float) -> None:
        """Evaluate at 5 degrees, off the clock, and append a row."""
        wall_s, cpu_s = self.wall_s, time.process_time() - self.started_cpu_s - self.paused_cpu_s
        began_wall_s, began_cpu_s = time.perf_counter(), time.process_time()
        self.rules.epsilon_rad = math.radians(EPSILON_DEG)
        score = evaluate(self.model, self.rules, *self.problems)
        self.rules.epsilon_rad = math.radians(degrees)
        values = (self.num_timesteps, self.model._n_updates, round(wall_s, 2), round(cpu_s, 2), *score, degrees)
        self.rows.append(dict(zip(COLUMNS, values, strict=True)))
        with (self.out / "metrics.csv").open("a", newline="") as file:
            csv.writer(file).writerow(values)
        print(
            f"{self.num_timesteps:7d} steps {self.model._n_updates:7d} gradient steps {wall_s:7.1f} s  "
            f"success {score.success_rate:6.1%}  steps of a success {score.mean_steps:5.2f}",
            flush=True,
        )
        self.paused_wall_s += time.perf_counter() - began_wall_s
        self.paused_cpu_s += time.process_time() - began_cpu_s


def make_model(variant: str, seed: int) -> tuple[SAC, SupervisorGoalEnv]:
    """SB3's SAC as the variant's name says."""
    if variant not in VARIANTS:
        sys.exit(f"peers.py: unknown variant {variant!r}; variants: {', '.join(VARIANTS)}")
    features, *done, updates = variant.split("_")
    env = SupervisorGoalEnv("B")
    env.rules.epsilon_rad = math.radians(FIRST_EPSILON_DEG)
    model = SAC(
        "MultiInputPolicy",
        env,
        **TABLE,
        gradient_steps=int(updates[1:]),
        replay_buffer_class=DoneCorrectingBuffer if done else StockBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 5, "goal_selection_strategy": "episode", "copy_info_dict": True},
        policy_kwargs={
            "net_arch": [512, 512, 512],
            "activation_fn": torch.nn.ReLU,
            "features_extractor_class": Layout,
            "features_extractor_kwargs": {"rules": env.rules, "layout": "raw" if features == "paper" else "relative"},
        },
        seed=seed,
        device="cpu",
    )
    return model, env


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    torch.set_num_threads(THREADS)
    out = Path(values["out"] or f"runs/peers/{values['variant']}-seed{values['seed']}")
    model, env = make_model(values["variant"], values["seed"])
    out.mkdir(parents=True, exist_ok=True)
    (out / "result.json").unlink(missing_ok=True)
    print(f"{values['variant']} seed {values['seed']}: {values['steps']} steps or {values['max_wall_s']:g} s -> {out}", flush=True)
    recorder = Recorder(env.rules, out, values["max_wall_s"], values["evaluate_every"])
    model.learn(values["steps"], callback=recorder, log_interval=None)
    if not recorder.rows or recorder.rows[-1]["steps"] != model.num_timesteps:
        recorder.record(math.degrees(env.rules.epsilon_rad))
    rows = recorder.rows
    result = {
        **{key: values[key] for key in ("variant", "seed", "steps", "max_wall_s")},
        "ended": recorder.ended,
        "to": milestones(rows),
        "final": {key: None if value != value else value for key, value in rows[-1].items()},
        "best_success_rate": max(row["success_rate"] for row in rows),
        "config": {
            **TABLE,
            "gradient_steps": model.gradient_steps,
            "corrects_done": isinstance(model.replay_buffer, DoneCorrectingBuffer),
            "hidden": [512, 512, 512],
            "n_sampled_goal": 5,
            "goal_selection_strategy": "episode",
            "epsilon_deg": [FIRST_EPSILON_DEG, EPSILON_DEG],
            "switch_step": SWITCH_STEP,
            "evaluation": {"problems": PROBLEMS, "seed": PROBLEM_SEED, "every": values["evaluate_every"], "epsilon_deg": EPSILON_DEG},
        },
        "machine": machine(THREADS),
        "commit": commit(),
    }
    (out / "result.json.tmp").write_text(json.dumps(result, indent=1) + "\n")
    (out / "result.json.tmp").replace(out / "result.json")
    print(f"ended by {recorder.ended}; {out / 'result.json'}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
