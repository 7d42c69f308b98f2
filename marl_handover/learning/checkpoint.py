"""Checkpoints: one file of plain tensors, dictionaries and text, replaced as a whole, loaded with ``weights_only=True``.

And the policy of a checkpoint as plain arrays, which :mod:`marl_handover.policies` evaluates without torch.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.cell import load_cell, with_carried_robots
from marl_handover.compose import from_text
from marl_handover.errors import CheckpointMismatch, CorruptFile, HandoverError, MissingFile, first_line
from marl_handover.files import open_bounded, writing
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.variant import make_variant

FILE = "checkpoint.pt"
FORMAT = 2
PARTS = {
    **dict.fromkeys(("counters", "algorithm", "replay", "experience", "last", "best", "losses", "random"), dict),
    **{"config": str, "rollout": list, "recent": torch.Tensor},
}


LIMIT_BYTES = 16_000_000_000
"""No checkpoint is larger: it has room for a replay memory of 100 million decisions."""


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write ``checkpoint.pt``; a process that is killed, or has no room, leaves the old one whole. Raises :class:`CannotWrite`."""
    with writing(folder / FILE) as stream:
        torch.save({"format": FORMAT, **state}, stream)


def load_checkpoint(folder: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a run directory's checkpoint.

    Raises:
        MissingFile: no folder, or no checkpoint in it.
        CorruptFile: truncated, changed since it was written, or not a checkpoint.
        CheckpointMismatch: written by another format of this package.
    """
    if not folder.is_dir():
        raise MissingFile("run directory", folder)
    path = folder / FILE
    if not path.exists():
        raise MissingFile("checkpoint", path, "the run was stopped before its first checkpoint; start it again")
    with open_bounded(path, LIMIT_BYTES, "checkpoint") as stream:
        try:
            _require_whole(stream)
            state = torch.load(stream, map_location=device, weights_only=True)
            _require_stored(state)
        except Exception as error:  # torch raises many kinds, from zip, pickle and its own
            raise CorruptFile("checkpoint", path, "it is truncated, damaged or no checkpoint; restore a copy or train again") from error
    if not isinstance(state, dict) or "format" not in state:
        raise CorruptFile("checkpoint", path, "it holds no marl_handover state")
    if state["format"] != FORMAT:
        raise CheckpointMismatch(path, "format", state["format"], FORMAT)
    missing = [part for part in PARTS if part not in state]
    if missing:
        raise CorruptFile("checkpoint", path, f"it lacks {', '.join(missing)}")
    wrong = [part for part, kind in PARTS.items() if not isinstance(state[part], kind)]
    if wrong or (state["best"] and not state["best"].keys() >= {"actor", "score", "step"}):
        raise CorruptFile("checkpoint", path, f"its {' and '.join(wrong or ['best'])} cannot be of a run")
    return state


def _require_whole(stream: BinaryIO) -> None:
    """Compare the checksums that every part of the file has, which torch does not; raise :class:`ValueError` if one is wrong.

    Parts are stored as they are: packed ones could grow without limit. A part that is marked as a folder torch takes for one with
    whatever is in memory. Leaves the stream at its beginning.
    """
    with zipfile.ZipFile(stream) as archive:
        for part in archive.infolist():
            if part.compress_type != zipfile.ZIP_STORED or part.external_attr:
                raise ValueError(f"{part.filename} was not written by torch")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged} has changed")
    stream.seek(0)


def _require_stored(value: Any) -> None:
    """Raise :class:`ValueError` for a tensor of more numbers than the file holds, as of one that is repeated."""
    if isinstance(value, torch.Tensor):
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise ValueError(f"a tensor of shape {tuple(value.shape)} is not all there")
    elif isinstance(value, dict):
        _require_stored(list(value.values()))
    elif isinstance(value, list | tuple):
        for part in value:
            _require_stored(part)


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
        "chart": algorithm.rules.cell.chart_name,
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
    """The settings stored in a checkpoint, or beside it, as YAML text; its robots are those that its folder carries."""
    config: TrainConfig = from_text(TrainConfig, text, path, {"algorithm": ALGORITHMS})
    config.cell = with_carried_robots(config.cell, path.parent)
    return config
