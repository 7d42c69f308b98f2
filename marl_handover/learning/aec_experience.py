"""Experience from the AEC environment itself, executors and all, played by TorchRL's collectors here, in processes or on a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.weight_update import MultiProcessWeightSyncScheme

from marl_handover.cell import build_cell
from marl_handover.cluster import connected, require_ray
from marl_handover.config import MotionConfig
from marl_handover.envs.flat_aec import fields_of
from marl_handover.envs.spaces import SUPERVISOR, Spaces
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import HandoverError, WorkFailed, first_line
from marl_handover.learning.aec_policy import AecPolicy, WorkerPolicy, make_env, message, supervisor_fields
from marl_handover.learning.experience import Collected, Experience, Explore
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.turns import TurnReader
from marl_handover.task.rules import Outcome

Result = TypeVar("Result")

LOOK_S = 1.0
"""How often it is looked whether the workers live."""
GRACE_S = 5.0
"""So long an answer may still be under way from a worker that has ended."""
SHUTDOWN_S = 20.0

TURNS = 2
"""Steps of the environment a decision, the supervisor's turn and an arm's; in architecture A sometimes one more."""


class WorkerLost(WorkFailed):
    """A process that collects was killed, or failed."""

    def __init__(self, collector: str, reason: str) -> None:
        self.collector, self.reason = collector, reason
        super().__init__(f"a worker of collector={collector} is gone ({reason}); continue from the last checkpoint with train resume=RUN")


class AecExperience(Experience):
    """Decisions of the supervisor in ``HandoverEnv``, rebuilt from turn to turn.

    ``num_envs`` environments are played side by side, shared out over the workers. A call plays about as many decisions and hands over the
    episodes that ended, in rows as :class:`EpisodeWriter` makes them. Episodes are judged solved at the epsilon that the policy was shown.

    A checkpoint holds how many decisions were made and the random state of the replay's epsilons, not the running episodes: those are
    given up, and others begin, of problems that the run has not seen.

    Args:
        env: the batched environment of the same cell and task, whose epsilon range and rule book are followed.
        config: the run: ``backend``, ``executor``, ``collector`` and ``workers``.
    """

    def __init__(self, env: SupervisorEnv, config: TrainConfig) -> None:
        self.env, self.config = env, config
        self.model = build_cell(config.cell)
        self.fields = fields_of(Spaces(self.model, MotionConfig()).observation[SUPERVISOR])
        self.decisions = 0
        self._collector: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._policy: AecPolicy | None = None
        self._cluster = ExitStack()
        self._reader = TurnReader(SUPERVISOR)
        self._running: TensorDict | None = None

    def collect(self, explore: Explore) -> Collected:
        """Let ``explore`` act; with workers it is :meth:`Algorithm.explore` or :meth:`Algorithm.blind`.

        Raises:
            WorkerLost: a worker is gone.
            ClusterUnavailable, MissingExtra: of ``collector=ray``.
        """
        if self.config.collector == "local":
            rollout = self._steps(explore)
        else:
            told = TensorDict(message(explore, self.env.epsilon_range_rad))
            try:
                rollout = self._steps(explore, told)
            except HandoverError:
                raise
            except Exception as error:  # a queue's, a pipe's, Ray's or TorchRL's own
                raise WorkerLost(self.config.collector, first_line(error)) from error
        steps = int(rollout[SUPERVISOR, "mask"].sum())
        self.decisions += steps
        rows, ended = self._finished(self._reader.read(rollout).to(self.env.device))
        return Collected(steps, rows, None, ended)

    def state_dict(self) -> dict[str, Any]:
        """How far it is, and the random state of the batched environment, which draws epsilons for the memory."""
        return {"decisions": self.decisions, "random": self.env.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`; what runs is given up."""
        self.close()
        self.decisions = int(state["decisions"])
        if "random" in state:  # not in those of older versions
            self.env.generator.set_state(state["random"].cpu())

    def close(self) -> None:
        """End the workers and close the environments."""
        if self._collector is not None:
            _shut_down(self._collector)
        self._cluster.close()
        self._collector, self._policy = None, None
        self._reader, self._running = TurnReader(SUPERVISOR), None

    def _steps(self, explore: Explore, told: TensorDict | None = None) -> TensorDictBase:
        """The collector's next batch, played by ``explore``, of which workers have to be told."""
        if self._collector is None:
            self._collector = self._start(explore)
            self._batches = iter(self._collector)
        if self._policy is not None:
            self._policy.explore, self._policy.epsilon_range_rad = explore, self.env.epsilon_range_rad
            return next(self._batches)
        return watched(partial(self._told_steps, told), lambda: getattr(self._collector, "procs", ()))

    def _told_steps(self, told: TensorDict | None) -> TensorDictBase:
        assert self._collector is not None
        self._collector.update_policy_weights_(told)
        return next(self._batches)

    def _start(self, explore: Explore) -> BaseCollector:
        config, workers = self.config, 1 if self.config.collector == "local" else self.config.workers
        cells = -(-config.num_envs // workers)
        draws = np.random.SeedSequence([config.seed, self.decisions]).generate_state((1 + cells) * workers).astype(int)
        seeds = draws.reshape(workers, 1 + cells).tolist()
        frames = TURNS * cells * workers
        if config.collector == "local":
            self._policy = AecPolicy(self.env.rules, self.model, config, cells, explore, seeds[0][0])
            own = make_env(config, seeds[0][1:], self.model)
            return Collector(own, self._policy, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=False)
        makers = [partial(make_env, config, own[1:]) for own in seeds]
        actors = [partial(WorkerPolicy, config, cells, own[0]) for own in seeds]
        if config.collector == "ray":
            self._cluster.enter_context(_cluster(workers))
            return _ray_actors([*makers], [*actors], frames)
        others = set(multiprocessing.active_children())
        born: set[BaseProcess] = set()

        def started() -> set[BaseProcess]:
            born.update(set(multiprocessing.active_children()) - others)  # it forgets those that have ended
            return born

        return watched(partial(_processes, [*makers], [*actors], frames), started)

    def _finished(self, turns: TensorDict) -> tuple[TensorDict | None, torch.Tensor]:
        """Rows of the episodes that ended, and their number, that of the solved ones, and the transfers they took."""
        if self._running is not None:
            turns = torch.cat([self._running, turns])
        turns = turns[turns["cell"].argsort(stable=True)]
        cell, position = turns["cell"], torch.arange(len(turns), device=turns["cell"].device)
        end = torch.where(turns["next", "done"][:, 0], position, -1)
        last_end = torch.full((int(cell.max()) + 1,), -1, device=cell.device).scatter_reduce(0, cell, end, "amax") if len(cell) else end
        over = position <= last_end[cell]
        self._running, whole = turns[~over], turns[over]
        ends = whole["next", "done"][:, 0].nonzero()[:, 0]
        if len(ends) == 0:
            return None, torch.zeros(3)
        rows, transfers = self._rows(whole, ends), whole["next", "info", "transfers"][ends]
        return rows, torch.tensor([len(ends), int(self._solved(rows[ends]).sum()), int(transfers.sum())]).float()

    def _solved(self, rows: TensorDict) -> torch.Tensor:
        """Whether these last decisions solved their problems; one that ran out of transfers did not."""
        rules = self.env.rules
        final, feasible, epsilon = rules.decode(rows["action"]).final, rows["feasible"][:, 0], rows["epsilon"][:, 0]
        verdict = rules.judge(rows["placed"], rows["desired_goal"], final, feasible, epsilon)
        return (verdict.outcome == int(Outcome.SUCCESS)) & rows["terminated"][:, 0]

    def _rows(self, turns: TensorDict, ends: torch.Tensor) -> TensorDict:
        """Turns of whole episodes as a replay memory keeps them."""
        pose, goal, previous = supervisor_fields(turns["observation"], self.fields)
        info = turns["next", "info"]
        first = torch.cat([ends.new_zeros(1), ends[:-1] + 1])
        length = ends + 1 - first
        elapsed = torch.arange(len(turns), device=ends.device) - first.repeat_interleave(length)
        rows = TensorDict(
            {
                "achieved_goal": pose,
                "desired_goal": goal,
                "previous_arm": previous.long()[:, None],
                "action": turns["action"],
                "placed": info["placed"],
                "feasible": info["feasible"][:, None] > 0,
                "epsilon": turns["epsilon"],
                "terminated": turns["next", "terminated"],
                "remaining": (length.repeat_interleave(length) - 1 - elapsed)[:, None],
                "elapsed": elapsed[:, None],
            },
            turns.batch_size,
        )
        if self.env.rules.external_finish:  # without it, no command is ignored
            rows["ignored"] = info["ignored"][:, None] > 0
        return rows


def watched(work: Callable[[], Result], workers: Callable[[], Iterable[BaseProcess]]) -> Result:
    """The result of ``work``, for which it may wait as long as all of ``workers`` live.

    From one that was killed TorchRL can wait for an answer for ever: where it does not look whether it lives, and where a worker died with
    a lock that the others need, or in the middle of a message. So the waiting is done in a thread, which is left behind then.

    Raises:
        ChildProcessError: a worker is gone, and the work did not end by itself.
    """
    done: Future[Result] = Future()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    while not wait([done], LOOK_S).done:
        dead = next((worker for worker in workers() if worker.exitcode is not None), None)
        if dead is not None and not wait([done], GRACE_S).done:
            raise ChildProcessError(f"process {dead.pid} ended with {dead.exitcode}")
    return done.result()


def _shut_down(collector: BaseCollector) -> None:
    """End the workers, those that do not listen any more too."""
    closing = threading.Thread(target=collector.shutdown, daemon=True)
    closing.start()
    closing.join(SHUTDOWN_S)
    for worker in getattr(collector, "procs", ()):
        if not worker._closed and worker.is_alive():
            worker.kill()
            worker.join(GRACE_S)


def _cluster(workers: int) -> AbstractContextManager[Any]:
    """The Ray cluster this process belongs to, else that of ``RAY_ADDRESS``, else one of its own on this machine."""
    ray = require_ray("collector=ray")
    cores = max(workers, os.cpu_count() or 1)
    return connected(ray, os.environ.get("RAY_ADDRESS", "local"), cores, "RAY_ADDRESS")


def _processes(makers: list[Callable[[], Any]], actors: list[Callable[[], Any]], frames: int) -> BaseCollector:
    """One process a worker on this machine."""
    return MultiSyncCollector(
        makers,
        policy_factory=actors,
        frames_per_batch=frames,
        total_frames=-1,
        cat_results="stack",
        num_threads=torch.get_num_threads(),  # or it changes that of this process
        weight_sync_schemes={"policy": MultiProcessWeightSyncScheme()},
    )


def _ray_actors(makers: list[Callable[[], Any]], actors: list[Callable[[], Any]], frames: int) -> BaseCollector:
    """One Ray actor a worker."""
    from torchrl.collectors.distributed import RayCollector

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The policy is not an nn.Module")  # the workers' are, which is what counts
        return RayCollector(
            makers,
            policy_factory=actors,
            frames_per_batch=frames,
            total_frames=sys.maxsize,  # it takes -1 for nothing at all
            sync=True,
            remote_configs={"num_cpus": 1},
        )
