"""Arms in files and figures: what a file calls them, which arm of a cell that is, and the mark at its base."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.errors import InvalidSetting, listed


def stored_labels(content: Mapping[str, Any]) -> tuple[str, ...]:
    """What the arms are called in a file that holds its cell under ``cell_settings``: names, or L and R of a mirrored pair.

    Raises:
        TypeError, KeyError, AttributeError: that is no cell.
    """
    return tuple(str(arm["name"]) for arm in content.get("cell_settings", {}).get("arms", ())) or ARM_LETTERS


def arm_index(cell: Cell, label: str) -> int:
    """The arm of that label. Raises :class:`InvalidSetting` if there is none: the file is of another cell."""
    if label not in cell.labels:
        raise InvalidSetting("cell", cell.config.name, f"the cell of the file, with an arm {label!r}; this one has {listed(cell.labels)}")
    return cell.labels.index(label)


def marks(cell: Cell) -> list[str]:
    """One character or two for each arm: the first letter of its label, or its number where letters are not enough."""
    letters = [label[:1] for label in cell.labels]
    return letters if len(set(letters)) == len(letters) else [str(number) for number in range(1, cell.num_arms + 1)]
