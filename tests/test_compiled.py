"""numba's cache saves time, and its failures cost time only."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import marl_handover
from marl_handover.compiled import cache_place, compiled

SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
from kernel import first, second
print(first(1.0), second(2.0))
"""
KERNEL = """
from marl_handover.compiled import compiled

@compiled
def first(x: float) -> float:
    return x + 1.0

@compiled(error_model="python")
def second(x: float) -> float:
    return first(x) / 2.0
"""


def _run(folder: Path, **env: str) -> subprocess.CompletedProcess[str]:
    script = SCRIPT.format(folder=str(folder))
    keep = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env={**keep, **env}, check=False)


@pytest.fixture
def kernel(tmp_path):
    (tmp_path / "kernel.py").write_text(KERNEL)
    return tmp_path


def test_code_is_kept_and_a_cache_that_cannot_be_read_is_passed_over_and_told_once(kernel):
    kept = kernel / "kept"
    assert _run(kernel, NUMBA_CACHE_DIR=str(kept)).stdout == "2.0 1.5\n"
    indices = list(kept.rglob("*.nbi"))
    assert len(indices) == 2
    for index in indices:
        index.write_bytes(index.read_bytes()[:20])  # cut off by a full disk
    torn = _run(kernel, NUMBA_CACHE_DIR=str(kept))
    assert torn.stdout == "2.0 1.5\n"
    assert torn.stderr.count("cannot be kept") == torn.stderr.count("\n") == 1
    assert _run(kernel, NUMBA_CACHE_DIR=str(kept)).stderr == ""  # mended


def test_without_any_place_for_a_cache_functions_are_compiled_all_the_same(capsys, monkeypatch):
    monkeypatch.setattr("marl_handover.compiled._told", [])
    names = {"compiled": compiled}
    exec("@compiled\ndef add(x): return x + 1\n@compiled\ndef twice(x): return 2 * add(x)", names)  # code of no file has no place
    assert names["twice"](3) == 8
    assert capsys.readouterr().err.count("NUMBA_CACHE_DIR=FOLDER") == 1


def test_where_the_cache_is():
    place, trouble = cache_place()
    assert bool(place) != bool(trouble)


def test_there_is_one_decorator():
    package = Path(marl_handover.__file__).parent
    found = {str(path.relative_to(package)) for path in package.rglob("*.py") if re.search(r"\b(njit|jit)\b", path.read_text())}
    assert found == {"compiled.py"}
    assert compiled(lambda x: x)(3) == 3
