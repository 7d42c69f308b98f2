"""From a trained algorithm to plain arrays: one ``.npz`` that :mod:`marl_handover.policies` evaluates without torch."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.cell import load_cell
from marl_handover.errors import CorruptFile, HandoverError, first_line
from marl_handover.files import writing
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.algorithm_settings import ALGORITHMS
from marl_handover.learning.checkpoint import FILE, load_checkpoint
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.variants import make_variant

Arrays = dict[str, NDArray[Any]]


def policy_arrays(algorithm: Algorithm, config: TrainConfig, origin: str) -> Arrays:
    """Weights of the deterministic policy, float32, and ``about``: JSON of what it is and which settings it was trained with.

    Args:
        algorithm: the trained algorithm.
        config: its settings.
        origin: where the weights come from, such as a run directory and step.
    """
    networks = algorithm.exported()
    about: dict[str, Any] = {
        "kind": algorithm.kind,
        "layout": config.algorithm.layout,
        "cell": asdict(config.cell),
        "task": asdict(config.task),
        "variant": config.variant,
        "layers": len(networks[0]),
        "networks": len(networks),
        "origin": origin,
        **algorithm.about(),
    }
    arrays: Arrays = {"about": np.array(json.dumps(about))}
    for number, layers in enumerate(networks):
        prefix = f"{number}/" if number else ""
        for index, layer in enumerate(layers):
            arrays[f"{prefix}weight_{index}"] = layer.weight.detach().cpu().numpy().T.astype(np.float32)
            arrays[f"{prefix}bias_{index}"] = layer.bias.detach().cpu().numpy().astype(np.float32)
    return arrays


def save_policy(path: Path, arrays: Arrays) -> None:
    """Write a policy file as a whole."""
    with writing(path) as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def run_arrays(folder: Path) -> Arrays:
    """The policy of a run directory: of all that it evaluated, the one that did best on its validation problems.

    Raises:
        MissingFile, CorruptFile, CheckpointMismatch: see :func:`load_checkpoint`.
    """
    state = load_checkpoint(folder)
    try:
        config = train_config(state["config"], folder / FILE)
        config.device, config.compile = "cpu", "off"
        config.task.layout = config.algorithm.layout
        variant = make_variant(config.variant)
        algorithm = variant.algorithm(variant.rules(load_cell(config.cell), config.task, config), config, torch.Generator())
        algorithm.load_state_dict(state["algorithm"])
        step = state["counters"]["step"]
        if state["best"]:
            algorithm.actor().load_state_dict(state["best"]["actor"])
            step = state["best"]["step"]
    except HandoverError:
        raise
    except Exception as error:  # torch and what is made of the parts raise many kinds
        raise CorruptFile("checkpoint", folder / FILE, f"its parts do not fit together ({first_line(error)[:100]})") from error
    return policy_arrays(algorithm, config, f"{folder} at step {step}")


def train_config(text: str, path: Path) -> TrainConfig:
    """The settings stored in a checkpoint as YAML text."""
    from marl_handover.compose import from_text

    config: TrainConfig = from_text(TrainConfig, text, path, {"algorithm": ALGORITHMS})
    return config
