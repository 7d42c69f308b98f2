"""From settings to a cell, and the named errors of settings that cannot be."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from marl_handover.cell import AngleChart, build_cell, cell_config, load_cell
from marl_handover.cli import main
from marl_handover.config import BlockConfig, CellConfig, MotionConfig
from marl_handover.errors import CorruptFile, HandoverError, InvalidSetting, MissingFile, NoSharedSpace, UnknownChoice

PAPER = cell_config("paper")


def test_paper_cell_is_the_papers(paper):
    assert (paper.r_min_mm, paper.r_max_mm) == (150.0, 230.0)
    assert paper.yaw_rad == pytest.approx((-math.pi / 2, math.pi / 2), abs=1e-12)
    assert paper.config.base_distance_mm == 360.0
    assert [(base.x_mm, base.y_mm) for base in paper.bases] == [(0.0, 180.0), (0.0, -180.0)]
    assert [base.facing for base in paper.bases] == [(0.0, -1.0), (0.0, 1.0)]


def test_al5a_has_a_connected_shared_space():
    model = build_cell(cell_config("al5a"))
    half = model.cell.config.base_distance_mm / 2
    assert model.cell.r_min_mm < half < model.cell.r_max_mm
    widths = model.cell.chart.y_max_mm(model.cell.chart.x_max_mm * np.linspace(-0.95, 0.95, 191))
    assert (widths > 1).all()  # one piece: it is nowhere cut in two
    assert model.fit.false_inside_rate == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in ("base_distance_mm", "pick_height_mm", "grid_mm") for value in (math.nan, math.inf, 0.0, -5.0)]
    + [("chart_inset", value) for value in (math.nan, 0.0, 1.01, -1.0)]
    + [("fit_rounding_mm", value) for value in (math.nan, math.inf, -1.0)],
)
def test_bad_numbers_are_named(name, value):
    with pytest.raises(InvalidSetting, match=rf"{name} = ") as caught:
        build_cell(replace(PAPER, **{name: value}))
    assert caught.value.exit_status == 2
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("block", "name"),
    [({name: value}, name) for name in asdict(BlockConfig()) for value in (math.nan, math.inf, 0.0, -5.0, 1e6)]
    + [
        ({"pin_top_mm": 15.0}, "pin_top_mm"),
        ({"height_mm": 70.0}, "pin_top_mm"),
        ({"marker_mm": 41.0}, "marker_mm"),
        ({"side_mm": 20.0}, "marker_mm"),
        ({"side_mm": 8.0, "marker_mm": 8.0, "pin_diameter_mm": 8.0}, "pin_diameter_mm"),
    ],
)
def test_a_block_that_cannot_be_is_named(block, name):
    with pytest.raises(InvalidSetting, match=rf"cell\.block\.{name} = "):
        build_cell(replace(PAPER, block=BlockConfig(**block)))


@pytest.mark.parametrize(
    "command",
    [
        ["workspace"],
        ["plan", "start=[0,20,0]", "goal=[0,40,30]"],
        ["train", "steps=64"],
        ["evaluate", "policy=exact", "episodes=1"],
        ["simulate", "episodes=1"],
        ["calibrate", "hardware=twin", "what=sheets"],
        ["run", "hardware=twin", "policy=exact"],
    ],
    ids=lambda command: command[0],
)
def test_every_command_that_reads_a_cell_refuses_it(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*command, "cell.block.pin_top_mm=10"]) == 2
    told = capsys.readouterr().err
    assert "cell.block.pin_top_mm = 10.0: must be above cell.block.height_mm = 15" in told
    assert told.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"pick_height_mm": 70.0}, "cell.pick_height_mm"), ({"pick_height_mm": 10.0}, "cell.pick_height_mm"), ({}, "motion.finger_travel_mm")],
)
def test_hands_close_on_the_pin_wherever_a_block_is_carried(changes, name):
    """A cell alone may be looked at with any pick height; its reach is a matter of the arms."""
    from marl_handover.motion.planner import MotionPlanner
    from marl_handover.simulation.world import SimulatedCell

    model = build_cell(PAPER)
    pin = {"block": BlockConfig(pin_diameter_mm=20.0)} if not changes else {}
    other = model._replace(cell=replace(model.cell, config=replace(PAPER, **changes, **pin)))
    motion = MotionConfig(finger_travel_mm=9.0)
    for made in (MotionPlanner, SimulatedCell):
        with pytest.raises(InvalidSetting) as caught:
            made(other, motion)
        assert caught.value.name == name


@pytest.mark.parametrize("distance_mm", [200.0, 300.0, 460.0, 900.0])
def test_bases_without_a_shared_space_are_named(distance_mm):
    with pytest.raises(NoSharedSpace, match=rf"base_distance_mm = {distance_mm:g}.*between 300 and 460"):
        build_cell(replace(PAPER, base_distance_mm=distance_mm, chart="paper"))


@pytest.mark.parametrize("distance_mm", [200.0, 300.0])
def test_bases_too_near_for_the_papers_chart_have_that_of_hand_over_angles(distance_mm):
    assert isinstance(build_cell(replace(PAPER, base_distance_mm=distance_mm)).cell.chart, AngleChart)
    with pytest.raises(NoSharedSpace, match="between 300 and 460"):
        build_cell(replace(PAPER, base_distance_mm=460.0))


def test_a_yaw_range_too_narrow_for_the_tips_is_named():
    """The tips of the paper's shared space are at atan2(143, 180) = 38.5 degrees."""
    for limit, fits in ((45.0, True), (30.0, False)):
        config = replace(PAPER, joint_limits_deg={**PAPER.joint_limits_deg, "base_yaw": [-limit, limit]})
        if fits:
            assert build_cell(config).cell.yaw_rad[1] < math.radians(limit) + 1e-9
        else:
            with pytest.raises(NoSharedSpace, match=r"38\.5 deg"):
                build_cell(replace(config, chart="paper"))
            assert isinstance(build_cell(config).cell.chart, AngleChart)


def test_a_missing_urdf_is_named(tmp_path):
    for urdf in ("no_such_arm.urdf", str(tmp_path / "no_such_arm.urdf")):
        with pytest.raises(MissingFile, match=r"no_such_arm\.urdf"):
            build_cell(replace(PAPER, robot=urdf))


def test_an_unknown_cell_lists_the_known_ones():
    with pytest.raises(UnknownChoice, match=r"'papier'.*al5a.*paper"):
        load_cell("papier")


def test_a_missing_or_corrupt_cell_file_is_named(tmp_path):
    with pytest.raises(MissingFile, match=r"mine\.yaml"):
        load_cell(str(tmp_path / "mine.yaml"))
    path = tmp_path / "bad.yaml"
    for text in ("base_distance_mm: wide\n", "- 1\n", "base_distance_mm: [\n"):
        path.write_text(text)
        with pytest.raises(CorruptFile, match=r"bad\.yaml"):
            load_cell(str(path))


def test_a_cell_file_with_an_unknown_key_is_named(tmp_path):
    path = tmp_path / "typo.yaml"
    path.write_text("base_distanse_mm: 400\n")
    with pytest.raises(HandoverError, match="base_distanse_mm"):
        load_cell(str(path))


def test_a_cell_file_changes_only_what_it_says(tmp_path):
    path = tmp_path / "wide.yaml"
    path.write_text("base_distance_mm: 400.0\n")
    assert asdict(cell_config(str(path))) == {**asdict(CellConfig()), "base_distance_mm": 400.0}
    assert load_cell(str(path)).bases[0].y_mm == 200.0


def test_a_cell_is_computed_once():
    assert load_cell("paper") is load_cell(cell_config("paper"))
    assert load_cell("paper") is not load_cell("al5a")
