"""A run directory carries the robots of its cell: it loads, acts and goes on wherever it is, whatever became of their files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from marl_handover import policies
from marl_handover.cell import load_cell
from marl_handover.commands.train import resumed
from marl_handover.config import CellConfig
from marl_handover.files import resource_path
from marl_handover.geometry.robot import carried_robot, carry_robot, robot_config
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.trainer import Trainer

URDF = resource_path("urdf/al5a.urdf").read_text()


def own_robots(folder: Path) -> tuple[str, str]:
    """Two robots of one's own: a URDF, and a YAML file whose URDF has a mesh."""
    (folder / "parts").mkdir(parents=True)
    (folder / "long.urdf").write_text(URDF.replace('xyz="0.106 0 0"', 'xyz="0.120 0 0"'))
    mesh = '<visual><geometry><mesh filename="package://arm/parts/cover.stl"/></geometry></visual><collision>'
    (folder / "covered.urdf").write_text(URDF.replace("<collision>", mesh, 1))
    (folder / "parts" / "cover.stl").write_text("solid\nendsolid\n")
    (folder / "covered.yaml").write_text("urdf: covered.urdf\ntip: grip\npick_height_mm: 46.0\n")
    return str(folder / "long.urdf"), str(folder / "covered.yaml")


def test_a_run_goes_on_and_acts_elsewhere_without_the_files_it_was_made_from(tmp_path, monkeypatch):
    _, robot = own_robots(tmp_path / "arm")
    config = TrainConfig(cell=CellConfig("own", robot, base_distance_mm=440.0, grid_mm=10.0), steps=64, num_envs=8, compile="off")
    config.evaluation_interval, config.checkpoint_interval, config.evaluation_episodes = 64, 64, 8
    config.algorithm.learning_starts, config.progress = 1000, False
    trained = Trainer(config, tmp_path / "run")
    trained.run()
    rings = [(arm.r_min_mm, arm.r_max_mm, arm.pick_height_mm) for arm in trained.rules.cell.arms]
    moved = tmp_path / "elsewhere" / "moved"
    moved.parent.mkdir()
    shutil.move(tmp_path / "run", moved)
    shutil.rmtree(tmp_path / "arm")
    monkeypatch.chdir(moved.parent)
    policy = policies.load("moved")
    assert [(arm.r_min_mm, arm.r_max_mm, arm.pick_height_mm) for arm in policy.rules.cell.arms] == rings
    assert sorted(path.name for path in moved.rglob("cover.stl")) == ["cover.stl"]
    again = resumed(Path("moved"))
    assert again.counters.step >= 64
    shutil.copytree(moved, tmp_path / "third")
    shutil.rmtree(moved)
    assert np.isfinite(policies.load(str(tmp_path / "third")).rules.cell.arms[0].r_max_mm)


def test_a_carried_robot_is_the_same_robot_and_is_found_by_the_name_it_had(tmp_path):
    for robot in own_robots(tmp_path / "arm"):
        carry_robot(robot, tmp_path / "robots")
        found = carried_robot(robot, tmp_path / "robots")
        assert Path(found).parent.parent == tmp_path / "robots"
        own, kept = robot_config(robot), robot_config(found)
        assert (kept.name, kept.tip, kept.pick_height_mm) == (own.name, own.tip, own.pick_height_mm)
        assert Path(kept.urdf).read_text() == Path(own.urdf).read_text()
        assert carried_robot(found, tmp_path / "robots") == found


def test_shipped_robots_are_not_carried(tmp_path):
    carry_robot("al5a", tmp_path / "robots")
    carry_robot("al5a.urdf", tmp_path / "robots")
    assert not (tmp_path / "robots").exists()
    assert carried_robot("al5a", tmp_path / "robots") == "al5a"
    assert load_cell("paper").config.robot == "al5a_paper"
