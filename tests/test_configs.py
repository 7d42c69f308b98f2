"""Every shipped YAML file is a valid configuration of its command."""

from __future__ import annotations

import pytest
import yaml

from marl_handover.cell import load_cell
from marl_handover.commands import evaluate, train
from marl_handover.compose import compose, from_text, to_yaml
from marl_handover.files import resource_path
from marl_handover.geometry.robot import robot_config

CONFIGS = resource_path("configs")
FILES = {folder.name: sorted(path.stem for path in folder.glob("*.yaml")) for folder in CONFIGS.iterdir() if folder.is_dir()}


def named(group):
    return FILES.get(group, [])


def test_every_file_belongs_to_a_group_that_is_tested_here():
    assert {path.parent.name for path in CONFIGS.rglob("*.yaml")} == {"cell", "hardware", "ladder", "preset", "robot", "search", "suite"}
    assert "paper" in named("cell")
    assert "smoke" in named("preset")


@pytest.mark.parametrize("name", named("preset"))
def test_preset_loads_and_validates(name):
    config = compose(train.SCHEMA, [f"preset={name}"], groups=train.GROUPS, aliases=train.ALIASES)
    config.validate()
    plain = compose(train.SCHEMA, [], groups=train.GROUPS, aliases=train.ALIASES)
    assert config != plain, "a preset that changes nothing"
    for key, value in yaml.safe_load((CONFIGS / "preset" / f"{name}.yaml").read_text()).items():
        if not isinstance(value, (dict, list)):
            assert getattr(config, key) == value
    stored = from_text(train.SCHEMA, to_yaml(config), CONFIGS, train.GROUPS)
    assert stored == config


@pytest.mark.parametrize("name", named("preset"))
def test_an_argument_is_stronger_than_a_preset(name):
    arguments = [f"preset={name}", "steps=77", "algorithm.gamma=0.5", "architecture=A"]
    config = compose(train.SCHEMA, arguments, groups=train.GROUPS, aliases=train.ALIASES)
    assert (config.steps, config.algorithm.gamma, config.task.architecture) == (77, 0.5, "A")


@pytest.mark.parametrize("name", named("cell"))
@pytest.mark.parametrize("command", [train, evaluate])
def test_cell_loads_and_builds(command, name):
    config = compose(command.SCHEMA, [f"cell={name}"], groups=command.GROUPS, aliases=command.ALIASES)
    assert config.cell.name == name
    assert load_cell(config.cell).config == config.cell


@pytest.mark.parametrize("name", named("robot"))
def test_robot_loads_and_stands_in_a_cell(name):
    config = robot_config(name)
    config.validate()
    assert config.name == name
    for given in (f"robot={name}", f"cell.urdf={name}"):
        composed = compose(train.SCHEMA, [given, "cell.base_distance_mm=420"], groups=train.GROUPS, aliases=train.ALIASES)
        assert composed.cell.robot == name
    assert [arm.robot for arm in load_cell(composed.cell).arms] == [name] * 2
