import json

import perception


def test_the_bench_keeps_its_own_bars_on_a_few_pictures(tmp_path, capsys):
    perception.main(["frames=6", "cameras=1", "boards=9", f"results={tmp_path}"])
    stored = json.loads(next(tmp_path.rglob("perception.json")).read_text())
    everything = stored["groups"]["all"]
    assert everything["frames"] == 6
    assert everything["detected"] == 1
    assert everything["position_mm"]["max"] < stored["bars"]["position_mm"][1]
    assert everything["yaw_deg"]["max"] < stored["bars"]["yaw_deg"][1]
    assert stored["map_error_mm"][0] < 0.3
    assert "found by the plain stage" in capsys.readouterr().out
