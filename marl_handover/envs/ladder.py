"""The rungs of the ladder as environments of three libraries: the same problems, in the same order, as the same numbers.

``split="evaluation"`` (the default) walks through the rung's file and begins again after its last problem, or where it is seeded;
``split="training"`` draws solvable problems of the same kind, of other seeds. Without a seed the rung's own is the first.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from pettingzoo import AECEnv

from marl_handover.cell import CellModel, build_whole_cell
from marl_handover.envs import handover_aec
from marl_handover.envs.goal_env import LAYOUT, SupervisorGoalEnv
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.task.ladder import EVALUATION, RungSource, rung


def gymnasium_env(name: str, split: str = EVALUATION, render_mode: str | None = None) -> SupervisorGoalEnv:
    """A rung as a Gymnasium goal environment, which ``gymnasium.make("marl_handover/Ladder-3-Triangle-v0")`` makes as well.

    ``info`` carries ``optimum`` and, at an episode's end, ``regret``; ``reset(options={"problem": k})`` goes to problem k of the file.

    Args:
        name: of the rung.
        split: ``evaluation`` or ``training``.
        render_mode: as of :class:`SupervisorGoalEnv`.

    Raises:
        UnknownChoice, ChecksumMismatch, MissingFile: for another name or split, or a file that is not the rung's.
    """
    of = rung(name)
    return SupervisorGoalEnv("B", of.load_cell(), of.task(LAYOUT), render_mode, RungSource(of, split))


def torchrl_env(
    name: str,
    num_envs: int = 1,
    split: str = EVALUATION,
    layout: str = "graph",
    device: torch.device | str = "cpu",
    seed: int | None = None,
) -> SupervisorEnv:
    """A rung as a batched TorchRL environment: cells that are reset get the next problems, ``optimum`` (num_envs, 1) those of theirs.

    Args:
        name: of the rung.
        num_envs: number of cells.
        split: ``evaluation`` or ``training``.
        layout: of ``observation``.
        device: device of all tensors.
        seed: of noise and random problems; the rung's if None.

    Raises:
        UnknownChoice, ChecksumMismatch, MissingFile: as :func:`gymnasium_env`, or for another layout.
    """
    of = rung(name)
    return SupervisorEnv(
        num_envs, of.load_cell(), of.task(layout), device, of.seed if seed is None else seed, problems=RungSource(of, split)
    )


def pettingzoo_env(name: str, split: str = EVALUATION, **settings: Any) -> AECEnv:
    """A rung as a PettingZoo AEC environment of supervisor and arms, on exact arms, or on those that the rung's noise makes of them.

    Args:
        name: of the rung.
        split: ``evaluation`` or ``training``.
        settings: others of :class:`~marl_handover.envs.handover_aec.HandoverEnv`, such as ``backend``.

    Raises:
        UnknownChoice, ChecksumMismatch, MissingFile: as :func:`gymnasium_env`.
    """
    of = rung(name)
    if of.is_noisy:
        settings = {"backend": "noisy", "backend_options": {"missed_grasps": 0.0}} | settings
    return handover_aec.env(cell=_model(of.name), task=of.task(), problems=RungSource(of, split), **settings)


@cache
def _model(name: str) -> CellModel:
    """The arms of a rung's cell, computed once."""
    return build_whole_cell(rung(name).cell_config)
