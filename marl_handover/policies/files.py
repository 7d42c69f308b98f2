"""Policy files: one ``.npz`` of plain arrays, and JSON of what they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.compose import from_mapping
from marl_handover.config import CellConfig, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.errors import CorruptFile
from marl_handover.files import read_arrays
from marl_handover.learning.graph_network import layer_sizes, stored_shape
from marl_handover.parsing import parse_object
from marl_handover.task.observations import observation_size

KINDS = {
    "hybrid": "marl_handover.policies.actor:NetworkPolicy",
    "box": "marl_handover.policies.actor:NetworkPolicy",
    "centralised": "marl_handover.policies.centralised:CentralisedPolicy",
    "centralised_box": "marl_handover.policies.centralised:CentralisedPolicy",
    "discrete": "marl_handover.policies.actor:DiscretePolicy",
    "graph": "marl_handover.policies.graph_policy:GraphPolicy",
    "turns": "marl_handover.policies.actor:TurnsPolicy",
}
"""Forms of an actor, and the class that evaluates each, imported when it is needed."""

VARIANTS = {"centralised": "centralised", "centralised_box": "centralised", "turns": "decentralised"}
"""The variant that trains actors of a form; the others are hierarchical."""

LIMIT_BYTES = 100_000_000
COUNTS = {"layers": (1, 100), "networks": (1, 100), "modes": (1, 1000), "harmonics": (0, 16)}
"""Least and largest values of the whole numbers that a policy file says of itself."""

Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]


def stored_settings(about: Mapping[str, Any]) -> tuple[CellConfig, TaskConfig]:
    """The cell and the task a policy file was trained with."""
    if "block" not in about["cell"]:  # a stored cell is whole: what it lacks is not for defaults to fill
        raise KeyError("cell.block")
    task = dict(about["task"])
    task["reward"], task["noise"] = RewardConfig(**task["reward"]), NoiseConfig(**task["noise"])
    return from_mapping(CellConfig, about["cell"], Path("policy file")), TaskConfig(**task)


def read_policy(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a policy file; no pickled objects are read.

    Raises:
        MissingFile, CorruptFile: if it is not there, not whole, too large, or no policy (:func:`require_policy`).
    """
    arrays = read_arrays(path, LIMIT_BYTES, "policy file")
    require_policy(arrays, path, "policy file")
    return arrays


def require_policy(arrays: Mapping[str, NDArray[Any]], path: Path, what: str) -> None:
    """See that arrays are a policy: it says what it is, and its weights are real, finite and fit together.

    Raises:
        CorruptFile: it is none. ``path`` and ``what`` are for the message.
    """
    try:
        about = parse_object(str(arrays["about"]))
        _require_known(about)
        for network in range(about.get("networks", 1)):
            layers = network_layers(arrays, about, network)
            if about["kind"] == "graph":
                _check_sizes(layers, layer_sizes(stored_shape(about["shape"])))
            else:
                _check_chain(layers)
        observation_size(about["layout"])
        stored_settings(about)
    except Exception as error:  # json and the settings raise many kinds
        reason = str(error)[:100] if isinstance(error, (_NotPolicy, KeyError, TypeError)) else "it is damaged or no policy"
        raise CorruptFile(what, path, reason) from error


class _NotPolicy(ValueError):
    """What is wrong with it, in words for people."""


def _require_known(about: Mapping[str, Any]) -> None:
    if about["kind"] not in KINDS:
        raise _NotPolicy(f"its kind is {str(about['kind'])[:40]!r}, not one of {', '.join(KINDS)}")
    variant = VARIANTS.get(about["kind"], "hierarchical")
    if about["variant"] != variant:
        raise _NotPolicy(f"its kind is {about['kind']!r}, of variant {variant}, but it says variant {str(about['variant'])[:40]!r}")
    for name, (least, most) in COUNTS.items():
        value = about.get(name, least)
        if type(value) is not int or not least <= value <= most:
            raise _NotPolicy(f"its {name} is {str(value)[:40]}, not a number from {least} to {most}")


def network_layers(arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any], network: int = 0) -> Layers:
    """Weights (inputs, outputs) and biases (outputs,) of one of the file's networks; most files hold one."""
    prefix = f"{network}/" if network else ""
    return [(arrays[f"{prefix}weight_{index}"], arrays[f"{prefix}bias_{index}"]) for index in range(about["layers"])]


def _check_sizes(layers: Layers, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise unless every number is real and finite, and there are all layers, of the sizes (inputs, outputs) that they are to have."""
    _check_numbers(layers)
    found = [(*weight.shape, *bias.shape) for weight, bias in layers]
    for index, (name, size) in enumerate(sizes.items()):
        if found[index : index + 1] != [(*size, size[1])] or len(found) != len(sizes):
            raise _NotPolicy(f"layer {index} ({name}) has other numbers of inputs and outputs than {size[0]} and {size[1]}")


def _check_numbers(layers: Layers) -> None:
    for index, layer in enumerate(layers):
        for name, array in zip(("weight", "bias"), layer, strict=True):
            if array.dtype.kind != "f" or not np.isfinite(array).all():
                raise _NotPolicy(f"{name} {index} has numbers that are not real and finite ({array.dtype})")


def _check_chain(layers: Layers) -> None:
    """Raise unless every number is real and finite, and each layer takes what the one before gives."""
    _check_numbers(layers)
    width = None
    for index, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or width not in (None, len(weight)):
            raise _NotPolicy(f"layer {index} has shapes {weight.shape} and {bias.shape}, which do not fit together")
        width = len(bias)
