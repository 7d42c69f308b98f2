"""One code path for numpy arrays and torch tensors.

The rule book is written once against the functions that numpy 2 and torch spell alike (``sin``, ``atan2``, ``where``,
``stack``, ``concat`` ...). Importing this module does not import torch, so an exported policy runs without it.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""A numpy array of float64."""

Array = Any
"""A numpy array or a torch tensor."""


def namespace(x: Array) -> ModuleType:
    """The module, ``torch`` or ``numpy``, whose functions apply to ``x``."""
    if isinstance(x, (np.ndarray, np.generic, float, int)):
        return np
    import torch

    return torch


def wrap(angle_rad: Array) -> Array:
    """``angle_rad`` wrapped into [-pi, pi), elementwise; any shape."""
    xp = namespace(angle_rad)
    return xp.remainder(angle_rad + math.pi, 2 * math.pi) - math.pi


def length(vector: Array) -> Array:
    """Euclidean lengths (...) of vectors (..., n). The gradient at a vector of zeros is 0; the root's own would be NaN."""
    xp = namespace(vector)
    square = (vector**2).sum(-1)
    some = square > 0
    return xp.where(some, xp.sqrt(xp.where(some, square, xp.ones_like(square))), square)


def select(values: Array, index: Array) -> Array:
    """``values[..., index]`` elementwise: ``values`` of shape (..., n), integer ``index`` of shape (...), result of shape (...)."""
    if isinstance(values, np.ndarray):
        if values.ndim == 1:
            return values[int(index)]
        rows = np.asarray(index).reshape(-1)
        if np.shape(index) != values.shape[:-1]:
            return np.take_along_axis(values, np.asarray(index)[..., None], axis=-1)[..., 0]
        # Much quicker than that where there are few.
        return values.reshape(-1, values.shape[-1])[np.arange(len(rows)), rows].reshape(values.shape[:-1])
    return values.gather(-1, index.unsqueeze(-1)).squeeze(-1)


def taken(values: Array, index: Array) -> Array:
    """``values`` (..., n) at the integer ``index`` (..., m) of their last axis: (..., m)."""
    return np.take_along_axis(values, index, -1) if isinstance(values, np.ndarray) else values.gather(-1, index)


def ascending(values: Array) -> Array:
    """``values`` sorted along their last axis."""
    return np.sort(values, -1) if isinstance(values, np.ndarray) else values.sort(-1).values


def one_where(condition: Array, chosen: Array, other: Array) -> Array:
    """``where`` for vectors: ``condition`` of shape (...), ``chosen`` and ``other`` of shape (..., n)."""
    return namespace(condition).where(condition[..., None], chosen, other)


def kind_of(like: Array) -> tuple[Any, Any]:
    """What tells apart the kinds of arrays that a table is kept in: number type and device."""
    return like.dtype, getattr(like, "device", None)


def as_kind(table: Floats, like: Array) -> Array:
    """A table of numpy's as an array of the kind of ``like``."""
    if isinstance(like, (np.ndarray, np.generic)):
        return table.astype(like.dtype)
    return namespace(like).as_tensor(table, dtype=like.dtype, device=like.device)
