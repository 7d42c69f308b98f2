"""Who can pass to whom: arms are nodes, shared spaces are edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse.csgraph import connected_components

from marl_handover.cell.shared_space import SharedSpace


@dataclass(frozen=True)
class HandoverGraph:
    """The hand-over graph of a cell.

    Attributes:
        names: of the arms, in their order.
        edges: (i, j), i < j, -> what arms i and j share; only pairs that share something.
    """

    names: tuple[str, ...]
    edges: Mapping[tuple[int, int], SharedSpace]

    def neighbours(self, arm: int) -> tuple[int, ...]:
        """The arms to which ``arm`` can pass an object."""
        return tuple(other for other in range(len(self.names)) if (min(arm, other), max(arm, other)) in self.edges)

    @cached_property
    def components(self) -> tuple[tuple[int, ...], ...]:
        """Arms between which an object can travel, group by group."""
        count = len(self.names)
        adjacency = np.zeros((count, count), bool)
        for i, j in self.edges:
            adjacency[i, j] = True
        groups, label = connected_components(adjacency, directed=False)
        return tuple(tuple(int(arm) for arm in np.flatnonzero(label == group)) for group in range(groups))

    @property
    def is_connected(self) -> bool:
        """Whether every arm can pass to every other, by way of others if need be."""
        return len(self.components) == 1
