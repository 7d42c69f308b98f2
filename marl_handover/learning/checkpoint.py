"""Checkpoints: one file of plain tensors, dictionaries and text, replaced as a whole, loaded with ``weights_only=True``."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch

from marl_handover.errors import CheckpointMismatch, CorruptFile, MissingFile
from marl_handover.files import open_bounded, writing

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
