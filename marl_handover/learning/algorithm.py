"""What the trainer asks of an algorithm."""

from __future__ import annotations

import logging
import os
import shutil
import sysconfig
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_handover.cell.chart import PaperChart
from marl_handover.errors import InvalidSetting
from marl_handover.learning.settings import ALGORITHMS, AlgorithmConfig, OffPolicyConfig, TrainConfig
from marl_handover.progress import working
from marl_handover.task.rules import Rules

EDGE = 1.15
"""Random places are drawn from a chart, or an interval, this much too large and brought back to its edge."""

KNOTS = 4097
"""Of the table that turns chart coordinates that are uniform into ones whose places are."""


class Places:
    """Chart coordinates whose places are uniform on the table.

    The chart is one-to-one, and its stretch at (alpha, beta) is the width of the shared space at alpha; so beta stays, and alpha goes
    through the inverse of the width's cumulative sum.

    Args:
        chart: of the shared space.
        device: of the coordinates.
    """

    def __init__(self, chart: PaperChart, device: torch.device | str = "cpu") -> None:
        knots = torch.linspace(-1.0, 1.0, KNOTS, dtype=torch.float64)
        width = chart.y_max_mm(knots * (chart.inset * chart.x_max_mm))
        share = torch.cat([width.new_zeros(1), torch.cumulative_trapezoid(width, knots)])
        self.knots = knots.float().to(device)
        self.levels = (2 * share / share[-1] - 1).float().to(device)

    def spread(self, place: Tensor) -> Tensor:
        """Coordinates (..., 2), uniform on [-1, 1]^2, as ones that are uniform on the table; monotone, edges stay edges."""
        level = place[..., 0].contiguous()
        upper = torch.searchsorted(self.levels, level).clamp(1, KNOTS - 1)
        low, high = self.levels[upper - 1], self.levels[upper]
        part = ((level - low) / (high - low)).clamp(0.0, 1.0)
        alpha = torch.lerp(self.knots[upper - 1], self.knots[upper], part)
        return torch.stack([alpha, place[..., 1]], -1)


class UniformActions:
    """Draws uniform actions as ``algorithm.exploration`` says.

    Args:
        rules: for the size of an action and the chart.
        config: settings of training.

    Raises:
        InvalidSetting: ``area`` for actions that are more than (final, arm, alpha, beta).
    """

    def __init__(self, rules: Rules, config: TrainConfig) -> None:
        own = config.algorithm
        self.size = rules.action_size
        self.places = None
        if isinstance(own, OffPolicyConfig) and own.exploration == "area":
            if self.size != Rules.action_size:
                raise InvalidSetting("algorithm.exploration", own.exploration, f"'chart' for variant={config.variant}")
            self.places = Places(rules.cell.paper_chart("algorithm.exploration=area"), config.device)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Actions (count, size)."""
        action = torch.rand(count, self.size, generator=generator, device=generator.device) * 2 - 1
        return torch.cat([action[:, :2], self.spread(action[:, 2:])], -1) if self.places else action

    def spread(self, place: Tensor) -> Tensor:
        """Places (..., 2), uniform in the chart, as ``exploration`` wants them."""
        return self.places.spread(place) if self.places else place


logger = logging.getLogger(__name__)


LEARNERS: dict[str, type[Algorithm]] = {}
"""Learners of variant=hierarchical by the name of their algorithm; :data:`ALGORITHMS` imports the module that registers one."""

Learner = TypeVar("Learner", bound="type[Algorithm]")


def register_algorithm(settings: type[AlgorithmConfig]) -> Callable[[Learner], Learner]:
    """A decorator for the learner of ``settings``, whose field ``name`` says what it is called."""

    def add(learner: Learner) -> Learner:
        ALGORITHMS.register(settings.name)(settings)
        LEARNERS[settings.name] = learner
        return learner

    return add


class Algorithm(ABC):
    """A learner of the supervisor's policy.

    ``kind`` names the form of its exported actor (see :mod:`marl_handover.learning.checkpoint`); ``on_policy`` tells the trainer
    how to feed it.
    """

    kind: ClassVar[str]

    stored: ClassVar[tuple[str, ...]] = ("loss", "optimizer")
    """Names of the attributes whose state a checkpoint must hold: networks with their losses, and optimisers."""

    config: AlgorithmConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        self.rules, self.config, self.generator = rules, config.algorithm, generator
        self.device = torch.device(config.device)
        self.uniform = UniformActions(rules, config)
        self.progress = 0.0  # how much of the training is done

    def random_action(self, observation: Tensor) -> Tensor:
        """Uniform actions (n, action_size), to start with."""
        return self.uniform.draw(len(observation), self.generator)

    @abstractmethod
    def explore(self, observation: Tensor) -> Tensor:
        """Actions (n, 4) to train with, drawn with the algorithm's own generator."""

    @abstractmethod
    def act(self, observation: Tensor) -> Tensor:
        """Deterministic actions (n, 4)."""

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Learn from a batch; return detached scalars to log."""

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """Everything whose state a checkpoint must hold, by name."""
        return {name: getattr(self, name) for name in self.stored}

    @abstractmethod
    def actor(self) -> nn.Module:
        """The network that :meth:`act` evaluates."""

    def trained(self) -> nn.Module:
        """The network that :meth:`explore` evaluates. Here: the actor."""
        return self.actor()

    def exported(self) -> list[list[nn.Linear]]:
        """The layers of the networks that a policy file holds. Here: of the actor."""
        return [[module for module in self.actor().modules() if isinstance(module, nn.Linear)]]

    def about(self) -> dict[str, Any]:
        """What a policy file must say besides, as JSON values."""
        return {}

    def schedule(self, fraction: float) -> None:
        """Set what changes in the course of training; ``fraction`` of it is done. Here: the learning rate."""
        self.progress = fraction
        start = self.config.lr_decay_start
        left = 1.0 if fraction <= start or start >= 1.0 else max(0.0, (1.0 - fraction) / (1.0 - start))
        for part in self.modules().values():
            if isinstance(part, torch.optim.Optimizer):
                for group in part.param_groups:
                    group["lr"] = self.config.learning_rate * left

    def state_dict(self) -> dict[str, Any]:
        """Plain state dicts of all parts."""
        return {name: part.state_dict() for name, part in self.modules().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        for name, part in self.modules().items():
            part.load_state_dict(state[name])

    def _anywhere(self, shape: tuple[int, ...]) -> Tensor:
        """Places spread evenly over [-1, 1], with a share exactly on the edge, where the largest turns are made."""
        return ((2 * self._uniform(shape) - 1) * EDGE).clamp(-1.0, 1.0)

    def _uniform(self, shape: tuple[int, ...]) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.device)

    def _gaussian(self, shape: tuple[int, ...]) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.device)


def stepped(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """One step of an optimiser down a loss."""
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def compiled(function: Callable[..., Any], mode: str) -> Callable[..., Any]:
    """``function`` compiled, or itself.

    What was compiled in this process before is forgotten, and compiled again if it is still used. Torch keeps eight versions of a function
    and runs the ninth uncompiled, so that a run would be slower, and round otherwise, for coming after others in the same process.

    Args:
        function: takes and returns tensors.
        mode: ``off``; ``auto``: compile where that is possible, else say so in one line and run it as it is; ``on``: or raise.

    Raises:
        InvalidSetting: ``on`` without a compiler.
    """
    if mode == "on" and not can_compile():
        raise InvalidSetting("compile", mode, "auto or off on a machine without a C++ compiler and Python's headers (see doctor)")
    if mode == "off" or not can_compile():
        return function
    torch.compiler.reset()
    return _Compiled(function, torch.compile(function, dynamic=False), falls_back=mode == "auto")


def compile_state(owner: object) -> str:
    """What the functions that ``owner`` has from :func:`compiled` run as, or would: ``compiled``, ``failed`` or ``plain``."""
    parts = [part for value in vars(owner).values() for part in (value if isinstance(value, list) else [value])]
    functions = [part for value in parts for part in (value if isinstance(value, tuple) else [value])]
    tried = [function for function in functions if isinstance(function, _Compiled)]
    if any(function.chosen is function.plain for function in tried):
        return "failed"
    return "compiled" if tried else "plain"


class _Compiled:
    """Calls the compiled function, which compiles it at the first call; if that fails and it may, the plain one from then on."""

    def __init__(self, plain: Callable[..., Any], fast: Callable[..., Any], falls_back: bool) -> None:
        self.plain, self.chosen, self.falls_back, self.proven = plain, fast, falls_back, False

    def __call__(self, *arguments: Any) -> Any:
        if self.proven:
            return self.chosen(*arguments)
        try:
            with working("compiling the losses; once in a run"):
                result = self.chosen(*arguments)
        except Exception as error:  # the compiler's failures have many types
            if not self.falls_back:
                raise
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            logger.warning("torch.compile failed (%s); training goes on uncompiled, which is slower", reason)
            self.chosen = self.plain
            result = self.plain(*arguments)
        self.proven = True
        return result


def can_compile() -> bool:
    """Whether ``torch.compile`` finds what it needs on this machine: a C++ compiler, and Python's header files."""
    chosen = os.environ.get("CXX")
    names = (chosen,) if chosen else ("g++", "clang++")
    header = Path(sysconfig.get_path("include")) / "Python.h"
    return any(shutil.which(name) for name in names) and header.exists()


@contextmanager
def subnormals_flushed() -> Iterator[None]:
    """Within, numbers too small to be normal are 0 on this thread's processor.

    The moments Adam keeps of a unit that never fires decay into that range, where every operation is many times slower: of the paper's
    networks half the numbers get there, and a gradient step costs a fifth more. Afterwards they are kept, as is torch's default;
    what was set before cannot be asked.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


class OwnTorch:
    """Threads and random states of torch that a training has for itself: a context manager, after which the caller's are as they were.

    What it left is there again the next time. Uses may nest; the outermost one counts.

    Args:
        threads: of the CPU.
        seed: of the random states at first.
        device: whose random state is meant, beside the CPU's.
    """

    def __init__(self, threads: int, seed: int, device: torch.device) -> None:
        self._threads, self._seed = threads, seed
        self._cuda = [torch.cuda.current_device() if device.index is None else device.index] if device.type == "cuda" else []
        self._own: list[Tensor] | None = None
        self._outer: tuple[int, list[Tensor]] | None = None
        self._depth = 0

    def __enter__(self) -> None:
        self._depth += 1
        if self._depth > 1:
            return
        self._outer = torch.get_num_threads(), self._states()
        torch.set_num_threads(self._threads)
        if self._own is None:
            torch.manual_seed(self._seed)
        else:
            self._set(self._own)

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth or self._outer is None:
            return
        self._own = self._states()
        threads, states = self._outer
        torch.set_num_threads(threads)
        self._set(states)

    def _states(self) -> list[Tensor]:
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state(index) for index in self._cuda)]

    def _set(self, states: list[Tensor]) -> None:
        torch.set_rng_state(states[0])
        for index, state in zip(self._cuda, states[1:], strict=True):
            torch.cuda.set_rng_state(state, index)
