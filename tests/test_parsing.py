"""JSON and YAML of strangers end in plain data of a moderate size, or in one short reason; nothing else in the package parses them."""

from __future__ import annotations

import contextlib
import json
import re
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import marl_handover
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.parsing import DEPTH, nesting, parse_json, parse_object, parse_yaml, read_json, read_yaml

LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9))
BAD_JSON = {
    "deep lists": ("[" * 100_000, "deeper"),
    "deep objects": ('{"a":' * 5_000, "deeper"),
    "deep behind a quoted bracket": (json.dumps("]" * 99)[:-1] + '"' + "[" * 100, "JSON|Extra|deeper"),
    "many digits": ("[1" + "0" * 400 + "]", "401 digits"),
    "NaN": ("[NaN]", "NaN"),
    "infinity": ("[-Infinity]", "Infinity"),
    "overflow": ("[1e999]", "1e999"),
    "half": ('{"a": ', "line 1"),
    "no UTF-8": (b"\xff{}", "utf-8"),
}
BAD_YAML = {
    "laughs": (LAUGHS, "aliases unfold"),
    "loop": ("a: &a\n  b: *a\n", "contains itself"),
    "deep": ("a: " + "[" * 20_000, "deeper"),
    "many digits": ("a: " + "9" * 6_000, "6000 digits"),
    "a list": ("[1, 2]", "key: value"),
    "text": ("only words", "key: value"),
    "an object of Python": ("a: !!python/object/apply:os.getcwd []", "constructor"),
    "a set": ("a: !!set {x, y}", "set"),
    "no key": ("? [1, 2]\n: 3", "unhashable|key"),
    "twice": ("a: 1\na: 2", "duplicate"),
    "a null byte": ("a: \0", "special characters"),
}


@pytest.mark.parametrize(("text", "words"), BAD_JSON.values(), ids=BAD_JSON.keys())
def test_bad_json_is_a_short_reason(text, words):
    with pytest.raises(ValueError, match=words) as caught:
        parse_json(text)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(("text", "words"), BAD_YAML.values(), ids=BAD_YAML.keys())
def test_bad_yaml_is_a_short_reason_and_takes_no_memory(text, words):
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=words):
            parse_yaml(text)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**17), 10**17) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(JSON)
def test_json_that_is_written_is_read_back(content):
    assert parse_json(json.dumps(content)) == content
    assert parse_json(json.dumps(content, indent=1).encode()) == content


@given(st.integers(0, 2 * DEPTH), st.text('[]{}"\\', max_size=10))
def test_depth_counts_brackets_outside_quotes(depth, noise):
    text = "[" * depth + json.dumps(noise) + "]" * depth
    assert nesting(text) == depth
    if depth <= DEPTH:
        assert parse_json(text) is not None
    else:
        with pytest.raises(ValueError, match="deeper"):
            parse_json(text)


@given(st.text(max_size=200))
def test_any_text_is_yaml_or_a_reason(text):
    with contextlib.suppress(ValueError):
        assert isinstance(parse_yaml(text), dict)


def test_aliases_of_moderate_size_and_references_stay():
    assert parse_yaml("x: &x {a: 1e-05}\ny:\n  <<: *x\nz: ${x.a}\n") == {"x": {"a": 1e-05}, "y": {"a": 1e-05}, "z": "${x.a}"}
    assert parse_yaml("") == {}


def test_files(tmp_path):
    with pytest.raises(MissingFile, match="plan not found"):
        read_json(tmp_path / "none", "plan")
    (tmp_path / "a").write_text("[1]")
    with pytest.raises(CorruptFile, match="no JSON object"):
        read_json(tmp_path / "a", "plan")
    with pytest.raises(CorruptFile, match="bytes, more than"):
        read_json(tmp_path / "a", "plan", limit_bytes=2)
    with pytest.raises(CorruptFile, match="a folder"):
        read_yaml(tmp_path, "cell")
    with pytest.raises(ValueError, match="no JSON object"):
        parse_object("[1]")


def test_nothing_else_parses_them():
    """One home: whoever adds a reader gets the limits with it."""
    parsers = re.compile(r"json\.loads?\(|yaml\.(safe_load|load|full_load|unsafe_load|compose)\w*\(|OmegaConf\.load\(")
    package = Path(marl_handover.__file__).parent
    found = {str(path.relative_to(package)) for path in package.rglob("*.py") if parsers.search(path.read_text())}
    assert found == {"parsing.py"}
