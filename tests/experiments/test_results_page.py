"""What may stand on the page of results: whole suites, and partial ones that say so."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from marl_handover.cli import main
from marl_handover.experiments.tables import NOT_RUN, UnfitEvidence, UnknownBlock, filled, partial_line, read_evidence, store_evidence

SUITE = """
seeds: 2
rows: [{name: exact, label: exact planner, policy: exact}, {name: greedy, policy: greedy}]
evaluations: [{name: kinematic, arguments: [episodes=10]}]
figures: [{name: success, kind: bars}, {name: learning, kind: curves}]
tables: [{name: success, kind: evaluation}]
"""
PAGE = "# P\n\n<!-- table:mine/success -->\nold\n<!-- end -->\n<!-- figure:mine/success -->\n<!-- end -->\n"


def compared(folder: Path, *arguments: str) -> Path:
    (folder / "mine.yaml").write_text(SUITE)
    assert main(["compare", f"suite={folder / 'mine.yaml'}", f"out={folder / 'out'}", "jobs=1", "progress=false", *arguments]) == 0
    return folder / "out"


def test_a_part_is_refused_unless_asked_for_and_then_the_page_says_how_much_it_is(tmp_path):
    evidence = tmp_path / "evidence"
    out = compared(tmp_path, "rows=[exact]", "seeds=1")
    with pytest.raises(UnfitEvidence, match="1 of 2 seeds so far: .exact planner.; 0 of 2 seeds so far: .greedy.*partial=true"):
        store_evidence(out, evidence)
    assert not evidence.exists()
    assert filled(PAGE, {}, "pictures").count(NOT_RUN) == 2
    store_evidence(out, evidence, partial=True)
    page = filled(PAGE, read_evidence(evidence), "pictures")
    line = "Partial: 1 of 2 seeds so far: *exact planner*; 0 of 2 seeds so far: *greedy*."
    assert f"<!-- table:mine/success -->\n\n{line}\n\n| row |" in page
    assert f"<!-- figure:mine/success -->\n\n{line}\n\n![success](pictures/mine/figures/success.png)" in page
    empty = filled("<!-- figure:mine/learning -->\n<!-- end -->", read_evidence(evidence), "pictures")
    assert empty == f"<!-- figure:mine/learning -->\n\n{line}\n\n{NOT_RUN}\n\n<!-- end -->"
    with pytest.raises(UnknownBlock, match="'cost' of suite 'mine'"):
        filled("<!-- table:mine/cost -->\n<!-- end -->", read_evidence(evidence), "pictures")


def test_a_whole_suite_takes_the_place_of_what_was_there_and_nothing_unfit_does(tmp_path):
    evidence = tmp_path / "evidence"
    out = compared(tmp_path)
    home = store_evidence(out, evidence)
    (home / "tables/old.csv").write_text("old")
    store_evidence(out, evidence)
    kept = {str(path.relative_to(evidence)): path.read_bytes() for path in evidence.rglob("*") if path.is_file()}
    assert set(kept) == {f"mine/{name}" for name in ("results.json", "tables/success.md", "tables/success.csv", "figures/success.png")}
    assert "Partial" not in filled(PAGE, read_evidence(evidence), "pictures")
    whole = json.loads((out / "results.json").read_text())
    older = {key: value for key, value in whole.items() if key != "progress"}
    for wrong, word in (({**whole, "size": "quick"}, "quick"), ({**whole, "failures": {"a/seed0": "x"}}, "a/seed0"), (older, "older")):
        (out / "results.json").write_text(json.dumps(wrong))
        with pytest.raises(UnfitEvidence, match=word):
            store_evidence(out, evidence, partial=True)
    (out / "results.json").write_text(json.dumps(whole))
    (out / "figures/success.png").unlink()
    with pytest.raises(UnfitEvidence, match=r"lacks figures/success\.png"):
        store_evidence(out, evidence)
    assert {str(path.relative_to(evidence)): path.read_bytes() for path in evidence.rglob("*") if path.is_file()} == kept


def test_rows_that_are_equally_far_are_told_together():
    rows = [("a", 2, 5), ("b", 2, 5), ("c", 3, 3)]
    progress = [{"label": label, "done": done, "of": of} for label, done, of in rows]
    assert partial_line({"progress": progress}) == "Partial: 2 of 5 seeds so far: *a*, *b*; 3 of 3 seeds so far: *c*."
    assert partial_line({"progress": progress[:2]}) == "Partial: 2 of 5 seeds so far, of all rows."
