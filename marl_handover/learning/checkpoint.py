"""Checkpoints: one file of plain tensors, dictionaries and text, replaced as a whole, loaded with ``weights_only=True``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from marl_handover.errors import CheckpointMismatch, CorruptFile, MissingFile

FILE = "checkpoint.pt"
FORMAT = 2
PARTS = ("config", "counters", "algorithm", "replay", "experience", "rollout", "recent", "last", "best", "losses", "random")


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write ``checkpoint.pt``: to a temporary file first, so that a killed process leaves the old one whole."""
    path = folder / FILE
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as stream:
        torch.save({"format": FORMAT, **state}, stream)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def load_checkpoint(folder: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a run directory's checkpoint.

    Raises:
        MissingFile: no folder, or no checkpoint in it.
        CorruptFile: truncated, or not a checkpoint.
        CheckpointMismatch: written by another format of this package.
    """
    if not folder.is_dir():
        raise MissingFile("run directory", folder)
    path = folder / FILE
    if not path.exists():
        raise MissingFile("checkpoint", path, "the run was stopped before its first checkpoint; start it again")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds, from zip, pickle and its own
        raise CorruptFile("checkpoint", path, "it is truncated or no checkpoint; restore a copy or train again") from error
    if not isinstance(state, dict) or "format" not in state:
        raise CorruptFile("checkpoint", path, "it holds no marl_handover state")
    if state["format"] != FORMAT:
        raise CheckpointMismatch(path, "format", state["format"], FORMAT)
    missing = [part for part in PARTS if part not in state]
    if missing:
        raise CorruptFile("checkpoint", path, f"it lacks {', '.join(missing)}")
    return state
