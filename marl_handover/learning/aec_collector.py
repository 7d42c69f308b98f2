"""Transitions from the AEC environment itself, executors and all, played by TorchRL's collectors here, in processes or on a Ray cluster."""

from __future__ import annotations

import math
import multiprocessing
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.collectors import Collector as LocalCollector
from torchrl.envs import SerialEnv
from torchrl.weight_update import MultiProcessWeightSyncScheme

from marl_handover.cell import CellModel, build_cell
from marl_handover.cluster import connected, require_ray
from marl_handover.config import MotionConfig
from marl_handover.envs import handover_aec
from marl_handover.envs.flat_aec import FlatAEC, FlatHandover, fields_of
from marl_handover.envs.spaces import SUPERVISOR, Spaces
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import HandoverError, WorkFailed, first_line
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.collector import Collected, Collector, Explore, TransitionReader
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.variant import make_variant
from marl_handover.motion.executor import ExecutorAgent, arm_agents
from marl_handover.plugins import Parcel
from marl_handover.task.observations import observe
from marl_handover.task.rules import Outcome, Rules

ACTIONS = 4
"""Numbers in the supervisor's action."""

METHODS = ("random_action", "explore")
"""Methods of an algorithm that training lets act."""


def make_env(config: TrainConfig, seeds: Sequence[int], model: CellModel | None = None) -> SerialEnv:
    """Environments (n,) that a run asks for, as TorchRL plays them; ``seeds`` (n) decide their problems and their backends' noise."""
    model = model or build_cell(config.cell)

    def one(seed: int) -> FlatHandover:
        return FlatHandover(FlatAEC(handover_aec.env(backend=config.backend, cell=model, task=config.task)), seed)

    return SerialEnv(len(seeds), [partial(one, seed) for seed in seeds])


def supervisor_fields(observation: Any, fields: Mapping[str, tuple[slice, Any]]) -> tuple[Any, Any, Any]:
    """Pose (..., 3), goal (..., 3) and previous arm (...), -1 for none, of flat observations (..., size) of the supervisor."""
    previous = observation[..., fields["previous_arm"][0]][..., 0]
    return observation[..., fields["state"][0]], observation[..., fields["goal"][0]], previous - 1


class AecPolicy(TensorDictModuleBase):
    """Actions of whichever agent's turn it is, in a batch of environments (n,).

    Each episode's epsilon is drawn log-uniformly from ``epsilon_range_rad`` and shown to the supervisor. The environment does not know it
    and judges at the task's; replay judges again, at the epsilon it draws. In architecture B an episode's course does not depend on it.

    Exploration is always asked for all environments at once, each in its own row, because some algorithms treat rows differently.

    Args:
        rules: rule book that observations are made by.
        model: the cell, for the executors.
        config: the run.
        count: number of environments, n.
        explore: the supervisor's actions.
        seed: of the epsilons.
    """

    def __init__(self, rules: Rules, model: CellModel, config: TrainConfig, count: int, explore: Explore, seed: int) -> None:
        super().__init__()
        motion = MotionConfig()
        spaces = Spaces(model, motion)
        arms = arm_agents(model.cell)
        self.in_keys = [(agent, key) for agent in (SUPERVISOR, *arms) for key in ("mask", "observation")] + [(SUPERVISOR, "info")]
        self.out_keys = [(SUPERVISOR, "action"), (SUPERVISOR, "epsilon"), *((arm, "action") for arm in arms)]
        self.rules, self.explore = rules, explore
        self.device_of_learner = torch.device(config.device)
        self.epsilon_range_rad = (rules.epsilon_rad, rules.epsilon_rad)
        self._fields = {agent: fields_of(space) for agent, space in spaces.observation.items()}
        self._widths = {agent: width(space) for agent, space in spaces.action.items()}
        self._arms = {agent: ExecutorAgent(agent, model, config.executor, motion) for agent in arms}
        self._random = np.random.default_rng(seed)
        self._epsilon = np.full(count, rules.epsilon_rad)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the actions of all agents, zeros for those whose turn it is not, and the ``epsilon`` the supervisor acts for."""
        turn = tensordict[SUPERVISOR, "mask"]
        action = torch.zeros(len(turn), 1, ACTIONS)
        if turn.any():
            action[turn] = self._commands(tensordict[SUPERVISOR], turn[:, 0].numpy())[turn[:, 0]]
        tensordict.set((SUPERVISOR, "action"), action)
        tensordict.set((SUPERVISOR, "epsilon"), torch.from_numpy(self._epsilon.astype(np.float32))[:, None, None])
        for agent in self._arms:
            answers = torch.zeros(len(turn), 1, self._widths[agent])
            for row in tensordict[agent, "mask"][:, 0].nonzero()[:, 0].tolist():
                answers[row, 0] = self._answer(agent, tensordict[agent, "observation"][row, 0])
            tensordict.set((agent, "action"), answers)
        return tensordict

    def _commands(self, seen: TensorDictBase, turn: NDArray[np.bool_]) -> Tensor:
        """Actions (n, 4); ``turn`` (n,) says whose are wanted."""
        begins = turn & (seen["info", "transfers"][:, 0].numpy() == 0)
        low, high = self.epsilon_range_rad
        self._epsilon[begins] = np.exp(self._random.uniform(math.log(low), math.log(high), begins.sum()))
        pose, goal, previous = supervisor_fields(seen["observation"][:, 0].numpy(), self._fields[SUPERVISOR])
        observation = observe(self.rules, self.rules.config.layout, pose, goal, previous, self._epsilon)
        return self.explore(torch.from_numpy(observation.astype(np.float32)).to(self.device_of_learner)).cpu()

    def _answer(self, agent: str, observation: Tensor) -> Tensor:
        numbers = observation.numpy()
        action = self._arms[agent].act({name: numbers[part] for name, (part, _) in self._fields[agent].items()})
        return torch.from_numpy(np.concatenate([np.reshape(value, -1) for value in action.values()], dtype=np.float32))


class WorkerPolicy(AecPolicy):
    """The same in another process, with a learner of its own that is told the trained one's weights, how far training is, and no more.

    Its two parameters are what TorchRL keeps the same as the trainer's (:func:`message`).

    Args:
        config: the run.
        count: number of environments.
        seed: of exploration, and of the epsilons.
    """

    def __init__(self, config: TrainConfig, count: int, seed: int) -> None:
        config.device, config.compile = "cpu", "off"
        torch.set_num_threads(config.threads)
        variant = make_variant(config.variant)
        rules = variant.env(config, torch.device("cpu")).rules
        self._learner = variant.algorithm(rules, config, torch.Generator().manual_seed(seed))
        super().__init__(rules, build_cell(config.cell), config, count, self._learner.random_action, seed)
        told = message(self._learner.random_action, self.epsilon_range_rad)
        self.weights = nn.Parameter(told["weights"], requires_grad=False)
        self.orders = nn.Parameter(told["orders"], requires_grad=False)
        self._obeyed = torch.empty(0)

    def _commands(self, seen: TensorDictBase, turn: NDArray[np.bool_]) -> Tensor:
        if not torch.equal(self._obeyed, self.weights):
            self._obeyed = self.weights.detach().clone()
            nn.utils.vector_to_parameters(self._obeyed, self._learner.trained().parameters())
        mode, progress, *bounds = self.orders.tolist()
        if progress != self._learner.progress:
            self._learner.schedule(progress)
        self.explore = getattr(self._learner, METHODS[int(mode)])
        self.epsilon_range_rad = (bounds[0], bounds[1])
        return super()._commands(seen, turn)


def message(explore: Explore, epsilon_range_rad: tuple[float, float]) -> dict[str, Tensor]:
    """What workers are told: ``weights`` of the network that explores, and ``orders``.

    Orders are the number of the method in :data:`METHODS`, how much of the training is done, and epsilon's range.

    Raises:
        TypeError: ``explore`` is none of these methods; other functions stay in the process they are in.
    """
    learner, name = getattr(explore, "__self__", None), getattr(explore, "__name__", "")
    if not isinstance(learner, Algorithm) or name not in METHODS:
        raise TypeError(f"workers explore by an algorithm's {' or '.join(METHODS)}, not by {explore!r}")
    weights = nn.utils.parameters_to_vector(learner.trained().parameters()).detach().cpu().clone()
    return {"weights": weights, "orders": torch.tensor([METHODS.index(name), learner.progress, *epsilon_range_rad])}


def width(space: Any) -> int:
    """Length of a space's vector."""
    return sum(part.stop - part.start for part, _ in fields_of(space).values())


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


class AecCollector(Collector):
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
        self._reader = TransitionReader(SUPERVISOR)
        self._running: TensorDict | None = None

    def collect(self, explore: Explore) -> Collected:
        """Let ``explore`` act; with workers it is :meth:`Algorithm.explore` or :meth:`Algorithm.random_action`.

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
        self._reader, self._running = TransitionReader(SUPERVISOR), None

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
            return LocalCollector(own, self._policy, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=False)
        makers = [Parcel(partial(make_env, config, own[1:])) for own in seeds]
        actors = [Parcel(partial(WorkerPolicy, config, cells, own[0])) for own in seeds]
        if config.collector == "ray":
            self._cluster.enter_context(_cluster(workers))
            return _ray_actors([*makers], [*actors], frames)
        others = set(multiprocessing.active_children())
        born: set[BaseProcess] = set()

        def started() -> set[BaseProcess]:
            born.update(set(multiprocessing.active_children()) - others)  # it forgets those that have ended
            return born

        try:
            return watched(partial(_processes, [*makers], [*actors], frames), started)
        except BaseException:
            _kill(started())  # or this process waits for them at its end
            raise

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
    _kill(getattr(collector, "procs", ()))


def _kill(workers: Iterable[BaseProcess]) -> None:
    for worker in workers:
        if not worker._closed and worker.is_alive():  # type: ignore[attr-defined]
            worker.kill()
            worker.join(GRACE_S)


def _cluster(workers: int) -> AbstractContextManager[Any]:
    """The Ray cluster this process belongs to, else that of ``RAY_ADDRESS``, else one of its own on this machine."""
    ray = require_ray("collector=ray")
    cores = max(workers, os.cpu_count() or 1)
    return connected(ray, os.environ.get("RAY_ADDRESS", "local"), cores, "RAY_ADDRESS")


def _processes(makers: list[Callable[[], Any]], actors: list[Callable[[], Any]], frames: int) -> BaseCollector:
    """One process a worker on this machine."""
    weights = MultiProcessWeightSyncScheme()
    try:
        return MultiSyncCollector(
            makers,
            policy_factory=actors,
            frames_per_batch=frames,
            total_frames=-1,
            cat_results="stack",
            num_threads=torch.get_num_threads(),  # or it changes that of this process
            weight_sync_schemes={"policy": weights},
        )
    except BaseException:
        weights.shutdown()  # by itself it would do so as the interpreter ends, and wait for ever
        raise


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
