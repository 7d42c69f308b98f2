"""What some backends can do beside carrying out transfers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@runtime_checkable
class Watchful(Protocol):
    """A backend whose object others may move: it looks before each decision."""

    same: tuple[float, float]
    """Poses nearer than this, in mm and rad, are the same as far as it can measure."""

    def watch(self) -> Floats | None:
        """Where the object lies now (3,); None if it has been out of sight since the last transfer, for longer than there is patience."""


@runtime_checkable
class Inset(Protocol):
    """A backend that places so inexactly that hand-overs have to keep clear of the edge of the shared space."""

    chart_inset: float
    """The part of the chart that hand-overs keep to."""


@runtime_checkable
class Truthful(Protocol):
    """A backend that knows where the object truly is, for reports only."""

    def true_pose(self) -> Floats:
        """The true pose (3,)."""


@runtime_checkable
class Haltable(Protocol):
    """A backend whose arms have to be stopped when a session breaks off."""

    def halt(self) -> None:
        """Stop all arms where they are."""
