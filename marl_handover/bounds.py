"""What a setting may be, said beside its default: ``grid_mm: float = bounded(5.0, 1.0, 100.0)``.

:func:`check_bounds` is the one reader of these facts. The front end calls it on every composed configuration, and ``validate()`` methods
call it for settings that were made in Python. What relates two settings to each other stays in ``validate()``.

Whatever has no bounds of its own keeps the general ones: text is at most 4096 printable characters, a list has at most 1000 items, a
number is finite.
"""

from __future__ import annotations

import copy
import enum
import math
import numbers
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marl_handover.errors import InvalidSetting, NotFinite, UnknownChoice
from marl_handover.files import expanded

LONGEST_TEXT, LONGEST_LIST = 4096, 1000
MAX_SEED = 10**9 - 2
"""Seeds above are kept for the problems of reports and of validation."""


@dataclass(frozen=True)
class Bounds:
    """What one field may be; of a list or mapping, what each number or text in it may be.

    ``length``: least and greatest number of items of the outer list or mapping; ``inner``: of lists inside it. ``whole``: no fractions.
    """

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    choices: Collection[Any] = ()
    length: tuple[int, int] = (0, LONGEST_LIST)
    inner: tuple[int, int] = (0, LONGEST_LIST)
    items: str = "items"
    longest: int = LONGEST_TEXT
    is_path: bool = False
    is_name: bool = False

    @property
    def numeric(self) -> bool:
        """Whether both ends of a number are given."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def limit(self) -> str:
        """The limit of a number in words."""
        return f"between {_plain(self.low)} and {_plain(self.high)}{', a whole number' if self.whole else ''}"


_GENERAL = Bounds()
_NO_NAME = re.compile(r"[^\w.+-]")
_NO_LISTS = (0, 0)
"""Of what is inside the inner lists already."""
_KEY = "bounds"


def bounded(
    default: Any,
    low: float,
    high: float,
    length: tuple[int, int] | None = None,
    inner: tuple[int, int] | None = None,
    items: str = "items",
) -> Any:
    """A dataclass field for a number from ``low`` to ``high``, or for a list or mapping of such numbers.

    Whole numbers as both limits, without a fractional default, mean that the setting is a whole number.

    Args:
        default: value, list or mapping; a callable makes it anew each time; None for a setting that may be left out.
        low: least value, itself allowed.
        high: greatest value, itself allowed.
        length: least and greatest number of items of a list or mapping.
        inner: the same for the lists inside it.
        items: what they are, for the error of a list that is too short or too long.
    """
    made = default() if callable(default) else default
    whole = isinstance(low, int) and isinstance(high, int) and not any(isinstance(value, float) for value in _leaves(made))
    return _field(default, Bounds(low, high, whole, length=length or _GENERAL.length, inner=inner or _NO_LISTS, items=items))


def chosen(default: Any, choices: Collection[Any]) -> Any:
    """A dataclass field for one of ``choices``, which may grow; of a list, each item."""
    return _field(default, Bounds(choices=choices))


def path_field(default: str | None = "") -> Any:
    """A dataclass field for the path of a file or folder; the command line expands a leading ``~`` in it."""
    return _field(default, Bounds(is_path=True))


def name_field(default: str = "") -> Any:
    """A dataclass field for a name that folders and files are called after: a single word, which leads to no other folder."""
    return _field(default, Bounds(longest=100, is_name=True))


def sized(default: Callable[[], Any] | None, low: int, high: int) -> Any:
    """A dataclass field for a list or mapping of ``low`` to ``high`` items, made by ``default``; None: it may be left out."""
    return _field(default, Bounds(length=(low, high)))


def seed_field(default: int = 0) -> Any:
    """A dataclass field for a seed that every generator takes."""
    return bounded(default, 0, MAX_SEED)


def bounds_of(item: Any) -> Bounds:
    """The bounds of a dataclass field; the general ones unless it has its own."""
    found: Bounds = item.metadata.get(_KEY, _GENERAL)
    return found


def check_bounds(settings: Any, prefix: str = "") -> None:
    """Check every value of a dataclass instance, of its sections, lists and mappings too.

    Args:
        settings: the instance.
        prefix: what its keys begin with, such as ``"motion."``.

    Raises:
        InvalidSetting, NotFinite, UnknownChoice: with the whole key, the value and what it may be.
    """
    for item in fields(settings):
        _check(f"{prefix}{item.name}", getattr(settings, item.name), bounds_of(item), item.default is None)


def expand_paths(settings: Any) -> None:
    """Expand a leading ``~`` in every setting of a dataclass instance that is a path, in place."""
    for item in fields(settings):
        value = getattr(settings, item.name)
        if bounds_of(item).is_path and isinstance(value, str) and value.startswith("~"):
            setattr(settings, item.name, str(expanded(value)))
        inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else [value]
        for each in inside:
            if is_dataclass(each):
                expand_paths(each)


def _check(name: str, value: Any, bounds: Bounds, optional: bool) -> None:
    if is_dataclass(value):
        check_bounds(value, f"{name}.")
    elif isinstance(value, (str, Path)):
        _check_text(name, str(value), bounds)
    elif isinstance(value, Mapping):
        _check_length(name, value, bounds)
        for key, each in value.items():
            _check_text(f"a key of {name}", str(key), _GENERAL)
            _check_item(f"{name}.{key}", each, bounds)
    elif isinstance(value, (list, tuple)):
        _check_length(name, value, bounds)
        for index, each in enumerate(value):
            _check_item(f"{name}[{index}]", each, bounds)
    elif _is_number(value):
        _check_number(name, value, bounds)
    elif bounds.numeric and not (value is None and optional):
        raise InvalidSetting(name, value, f"a number {bounds.limit()}")
    elif not (value is None or isinstance(value, (bool, enum.Enum))):
        raise InvalidSetting(name, value, "text, a number, true or false, a list or a section")


def _check_item(name: str, value: Any, bounds: Bounds) -> None:
    """An item of a list or mapping: as the whole, but with the length of the inner ones."""
    if isinstance(value, (list, tuple, Mapping)) and bounds.inner == _NO_LISTS:
        raise InvalidSetting(name, value, "a single value")
    _check(name, value, replace(bounds, length=bounds.inner, inner=_NO_LISTS, items="items"), optional=False)


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, (bool, np.bool_))


def _check_number(name: str, value: Any, bounds: Bounds) -> None:
    try:
        finite = math.isfinite(value)
    except OverflowError:  # a whole number beyond every float
        raise InvalidSetting(name, value, bounds.limit()) from None
    if not finite:
        raise NotFinite(name, value)
    if not bounds.low <= value <= bounds.high or (bounds.whole and value != int(value)):
        raise InvalidSetting(name, value, bounds.limit())


def _check_text(name: str, value: str, bounds: Bounds) -> None:
    if bounds.choices and value not in bounds.choices:
        raise UnknownChoice(name, value, bounds.choices)
    if len(value) > bounds.longest:
        raise InvalidSetting(name, value, f"at most {bounds.longest} characters; this has {len(value)}")
    if bounds.is_name and (_NO_NAME.search(value) or value in (".", "..")):
        raise InvalidSetting(name, value, "a name of letters, digits and . _ - + only, which folders and files are called after")
    if any(character < " " or "\x7f" <= character <= "\x9f" for character in value):
        raise InvalidSetting(name, value, "text without control characters")


def _check_length(name: str, value: Any, bounds: Bounds) -> None:
    low, high = bounds.length
    if not low <= len(value) <= high:
        wanted = f"{low}" if low == high else f"{low} to {high}"
        raise InvalidSetting(name, value, f"{wanted} {bounds.items}; this has {len(value)}")


def _field(default: Any, bounds: Bounds) -> Any:
    metadata = {_KEY: bounds}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, (list, dict)):
        return field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        value = list(value.values())
    return [leaf for each in value for leaf in _leaves(each)] if isinstance(value, (list, tuple)) else [value]


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) and abs(number) < 10**10 else f"{number:g}"


def require_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Raise :class:`UnknownChoice` unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise UnknownChoice(name, value, choices)


def require_positive(name: str, value: float) -> None:
    """Raise :class:`InvalidSetting` unless ``value`` is a finite number above zero."""
    if not (math.isfinite(value) and value > 0):
        raise InvalidSetting(name, value, "a finite number above 0")


def require_at_least(name: str, value: float, least: float) -> None:
    """Raise :class:`InvalidSetting` unless ``value`` is a finite number not below ``least``."""
    if not (math.isfinite(value) and value >= least):
        raise InvalidSetting(name, value, f"a finite number, at least {least:g}")


def require_between(name: str, value: float, low: float, high: float) -> None:
    """Raise :class:`InvalidSetting` unless ``low <= value <= high``."""
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidSetting(name, value, f"between {low:g} and {high:g}")


def require_seed(seed: int) -> None:
    """Raise :class:`InvalidSetting` unless ``seed`` is one that every generator takes."""
    require_between("seed", seed, 0, MAX_SEED)
