"""What is installed on each Python: one physics engine by itself, the pinned versions, and one line for a Python that does not fit."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PYTHONS = ("3.11", "3.12", "3.13")
ENGINES = {"pybullet", "mujoco"}
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")


def installed_on(python: str, lines, extra: str = "") -> set[str]:
    """Names of the requirements that hold on a Python, with an extra."""
    read = map(Requirement, lines)
    where = {"python_version": python, "python_full_version": f"{python}.0", "extra": extra}
    return {line.name for line in read if line.marker is None or line.marker.evaluate(where)}


@pytest.mark.parametrize(("python", "engine"), [("3.11", "pybullet"), ("3.12", "mujoco"), ("3.13", "mujoco")])
def test_one_physics_engine_comes_by_itself_and_an_extra_brings_the_other(python, engine):
    extras = PROJECT["optional-dependencies"]
    assert installed_on(python, PROJECT["dependencies"]) & ENGINES == {engine}
    assert installed_on(python, extras["bullet"]) == {"pybullet"}
    assert installed_on(python, extras["mujoco"]) == {"mujoco"}
    assert "pybullet" not in installed_on(python, extras["dev"]), "the tests need no compiler"


def test_the_pythons_are_the_same_everywhere():
    allowed = SpecifierSet(PROJECT["requires-python"])
    assert [version for version in ("3.10", *PYTHONS, "3.14") if f"{version}.1" in allowed] == list(PYTHONS)
    classified = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if line.startswith("Programming Language :: Python :: 3.")]
    assert tuple(classified) == PYTHONS
    assert f"VERSIONS := {' '.join(PYTHONS)}\n" in MAKEFILE
    for page in ("README.md", "docs/install.md", "docs/tutorial.md"):
        assert "Python 3.11, 3.12 or 3.13" in (ROOT / page).read_text(encoding="utf-8"), page


def test_every_requirement_is_pinned_within_its_range():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {canonicalize_name(pin.name): pin for pin in map(Requirement, (line for line in lines if not line.startswith("#")))}
    needed = [*PROJECT["dependencies"], *(line for extra in PROJECT["optional-dependencies"].values() for line in extra)]
    for line in map(Requirement, needed):
        if line.name == "pyrealsense2":  # for a camera that nobody has tried
            continue
        (pin,) = pins[canonicalize_name(line.name)].specifier
        assert pin.operator == "=="
        assert pin.version in line.specifier, line


WITHOUT_ENGINES = {
    "evaluate backend=bullet policy=exact episodes=1": "bullet",
    "evaluate backend=mujoco policy=exact episodes=1": "mujoco",
    "simulate policy=exact engine=bullet": "bullet",
    "simulate policy=exact": "mujoco",
    "calibrate hardware=twin what=camera calibration=found": "mujoco",
    "doctor": None,
    "plan start=[-100,50,10] goal=[80,-40,120] motion=motion.json": None,
    "evaluate policy=pretrained_b backend=noisy episodes=2 progress=false": None,
}
"""Command lines, and the engine that each lacks where none is installed."""
RUN_THEM = f"""
import sys
sys.modules.update(pybullet=None, mujoco=None)
from marl_handover.cli import main
for line in {list(WITHOUT_ENGINES)!r}:
    print("STATUS", main(line.split()), file=sys.stderr)
"""


@pytest.mark.slow
def test_what_needs_an_engine_that_is_not_installed_gives_one_line_that_installs_it_and_the_rest_works(tmp_path):
    """In a process in which the engines' packages cannot be imported."""
    done = subprocess.run([sys.executable, "-c", RUN_THEM], capture_output=True, text=True, cwd=tmp_path, timeout=280)
    said = re.split(r"^STATUS (\d)\n", done.stderr, flags=re.M)
    assert len(said) == 2 * len(WITHOUT_ENGINES) + 1, done.stderr
    for (line, lacked), told, status in zip(WITHOUT_ENGINES.items(), said[::2], said[1::2], strict=False):
        if lacked is None:
            assert status == "0", told
            continue
        (needed,) = PROJECT["optional-dependencies"][lacked]
        package = Requirement(needed).name
        assert status == "2", line
        assert told.splitlines()[-1] == (
            f"marl-handover {line.split()[0]}: the physics engine {lacked} needs the package {package}; run: pip install '{needed}'"
        )
        assert "Traceback" not in told


def make(python: str, tmp_path: Path) -> subprocess.CompletedProcess[str]:
    """What ``make`` says to an interpreter; nothing is installed if it does not fit."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = [
        "make",
        "--silent",
        "--directory",
        str(ROOT),
        f"VENV={tmp_path / 'venv'}",
        f"PYTHON={python}",
        f"{tmp_path / 'venv'}/.installed",
    ]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
@pytest.mark.parametrize("version", ["3.10.13", "3.14.0", None])
def test_a_python_that_does_not_fit_gives_one_line(version, tmp_path):
    """An interpreter of another version: this one, which takes itself for that."""
    python = tmp_path / "python"
    if version:
        numbers = ", ".join(version.split("."))
        site = tmp_path / "site"
        site.mkdir()
        (site / "sitecustomize.py").write_text(f"import sys\nsys.version_info = ({numbers}, 'final', 0)\n")
        python.write_text(f'#!/bin/sh\n[ "$1" = -V ] && exec echo Python {version}\nPYTHONPATH={site} exec {sys.executable} "$@"\n')
        python.chmod(0o755)
    done = make(str(python), tmp_path)
    assert done.returncode == 2
    (said, _) = done.stderr.splitlines()  # make adds which target it was
    found = f"Python {version}" if version else "no Python"
    assert said == f"make: {python} is {found}, not 3.11, 3.12 or 3.13 with venv and pip; name another: make PYTHON=/path/to/python3.12"
    assert not (tmp_path / "venv").exists()


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_no_python_at_all_gives_one_line(tmp_path):
    done = make("", tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 2)
    assert re.match(r"make: Python 3\.11, 3\.12 or 3\.13 with venv and pip is needed; install it .* or name it", done.stderr)
    assert not (tmp_path / "venv").exists()
