"""JSON and YAML that somebody else wrote, read within limits of size, depth and digits.

The standard parsers take what their author sends: a million brackets end in a recursion, nine lines of aliases in gigabytes, a number of
5,000 digits in an error of the interpreter. Everything here ends in plain data of a moderate size, or in one short reason.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from marl_handover.errors import CorruptFile
from marl_handover.files import MEGABYTE, read_bounded, read_lines

DEPTH, DIGITS, NODES = 50, 20, 100_000
"""How deep lists and mappings may nest, how many digits a whole number may have, how many values a YAML file may unfold to."""
JSON_BYTES, YAML_BYTES, LINES_BYTES = 64 * MEGABYTE, MEGABYTE, 1000 * MEGABYTE
"""Largest sizes: of a JSON file, of a YAML file, of a file of JSON Lines."""

_BRACKETS = re.compile(r'"(?:[^"\\]|\\.)*+"|([\[{])|([\]}])', re.DOTALL)


def parse_json(text: str | bytes, finite: bool = True, largest: float = sys.float_info.max) -> Any:
    """What JSON text holds.

    Args:
        text: UTF-8 if bytes.
        finite: refuse NaN, infinities and numbers beyond ``largest``.
        largest: greatest absolute value of a number.

    Raises:
        ValueError: with a short reason, whatever is wrong.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    if text.count("[") + text.count("{") > DEPTH:
        _require_shallow(text)

    def real(number: str) -> float:
        value = float(number)
        if finite and not abs(value) <= largest:
            raise ValueError(f"it holds {number[:20]}, which is no number that could be meant")
        return value

    def whole(digits: str) -> int:
        _require_short(digits)
        real(digits)
        return int(digits)

    return json.loads(text, parse_int=whole, parse_float=real, parse_constant=real)


def parse_object(text: str | bytes, finite: bool = True) -> dict[str, Any]:
    """As :func:`parse_json`, of text that holds an object in braces."""
    content = parse_json(text, finite)
    if not isinstance(content, dict):
        raise ValueError("it holds no JSON object")
    return content


def read_json(path: Path, what: str, limit_bytes: int = JSON_BYTES, finite: bool = True) -> dict[str, Any]:
    """The JSON object in a regular file of moderate size; ``what`` it should be, for errors.

    Raises:
        MissingFile, CorruptFile: there is none, or it holds none.
    """
    content = read_bounded(path, limit_bytes, what)
    try:
        return parse_object(content, finite)
    except ValueError as error:
        raise CorruptFile(what, path, str(error)) from error


def read_rows(path: Path, what: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """The objects of a file of JSON Lines that grows, numbers that are none included; see :func:`~marl_handover.files.read_lines`."""
    return read_lines(path, LINES_BYTES, what, _row)


def _row(line: bytes) -> dict[str, Any]:
    try:
        row = parse_json(line, finite=False)
    except ValueError as error:
        raise ValueError("is not JSON") from error
    if not isinstance(row, dict):
        raise ValueError("is not an object in braces")
    return row


def parse_yaml(text: str) -> dict[str, Any]:
    """The mapping that YAML text holds, as plain data, OmegaConf's ``${references}`` left as they are; empty text is an empty mapping.

    Raises:
        ValueError: with a short reason, whatever is wrong.
    """
    from omegaconf import OmegaConf  # here: a stop reads JSON, and must not wait for it
    from omegaconf.errors import OmegaConfBaseException

    try:
        _require_moderate(text)
        tree = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (yaml.YAMLError, OmegaConfBaseException, RecursionError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error
    assert isinstance(tree, dict)
    return tree  # type: ignore[return-value]  # keys that are no text fail later, as unknown keys


def read_yaml(path: Path, what: str) -> dict[str, Any]:
    """The mapping in a regular YAML file of moderate size; arguments and errors as of :func:`read_json`."""
    content = read_bounded(path, YAML_BYTES, what)
    try:
        return parse_yaml(content.decode("utf-8"))
    except ValueError as error:
        raise CorruptFile(what, path, str(error)) from error


def nesting(text: str) -> int:
    """How deep brackets and braces nest outside double quotes."""
    depth = deepest = 0
    for match in _BRACKETS.finditer(text):
        if match[1]:
            depth += 1
            deepest = max(deepest, depth)
        elif match[2]:
            depth -= 1
    return deepest


def _require_shallow(text: str) -> None:
    if nesting(text) > DEPTH:
        raise ValueError(f"it nests deeper than {DEPTH} levels")


def _require_short(digits: str) -> None:
    if len(digits) > DIGITS:
        raise ValueError(f"it holds a number of {len(digits)} digits")


def _require_moderate(text: str) -> None:
    """Raise for YAML that nests or unfolds without measure, or holds no mapping. Its events come one by one: no recursion."""
    depth = 0
    for number, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > DEPTH:
            raise ValueError(f"it nests deeper than {DEPTH} levels")
        if number > 2 * NODES:
            raise ValueError(f"it holds more than {NODES} values")
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    if not isinstance(node, (yaml.MappingNode, type(None))):
        raise ValueError("expected key: value lines")
    if node is not None and _size(node, {}) > NODES:
        raise ValueError(f"its aliases unfold to more than {NODES} values")


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values a node is, what its aliases stand for counted each time."""
    if id(node) in known:
        if known[id(node)] == 0:
            raise ValueError("an alias in it contains itself")
        return known[id(node)]
    if isinstance(node, yaml.ScalarNode):
        if node.tag == "tag:yaml.org,2002:int":
            _require_short(node.value)
        return 1
    known[id(node)] = 0  # not known yet: whoever meets it again is inside it
    children = [each for pair in node.value for each in pair] if isinstance(node, yaml.MappingNode) else node.value
    known[id(node)] = 1 + sum(_size(child, known) for child in children)
    return known[id(node)]
