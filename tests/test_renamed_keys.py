"""A key of 0.1 that has another name now: who types it is told the new one, and what was stored with it is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from marl_handover.cli import main
from marl_handover.compose import RENAMED, RENAMED_OPTIONS, from_text, present_names
from marl_handover.learning.checkpoint import train_config
from marl_handover.learning.settings import ALGORITHMS, TrainConfig

RUN = Path(__file__).parent / "data" / "run_0_1"
OLD = {
    "decay_from": ("train", "algorithm.decay_from=0.3"),
    "steps_per_update": ("train", "algorithm.steps_per_update=3"),
    "modes": ("train", "algorithm.modes=2"),
    "greedy_share": ("train", "algorithm.greedy_share=0"),
    "velocity_share": ("evaluate", "motion.velocity_share=0.5"),
    "starts": ("evaluate", "motion.starts=3"),
    "edge_mm": ("evaluate", "loop.edge_mm=0.5"),
    "glance_s": ("run", "watch.glance_s=1"),
    "patience_s": ("run", "watch.patience_s=3"),
    "missed_mm": ("calibrate", "watch.missed_mm=3"),
    "cards": ("calibrate", "cards.ids=[2,3]"),
    "fresh": ("compare", "fresh=[base]"),
}


def test_every_renamed_key_is_here():
    assert OLD.keys() == RENAMED.keys()


@pytest.mark.parametrize("old", OLD)
def test_an_old_key_is_refused_in_one_line_that_names_the_new_one(old, capsys):
    command, argument = OLD[old]
    assert main([command, argument]) == 2
    said = capsys.readouterr().err
    section = argument.partition(old)[0]
    assert f"'{section}{old}' is called '{section}{RENAMED[old]}' now" in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("old", ["decay_from", "velocity_share"])
def test_an_old_key_without_its_section_too(old, capsys):
    assert main([OLD[old][0], f"{old}=0.5"]) == 2
    assert f".{RENAMED[old]}' now" in capsys.readouterr().err


def test_an_old_key_in_a_yaml_file_too(tmp_path, capsys):
    preset = tmp_path / "mine.yaml"
    preset.write_text("algorithm:\n  decay_from: 0.5\n")
    assert main(["train", f"preset={preset}"]) == 2
    said = capsys.readouterr().err
    assert "algorithm.decay_from" in said
    assert "'algorithm.lr_decay_start' now" in said


@pytest.mark.parametrize(("group", "name"), RENAMED_OPTIONS)
def test_an_old_name_of_an_option_too(group, name, capsys):
    assert main(["train", f"{group}={name}"]) == 2
    assert f"'{group}={RENAMED_OPTIONS[group, name]}' now" in capsys.readouterr().err


def test_the_settings_of_a_stored_run_are_read_with_their_old_keys():
    text = (RUN / "config.yaml").read_text()
    assert "decay_from: 0.5" in text
    config = train_config(text.replace("decay_from: 0.5", "decay_from: 0.25").replace("greedy_share: 0.25", "greedy_share: 0.5"), RUN)
    assert (config.algorithm.lr_decay_start, config.algorithm.deterministic_env_fraction) == (0.25, 0.5)
    box = from_text(TrainConfig, "algorithm: {name: box_sac, decay_from: 1.0}", RUN, {"algorithm": ALGORITHMS})
    assert (box.algorithm.name, box.algorithm.lr_decay_start) == ("flat_sac", 1.0)


def test_stored_settings_by_dotted_key_get_the_present_names():
    stored = {"algorithm.name": "box_sac", "algorithm.decay_from": 0.5, "cards.ids": [1], "steps": 3}
    assert present_names(stored) == {
        "algorithm.name": "flat_sac",
        "algorithm.lr_decay_start": 0.5,
        "hand_markers.ids": [1],
        "steps": 3,
    }
