"""Policy files: one ``.npz`` of plain arrays, and JSON of what they are."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.config import CellConfig, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.task.observations import observation_size

KINDS = {
    "hybrid": "marl_handover.policies.network:NetworkPolicy",
    "box": "marl_handover.policies.network:NetworkPolicy",
    "centralised": "marl_handover.policies.centralised:CentralisedPolicy",
    "centralised_box": "marl_handover.policies.centralised:CentralisedPolicy",
    "discrete": "marl_handover.policies.discrete:DiscretePolicy",
    "turns": "marl_handover.policies.decentralised:TurnsPolicy",
}
"""Forms of an actor, and the class that evaluates each, imported when it is needed."""

Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]


def stored_settings(about: Mapping[str, Any]) -> tuple[CellConfig, TaskConfig]:
    """The cell and the task a policy file was trained with."""
    cell = dict(about["cell"])
    cell["block"] = type(CellConfig().block)(**cell["block"])
    task = dict(about["task"])
    task["reward"], task["noise"] = RewardConfig(**task["reward"]), NoiseConfig(**task["noise"])
    return CellConfig(**cell), TaskConfig(**task)


def read_policy(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a policy file; no pickled objects are read.

    Raises:
        MissingFile, CorruptFile: if it is not there, or not whole.
    """
    if not path.exists():
        raise MissingFile("policy file", path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        about = json.loads(str(arrays["about"]))
        for network in range(about.get("networks", 1)):
            _check_chain(network_layers(arrays, about, network))
        if about["kind"] not in KINDS:
            raise ValueError(f"its kind is {about['kind']!r}, not one of {', '.join(KINDS)}")
        observation_size(about["layout"])
        stored_settings(about)
    except Exception as error:  # numpy, zip and json raise many kinds
        reason = str(error).splitlines()[0] if isinstance(error, (KeyError, TypeError)) or "layer" in str(error) else "damaged or no policy"
        raise CorruptFile("policy file", path, f"{reason}; export it again") from error
    return arrays


def network_layers(arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any], network: int = 0) -> Layers:
    """Weights (inputs, outputs) and biases (outputs,) of one of the file's networks; most files hold one."""
    prefix = f"{network}/" if network else ""
    return [(arrays[f"{prefix}weight_{index}"], arrays[f"{prefix}bias_{index}"]) for index in range(about["layers"])]


def _check_chain(layers: Layers) -> None:
    """Raise :class:`ValueError` unless each layer takes what the one before gives."""
    width = layers[0][0].shape[0]
    for index, (weight, bias) in enumerate(layers):
        if weight.shape != (width, len(bias)):
            raise ValueError(f"layer {index} has shape {weight.shape}")
        width = len(bias)
