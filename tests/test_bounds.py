"""Bounds beside defaults: every number of every command has both ends, and one reader holds all settings to them."""

from __future__ import annotations

import importlib
import math
import types
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.bounds import MAX_SEED, bounded, bounds_of, check_bounds, chosen, path_field, seed_field, sized
from marl_handover.cli import COMMANDS
from marl_handover.compose import compose
from marl_handover.errors import InvalidSetting, NotFinite, UnknownChoice


@dataclass
class Inner:
    share: float = bounded(0.5, 0.0, 1.0)


@dataclass
class Toy:
    count: int = bounded(3, 1, 10)
    maybe: float | None = bounded(None, -1.0, 1.0)
    widths: list[int] = bounded([4, 4], 1, 8, (1, 3))
    limits: dict[str, list[float]] = bounded(lambda: {"a": [0.0, 1.0]}, -9.0, 9.0, (0, 2), (2, 2))
    kind: str = chosen("a", ("a", "b"))
    where: str = path_field()
    seed: int = seed_field()
    flag: bool = False
    inner: Inner = field(default_factory=Inner)
    stages: list[Inner] = sized(lambda: [Inner()], 1, 2)


BAD: list[tuple[dict[str, Any], type[InvalidSetting] | type[UnknownChoice], str]] = [
    ({"count": 0}, InvalidSetting, "count = 0: must be between 1 and 10"),
    ({"count": 2.5}, InvalidSetting, "a whole number"),
    ({"count": 10**400}, InvalidSetting, "count"),
    ({"count": True}, InvalidSetting, "count"),
    ({"count": None}, InvalidSetting, "count"),
    ({"maybe": math.nan}, NotFinite, "maybe = nan: every number must be finite"),
    ({"maybe": math.inf}, NotFinite, "finite"),
    ({"widths": []}, InvalidSetting, "must be 1 to 3 items; this has 0"),
    ({"widths": [1, 2, 9]}, InvalidSetting, r"widths\[2\] = 9"),
    ({"limits": {"a": [0.0]}}, InvalidSetting, r"limits\.a = \[0\.0\]: must be 2 items"),
    ({"limits": {"a": [0.0, 10.0]}}, InvalidSetting, r"limits\.a\[1\] = 10"),
    ({"limits": {"a": [0.0, [1.0, 2.0]]}}, InvalidSetting, r"limits\.a\[1\]"),
    ({"kind": "c"}, UnknownChoice, "choose one of: a, b"),
    ({"where": "x" * 5000}, InvalidSetting, "4096 characters; this has 5000"),
    ({"where": "a\0b"}, InvalidSetting, "control characters"),
    ({"seed": -1}, InvalidSetting, f"between 0 and {MAX_SEED}"),
    ({"inner": Inner(2.0)}, InvalidSetting, r"inner\.share = 2\.0"),
    ({"stages": []}, InvalidSetting, "stages"),
    ({"stages": [Inner(), Inner(-1.0)]}, InvalidSetting, r"stages\[1\]\.share"),
]


@pytest.mark.parametrize(("changes", "error", "words"), BAD, ids=[str(index) for index in range(len(BAD))])
def test_a_value_outside_its_bounds_is_refused_by_its_whole_key(changes, error, words):
    with pytest.raises(error, match=words):
        check_bounds(Toy(**changes))


def test_the_defaults_and_both_ends_pass():
    check_bounds(Toy())
    check_bounds(Toy(count=1, maybe=1.0, widths=[8], kind="b"))
    check_bounds(Toy(count=np.int64(10), maybe=np.float32(-1.0)))


def test_a_default_that_can_change_is_made_anew():
    first, second = Toy(), Toy()
    first.widths.append(1)
    first.limits["a"][0] = 5.0
    assert second == Toy()
    assert second.widths == [4, 4]


@given(st.floats() | st.integers())
def test_a_number_passes_if_and_only_if_it_is_within(value):
    toy = Toy(maybe=value)
    if -1 <= value <= 1:
        check_bounds(toy)
    else:
        with pytest.raises(InvalidSetting, match="maybe"):
            check_bounds(toy)


def test_the_front_end_holds_a_composed_configuration_to_them():
    assert compose(Toy, ["count=10", "inner.share=1"]).count == 10
    for text in ("count=11", "inner.share=1.5", "widths=[0]", "kind=z", "limits.b=[1]", "maybe=-2"):
        with pytest.raises((InvalidSetting, UnknownChoice), match=text.partition("=")[0].replace(".", r"\.")):
            compose(Toy, [text])


def _plain(hint: Any) -> set[Any]:
    """The types of the numbers in an annotation: int, float or both."""
    if get_origin(hint) in (Union, types.UnionType, list, dict, tuple, Mapping):
        return set().union(*(_plain(each) for each in get_args(hint)))
    return {hint} & {int, float}


def _sections(hint: Any) -> Iterator[type]:
    if isinstance(hint, type) and is_dataclass(hint):
        yield hint
    for each in get_args(hint):
        yield from _sections(each)


def _schemas() -> dict[type, str]:
    """Every dataclass of settings that a command line reaches, with a key that leads to it."""
    from marl_handover.experiments.suite import Suite

    found: dict[type, str] = {}
    todo: list[tuple[type, str]] = [(Suite, "suite")]
    for name, command in COMMANDS.items():
        module: Any = importlib.import_module(command.module)
        todo += [(module.SCHEMA, name)]
        todo += [(option, f"{name}: {group}={key}") for group, options in module.GROUPS.items() for key, option in options.items()]
    while todo:
        schema, key = todo.pop()
        if schema not in found:
            found[schema] = key
            hints = get_type_hints(schema)
            todo += [(section, f"{key}.{item.name}") for item in fields(schema) for section in _sections(hints[item.name])]
    return found


def test_every_number_of_every_command_says_its_bounds_beside_its_default():
    missing, wrong = [], []
    for schema, key in _schemas().items():
        hints = get_type_hints(schema)
        for item in fields(schema):
            numbers, bounds = _plain(hints[item.name]), bounds_of(item)
            if numbers and not bounds.numeric:
                missing.append(f"{key}: {schema.__name__}.{item.name}")
            elif numbers and bounds.whole != (numbers == {int}):
                wrong.append(f"{schema.__name__}.{item.name}: limits must be {numbers}")
    assert not missing
    assert not wrong


def test_every_default_is_within_its_own_bounds():
    for schema in _schemas():
        if all(item.default is not MISSING or item.default_factory is not MISSING for item in fields(schema)):
            check_bounds(schema())
