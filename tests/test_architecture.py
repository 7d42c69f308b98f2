"""docs/architecture.md names what there is."""

from __future__ import annotations

import re
from pathlib import Path

import marl_handover

PACKAGE = Path(marl_handover.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "architecture.md"


def test_every_folder_of_the_package_is_on_the_page_and_the_other_way_round():
    table = PAGE.read_text().split("| --- | --- |\n", 1)[1].split("\n\n", 1)[0]
    named = set(re.findall(r"`(\w+)/`", table))
    there = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert named == there


def test_every_file_that_the_page_names_exists():
    text = PAGE.read_text()
    named = set(re.findall(r"`((?:\w+/)+\w+\.py)`", text)) | {f"motion/{name}.py" for name in ("planner", "path_optimizer", "objective")}
    named |= set(re.findall(r"`((?:commands|control|motion|task|hardware)/\w+)`", text))
    assert len(named) > 12
    missing = [name for name in sorted(named) if not ((PACKAGE / name).exists() or (PACKAGE / f"{name}.py").exists())]
    assert not missing
