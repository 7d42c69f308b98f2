"""``marl-handover workspace``."""

from __future__ import annotations

import json
import math

import matplotlib.image
import numpy as np
import pytest

from marl_handover import cli

KEYS = {
    *("cell", "r_min_mm", "r_max_mm", "base_distance_mm", "yaw_range_rad", "x_max_mm"),
    *("pick_height_mm", "bases", "grid_mm", "grid_points", "fit"),
}


def colours(path):
    image = (255 * matplotlib.image.imread(path)[::3, ::3, :3]).astype(np.uint32)
    return len(np.unique(image @ np.array([1, 256, 65536], np.uint32)))


@pytest.mark.parametrize(("name", "distance", "r_min", "r_max", "yaw_deg"), [("paper", 360, 150, 230, 90), ("al5a", 440, 143, 313, 95)])
def test_numbers_and_picture(tmp_path, capsys, name, distance, r_min, r_max, yaw_deg):
    assert cli.main(["workspace", f"cell={name}", f"out={tmp_path}/new/folder"]) == 0
    folder = tmp_path / "new" / "folder"
    assert {path.name for path in folder.iterdir()} == {"workspace.json", "workspace.png"}
    out = capsys.readouterr().out
    assert f"{r_min} to {r_max} mm" in out
    result = json.loads((folder / "workspace.json").read_text())
    assert set(result) >= KEYS
    assert (result["cell"], result["base_distance_mm"], result["grid_mm"], result["pick_height_mm"]) == (name, distance, 5, 45)
    assert (result["r_min_mm"], result["r_max_mm"]) == pytest.approx((r_min, r_max), abs=1)
    assert result["yaw_range_rad"] == pytest.approx([-math.radians(yaw_deg), math.radians(yaw_deg)], abs=0.02)
    assert result["x_max_mm"] == pytest.approx(math.sqrt(result["r_max_mm"] ** 2 - distance**2 / 4))
    assert result["bases"] == {"L": [0, distance / 2], "R": [0, -distance / 2]}
    points = result["grid_points"]
    assert set(points) == {"L", "R", "both"}
    assert points["L"] == points["R"] > points["both"] > 0
    assert result["fit"]["false_inside_rate"] == 0
    assert 0 <= result["fit"]["missed_rate"] < 0.05
    assert colours(folder / "workspace.png") > 20


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("cell=al5", "al5a"),
        ("cell.grid_mm=nan", "grid_mm"),
        ("cell.base_distance_mm=700", "300 and 460"),
        ("cell.urdf=/none.urdf", "none.urdf"),
        ("output=x", "unknown key 'output'"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, monkeypatch, argument, said):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["workspace", argument]) == 2
    err = capsys.readouterr().err
    assert err.startswith("marl-handover workspace: ")
    assert said in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["workspace", f"out={tmp_path}/file"]) == 2
    assert f"{tmp_path}/file cannot be written" in capsys.readouterr().err
