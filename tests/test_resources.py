"""Shipped files are found from a checkout, and from an installed wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from marl_handover.errors import MissingFile
from marl_handover.files import resource_path

ROOT = Path(__file__).resolve().parent.parent
PRETRAINED = sorted((ROOT / "marl_handover" / "pretrained").glob("*.npz"))


def test_a_checkout_serves_its_own_files():
    assert resource_path("configs") == ROOT / "configs"
    assert resource_path("urdf") == ROOT / "urdf"


def test_a_resource_that_is_not_there():
    with pytest.raises(MissingFile, match=r"urdf/none\.urdf"):
        resource_path("urdf/none.urdf")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", folder, ROOT], check=True)
    (built,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", folder / "site", built], check=True)
    return built, folder / "site"


@pytest.mark.slow
def test_the_wheel_holds_every_resource(wheel):
    names = set(zipfile.ZipFile(wheel[0]).namelist())
    for folder in ("configs", "urdf"):
        for path in (ROOT / folder).rglob("*.*"):
            assert f"marl_handover/resources/{path.relative_to(ROOT)}" in names
    assert {f"marl_handover/pretrained/{path.name}" for path in PRETRAINED} <= names
    assert "marl_handover/py.typed" in names
    assert not any(name.startswith(("tests/", "bench/", "configs/")) for name in names)


@pytest.mark.slow
@pytest.mark.parametrize(("python", "engine"), [("3.11", "pybullet"), ("3.12", "mujoco"), ("3.13", "mujoco")])
def test_the_wheel_asks_for_one_physics_engine_and_its_extras_for_the_other(wheel, python, engine):
    archive = zipfile.ZipFile(wheel[0])
    (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    lines = archive.read(name).decode().splitlines()
    needed = [Requirement(line.partition(": ")[2]) for line in lines if line.startswith("Requires-Dist: ")]
    for extra, engines in {"": {engine}, "bullet": {engine, "pybullet"}, "mujoco": {engine, "mujoco"}}.items():
        where = {"python_version": python, "extra": extra}
        found = {line.name for line in needed if line.marker is None or line.marker.evaluate(where)}
        assert found & {"pybullet", "mujoco"} == engines, extra
    assert "Requires-Python: <3.14,>=3.11" in lines


@pytest.mark.slow
def test_an_installed_wheel_has_the_rungs_of_the_ladder(wheel, tmp_path):
    code = (
        "import gymnasium, marl_handover\n"
        "from marl_handover.task.ladder import rungs\n"
        "for rung in rungs(): print(rung.path.parent, len(rung.fixed.optimum))\n"
        "print(gymnasium.make('marl_handover/Ladder-2-Pair-v0').reset()[1]['optimum'])"
    )
    environment = {**os.environ, "PYTHONPATH": str(wheel[1])}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    *files, optimum = done.stdout.splitlines()
    assert files == [f"{wheel[1] / 'marl_handover/resources/configs/ladder'} 1000"] * 12
    assert optimum == "3"


@pytest.mark.slow
def test_an_installed_wheel_finds_them(wheel, tmp_path):
    site = wheel[1]
    code = (
        "import marl_handover.files as r\n"
        "for name in ('configs', 'urdf'): print(r.resource_path(name))\n"
        "from marl_handover.cli import main; raise SystemExit(main(['doctor', '--help']))"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    found = done.stdout.splitlines()[:2]
    assert found == [str(site / "marl_handover" / "resources" / name) for name in ("configs", "urdf")]
    for name in ("configs", "urdf"):
        shipped = {path.relative_to(ROOT / name) for path in (ROOT / name).rglob("*.*")}
        installed = site / "marl_handover" / "resources" / name
        assert {path.relative_to(installed) for path in installed.rglob("*.*")} == shipped
