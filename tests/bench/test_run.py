from __future__ import annotations

from pathlib import Path
from typing import Any

import common
import pytest
import run


def result(variant: str, reached: float | None, whole: float) -> dict[str, Any]:
    hit = None if reached is None else dict.fromkeys(("steps", "gradient_steps", "wall_s"), reached)
    final = {"steps": whole, "gradient_steps": whole, "wall_s": whole, "success_rate": 0.5}
    return {
        "variant": variant,
        "to": {str(level): hit for level in common.LEVELS},
        "final": final,
        "best_success_rate": 0.9,
        "ended": "wall",
    }


@pytest.mark.parametrize(
    ("peers", "ratio", "at_least", "name"),
    [
        ([("a", 500, 900), ("b", None, 800)], 5, False, "a"),
        ([("a", 500, 900), ("b", None, 400)], 4, True, "b"),
        ([("a", None, 900), ("b", None, 1200)], 9, True, "a"),
    ],
)
def test_a_peer_that_never_gets_there_counts_as_its_whole_run(peers: Any, ratio: float, at_least: bool, name: str) -> None:
    results = [result("ours", 100, 200), *[result(*peer) for peer in peers], {"variant": "c", "failed": "exit status 1"}]
    found = run.speed_up(results)["wall_s"]
    assert (found["ratio"], found["at_least"], found["peer"]) == (pytest.approx(ratio), at_least, name)
    text = run.show(results)
    assert "failed: exit status 1" in text
    assert ("≥" in text) == at_least


def test_no_speed_up_without_ours() -> None:
    assert run.speed_up([{"variant": "ours", "failed": "no"}, result("a", 1, 2)]) == {}
    assert run.speed_up([result("ours", None, 2), result("a", 1, 2)]) == {}


def test_half_written_metrics_are_read_as_far_as_they_go(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("step,wall_s,success_rate,note\n1,2.5,,x\n2,3.5,0.5,y\n3,4")
    assert common.read_metrics(path) == [
        {"step": 1, "wall_s": 2.5},
        {"step": 2, "wall_s": 3.5, "success_rate": 0.5},
        {"step": 3, "wall_s": 4},
    ]


def test_arguments_keep_the_type_of_their_default() -> None:
    assert common.parse(["a=3", "b=true"], {"a": 1.0, "b": False, "c": "x"}) == {"a": 3.0, "b": True, "c": "x"}
    with pytest.raises(SystemExit):
        common.parse(["d=1"], {"a": 1})
