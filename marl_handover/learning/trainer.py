"""The training loop: collect, relabel, update, evaluate, save; any algorithm."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_handover.cell import carry_robots, load_cell
from marl_handover.compose import to_yaml
from marl_handover.errors import CheckpointMismatch, CorruptFile, HandoverError, InvalidSetting, WorkFailed, first_line
from marl_handover.files import remove_temporaries, write_whole
from marl_handover.learning.algorithm import OwnTorch, compile_state, subnormals_flushed
from marl_handover.learning.checkpoint import FILE, load_checkpoint, save_checkpoint
from marl_handover.learning.collector import Collected
from marl_handover.learning.recorder import Recorder, check_finite, machine
from marl_handover.learning.settings import Curriculum, GraphSacConfig, OffPolicyConfig, OnPolicyConfig, TrainConfig
from marl_handover.learning.variant import Validation, make_variant
from marl_handover.locks import claimed
from marl_handover.parsing import parse_yaml
from marl_handover.task.rules import Outcome

VALIDATION_SEED = 2_000_000_000
"""Seeds of the problems that a run is watched on start here; reports use others (:mod:`marl_handover.learning.evaluation`)."""


STEPS_WEIGHT = 0.05
"""Of two policies the better has the higher success rate; 1 % more steps than the optimum weigh as much as 0.05 % less success."""


def validation_score(row: Mapping[str, float]) -> float:
    """How good a policy is, from its ``success_rate`` and ``steps_ratio`` (NaN without a success) on the validation problems."""
    excess = 0.0 if math.isnan(row["steps_ratio"]) else row["steps_ratio"] - 1.0
    return row["success_rate"] - STEPS_WEIGHT * excess


@dataclass
class Counters:
    """How far a run is."""

    step: int = 0
    gradient_step: int = 0
    episodes: int = 0
    wall_s: float = 0.0
    stage: int = 0
    next_evaluation: int = 0
    next_checkpoint: int = 0


class Trainer:
    """One training run in one directory.

    Args:
        config: validated settings.
        folder: the run directory, made if it is not there.
        on_evaluation: called with the row of ``metrics.csv`` after each validation; what it raises ends the run, which stays resumable.

    Raises:
        NoSharedMemory: this machine has none.
    """

    def __init__(self, config: TrainConfig, folder: Path, on_evaluation: Callable[[dict[str, float]], object] = lambda row: None) -> None:
        config.validate()
        require_shared_memory()
        self.config, self.folder, self.on_evaluation = config, folder, on_evaluation
        self.device = usable_device(config.device)
        self.torch = OwnTorch(config.threads, config.seed, self.device)
        with self.torch:
            self._build()

    def _build(self) -> None:
        config = self.config
        self.generator = torch.Generator(device=self.device).manual_seed(config.seed)
        if not isinstance(config.algorithm, GraphSacConfig):
            asked = f"algorithm={config.algorithm.name} and variant={config.variant} take no others"
            load_cell(config.cell).require_pair("training", f"{asked}; train preset=one_cell or preset=any_cell does")
        self.variant = make_variant(config.variant)
        self.env = self.variant.env(config, self.device)
        self.rules = self.env.rules
        self.algorithm = self.variant.algorithm(self.rules, config, self.generator)
        self.curriculum = Curriculum(config.curriculum, self.env)
        self.counters = Counters(next_evaluation=config.evaluation_interval, next_checkpoint=config.checkpoint_interval)
        self.replay = self.variant.replay(self.env, config, self.generator)
        self.collector = self.variant.collector(self.env, config)
        self.rollout: list[TensorDictBase] = []
        self.recent = torch.zeros(3)  # finished and solved episodes, and their transfers, since the last evaluation
        self.losses: dict[str, Tensor] = {}
        self.last: dict[str, float] = {}
        self.best: dict[str, Any] = {}  # the actor that did best on the validation problems of the last stage, its score and step

    def run(self) -> dict[str, Any]:
        """Train to the end; return (and write) the summary. An interrupted run continues from its last checkpoint.

        Raises:
            FolderBusy: another process trains in the folder.
            CannotWrite: there is no room for what it writes; the last checkpoint is whole.
        """
        with claimed(self.folder), self.torch:
            remove_temporaries(self.folder)
            self._train()
            return self._summarise()

    def _train(self) -> None:
        carry_robots(self.config.cell, self.folder)
        write_whole(self.folder / "config.yaml", to_yaml(self.config))
        recorder = Recorder(self.folder, self.config.steps, self.counters.step, self.config.progress)
        started = time.perf_counter() - self.counters.wall_s
        self.curriculum.enter(self.counters.stage)
        try:
            while self.counters.step < self.config.steps:
                self._advance()
                self.counters.wall_s = time.perf_counter() - started
                self._report(recorder)
        finally:
            recorder.close()
            self.collector.close()
        self.save()

    def _advance(self) -> None:
        """Collect, and make the gradient steps that are due."""
        config = self.config.algorithm
        starting = isinstance(config, OffPolicyConfig) and self.counters.step < config.learning_starts
        collected = self.collector.collect(self.algorithm.random_action if starting else self.algorithm.explore)
        self.counters.step += collected.steps
        self.recent += collected.ended
        self.counters.episodes += int(collected.ended[0])
        self._schedule()
        with subnormals_flushed():
            if isinstance(config, OffPolicyConfig):
                self._learn_from_replay(collected, config)
            elif isinstance(config, OnPolicyConfig):
                assert collected.transition is not None
                self._learn_from_rollout(collected.transition, config)

    def _schedule(self) -> None:
        self.algorithm.schedule(min(1.0, self.counters.step / self.config.steps))

    def _learn_from_replay(self, collected: Collected, config: OffPolicyConfig) -> None:
        if collected.rows is not None:
            self.replay.extend(collected.rows)
        due = int((self.counters.step - config.learning_starts) / config.env_steps_per_gradient_step) - self.counters.gradient_step
        if due <= 0 or len(self.replay) < config.batch_size:
            return
        # One draw for all updates that are due: a draw costs as much as an update.
        batches = self.replay.sample(due * config.batch_size).split(config.batch_size)
        for batch in batches:
            self.losses = self.algorithm.update(batch)
        self.counters.gradient_step += due

    def _learn_from_rollout(self, transition: TensorDictBase, config: OnPolicyConfig) -> None:
        kept = transition.select(
            "observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"), ("next", "terminated")
        )
        self.rollout.append(kept)
        if len(self.rollout) == config.rollout_steps:
            batch = TensorDict.stack(self.rollout, 1)
            self.losses = self.algorithm.update(batch)
            self.counters.gradient_step += config.epochs * math.ceil(batch.numel() / config.batch_size)
            self.rollout = []

    def _report(self, recorder: Recorder) -> None:
        counters = self.counters
        if counters.step >= counters.next_evaluation or counters.step >= self.config.steps:
            check_finite(counters.step, self.losses)
            counters.next_evaluation += self.config.evaluation_interval
            self.last = self.evaluate()
            self._keep_best()
            row = self._row()
            recorder.record(row)
            self.recent.zero_()
            self._advance_curriculum()
            self.on_evaluation(row)
        shown = {"success": f"{100 * self.last['success_rate']:.2f}%"} if self.last else {}
        recorder.progress(counters.step, **shown, epsilon=self.curriculum.label)
        if counters.step >= counters.next_checkpoint:
            counters.next_checkpoint += self.config.checkpoint_interval
            self.save()

    def _keep_best(self) -> None:
        """Remember the actor if none did better; policies of a run are read from this one."""
        final_stage = self.counters.stage == len(self.config.curriculum) - 1
        score = validation_score(self.last)
        # Before the last stage, always the present one: scores at another epsilon do not compare.
        if not (final_stage and self.best and score < self.best["score"]):
            actor = {name: value.detach().clone() for name, value in self.algorithm.actor().state_dict().items()}
            self.best = {"score": score if final_stage else -math.inf, "step": self.counters.step, "actor": actor}

    def _advance_curriculum(self) -> None:
        stage = self.curriculum.stage_after(self.counters.stage, self.counters.step, self.last["success_rate"])
        if stage != self.counters.stage:
            self.counters.stage = stage
            self.curriculum.enter(stage)

    def _row(self) -> dict[str, float]:
        counters, (low, high) = self.counters, self.env.epsilon_range_rad
        finished, solved, transfers = self.recent.tolist()
        rate = next(part.param_groups[0]["lr"] for part in self.algorithm.modules().values() if isinstance(part, torch.optim.Optimizer))
        return {
            "step": counters.step,
            "gradient_step": counters.gradient_step,
            "wall_s": counters.wall_s,
            "episodes": counters.episodes,
            "epsilon_low_deg": math.degrees(low),
            "epsilon_high_deg": math.degrees(high),
            "training_success_rate": solved / finished if finished else math.nan,
            "training_mean_length": transfers / finished if finished else math.nan,
            "learning_rate": rate,
            **self.last,
            **{name: float(value) for name, value in self.losses.items()},
        }

    @cached_property
    def validation(self) -> Validation:
        """The problems that the run is watched on, always the same."""
        generator = torch.Generator(device=self.device).manual_seed(VALIDATION_SEED + self.config.seed)
        return self.variant.validation(self.rules, self.config, generator)

    def evaluate(self) -> dict[str, float]:
        """Success rate, mean steps and ratio to the optimum of the deterministic policy on the run's own validation problems.

        With the noise of the task, if it has any. Mean steps count ``task.max_steps`` for an episode in which no arm moves any more.
        """
        rules, start, goal, optimum = self.validation
        episodes = self.variant.play(self.algorithm, start, goal, rules)
        solved = episodes.outcome == int(Outcome.SUCCESS)
        ratio = (episodes.transfers / optimum)[solved & (optimum > 0)]
        return {
            "success_rate": float(solved.double().mean()),
            "mean_steps": float(episodes.transfers.double().mean()),
            "steps_ratio": float(ratio.double().mean()) if len(ratio) else math.nan,
        }

    def _summarise(self) -> dict[str, Any]:
        validation = {key: None if math.isnan(value) else value for key, value in self.last.items()}
        score = self.best["score"] if math.isfinite(self.best["score"]) else None
        summary = {
            **asdict(self.counters),
            "best_step": self.best["step"],
            "selection": {
                "score": score,
                "episodes": self.config.evaluation_episodes,
                "steps_weight": STEPS_WEIGHT,
            },
            "compile_state": compile_state(self.algorithm),
            "machine": machine(),
            "seed": self.config.seed,
            "validation": validation,
        }
        write_whole(self.folder / "summary.json", json.dumps(summary, indent=2) + "\n")
        return summary

    def save(self) -> None:
        """Write a checkpoint from which :meth:`restore` continues exactly."""
        with self.torch:
            self._save()

    def _save(self) -> None:
        rows = self.replay[:].clone().to_dict() if len(self.replay) else None  # a slice would save the whole memory
        save_checkpoint(
            self.folder,
            {
                "config": to_yaml(self.config),
                "counters": asdict(self.counters),
                "algorithm": self.algorithm.state_dict(),
                "replay": {"rows": rows, "cursor": self.replay._writer._cursor},
                "experience": self.collector.state_dict(),
                "rollout": [step.to_dict() for step in self.rollout],
                "recent": self.recent,
                "last": self.last,
                "best": self.best,
                "losses": self.losses,
                "random": {
                    "learner": self.generator.get_state(),
                    "torch": torch.get_rng_state(),
                },
            },
        )

    def restore(self) -> None:
        """Continue from the directory's checkpoint: networks, optimisers, replay, running episodes, random states, counters."""
        state = load_checkpoint(self.folder, self.device)
        try:
            with self.torch:
                self._restore(state)
        except HandoverError:
            raise
        except Exception as error:  # torch and what is made of the parts raise many kinds
            raise CorruptFile("checkpoint", self.folder / FILE, f"its parts do not fit together ({first_line(error)[:100]})") from error

    def _restore(self, state: dict[str, Any]) -> None:
        stored = state["config"]
        if _architecture(stored) != self.config.task.architecture:
            raise CheckpointMismatch(self.folder, "architecture", _architecture(stored), self.config.task.architecture)
        self.counters = Counters(**state["counters"])
        if not all(isinstance(value, int | float) and 0 <= value < math.inf for value in asdict(self.counters).values()):
            raise ValueError("its counters are no counts")
        self.algorithm.load_state_dict(state["algorithm"])
        if self.counters.step:
            self._schedule()
        self.collector.load_state_dict(state["experience"])
        if state["replay"]["rows"] is not None:
            rows = TensorDict.from_dict(state["replay"]["rows"], auto_batch_size=True, batch_dims=1)
            self.replay.extend(rows)
            self.replay._writer._cursor = state["replay"]["cursor"]
        self.rollout = [TensorDict.from_dict(step, auto_batch_size=True, batch_dims=1) for step in state["rollout"]]
        self.recent, self.last = state["recent"], state["last"]
        self.best, self.losses = state["best"], state["losses"]
        self.generator.set_state(state["random"]["learner"].cpu())
        torch.set_rng_state(state["random"]["torch"].cpu())


class NoSharedMemory(WorkFailed):
    """A machine or a container without shared memory, which replay memories and the processes of collectors need."""

    def __init__(self, error: OSError) -> None:
        super().__init__(f"training needs shared memory, and /dev/shm cannot be used ({error.strerror or error}); mount a tmpfs there")


def require_shared_memory() -> None:
    """Raise :class:`NoSharedMemory` if no lock can be had that processes share."""
    try:
        multiprocessing.Lock()
    except OSError as error:
        raise NoSharedMemory(error) from error


def _architecture(config_yaml: str) -> str:
    return str(parse_yaml(config_yaml)["task"]["architecture"])


def usable_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        InvalidSetting: for a name torch does not know or a device this machine does not have.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError(f"nothing here computes on {device.type}")
    except (RuntimeError, AssertionError, ValueError) as error:
        found = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
        raise InvalidSetting("device", name, f"one this machine has: {', '.join(found)}") from error
    return device
