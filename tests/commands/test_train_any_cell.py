"""``marl-handover train preset=any_cell``: what it cannot do is refused in one line, before anything is made; what it made can be used."""

from __future__ import annotations

import json

import pytest

from marl_handover.cli import main

TINY = (
    *("preset=any_cell", "progress=false", "steps=256", "num_envs=16", "evaluation_interval=128", "evaluation_episodes=12"),
    *("algorithm.width=16", "algorithm.rounds=1", "algorithm.layouts_at_once=8", "algorithm.layouts_interval=128"),
    *("algorithm.learning_starts=64", "algorithm.batch_size=32", "checkpoint_interval=128"),
)

BAD = {
    "task.architecture=A": ("task.architecture", "B with algorithm=graph_sac"),
    "architecture=A": ("architecture", "B with algorithm=graph_sac"),
    "task.symmetry_order=2": ("task.symmetry_order", "1 with algorithm=graph_sac"),
    "task.noise.position_mm=1": ("task.noise", "exact arms"),
    "task.noise.yaw_deg=1": ("task.noise", "exact arms"),
    "task.noise.observed_mm=1": ("task.noise", "exact arms"),
    "task.reward.motion_weight=1": ("motion_weight", "0.0 with algorithm=graph_sac"),
    "source=aec": ("source", "batched with algorithm=graph_sac"),
    "replay.symmetry=true": ("replay.symmetry", "False with algorithm=graph_sac"),
    "replay.correct_terminated=false": ("replay.correct_terminated", "True with algorithm=graph_sac"),
    "variant=centralised": ("algorithm", "sac"),
    "algorithm.exploration=area": ("algorithm.exploration", "'chart'"),
    "algorithm.width=20": ("algorithm.width", "multiple of 16"),
    "algorithm.width=0": ("algorithm.width", "between 16 and 1024"),
    "algorithm.rounds=-1": ("algorithm.rounds", "between 0 and 64"),
    "algorithm.rounds=1.5": ("algorithm.rounds", "Integer"),
    "algorithm.candidates=0": ("algorithm.candidates", "between 1 and 256"),
    "algorithm.mixture_components=0": ("algorithm.mixture_components", "between 1 and 64"),
    "algorithm.layout=relative": ("algorithm.layout", "'graph'"),
    "algorithm.layouts_at_once=0": ("algorithm.layouts_at_once", "between 1"),
    "algorithm.temperature_end=0": ("algorithm.temperature_end", "between"),
    "algorithm.depth=3": ("algorithm.depth", "width"),
    "layouts=[{arms: [5, 2]}]": ("layouts.arms", "the least first"),
    "layouts=[{arms: [2, 900]}]": ("layouts[0].arms", "between 2 and"),
    "layouts=[{arms: [1, 2]}]": ("layouts[0].arms", "between 2 and"),
    "layouts=[{r_min_mm: [150, 240]}]": ("layouts.r_min_mm", "below layouts.r_max_mm"),
    "layouts=[{spacing_mm: [600, 700]}]": ("layouts", "can pass to each other"),
    "layouts=[{colour: red}]": ("colour", "layouts"),
    "layouts=3": ("layouts", "list"),
}


@pytest.mark.parametrize("setting", BAD)
def test_what_cannot_be_trained_is_refused_in_one_line(tmp_path, capsys, setting):
    assert main(["train", *TINY, setting, f"out={tmp_path / 'run'}"]) == 2
    told = capsys.readouterr().err.strip()
    assert "\n" not in told
    assert len(told) <= 300, told
    for word in BAD[setting]:
        assert word in told
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.parametrize("algorithm", ["sac", "ppo", "flat_sac"])
def test_other_learners_take_no_random_cells(tmp_path, capsys, algorithm):
    assert main(["train", f"algorithm={algorithm}", "layouts=[{arms: [2, 3]}]", f"out={tmp_path / 'run'}"]) == 2
    told = capsys.readouterr().err.strip()
    assert "layouts = 1: must be left out, or algorithm=graph_sac" in told
    assert "\n" not in told


@pytest.mark.parametrize("cell", ["preset=any_cell", "cell=triangle"])
def test_a_run_is_a_policy_for_any_cell(tmp_path, capsys, cell):
    own = [setting for setting in TINY if not setting.startswith("preset")]
    given = [cell] if cell.startswith("preset") else ["algorithm=graph_sac", cell]
    run = tmp_path / "run"
    assert main(["train", *given, *own, f"out={run}"]) == 0
    for where in ("paper", "line4"):
        report = tmp_path / f"{where}.json"
        assert main(["evaluate", f"policy={run}", f"cell={where}", "episodes=20", "progress=false", f"json={report}"]) == 0
        assert json.loads(report.read_text())["episodes"] == 20
    assert main(["evaluate", f"policy={run}", "cell=triangle", "architecture=A", "episodes=20", "progress=false"]) == 0
    capsys.readouterr()
