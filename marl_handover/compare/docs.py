"""The page of results: its tables and pictures come from stored evidence, between marks, and from nowhere else.

``<!-- table:SUITE/NAME -->`` or ``<!-- figure:SUITE/NAME -->`` opens a block, ``<!-- end -->`` closes it. What stands between is replaced.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from marl_handover.compare.tables import make_tables, markdown
from marl_handover.errors import HandoverError
from marl_handover.report.files import read_json

NOT_RUN = "Not run yet."
RESULTS = "results.json"

_BLOCK = re.compile(r"(<!-- (table|figure):([a-z0-9_]+)/([a-z0-9_]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


class UnknownBlock(HandoverError):
    """A mark on the page for a table or figure that the stored results do not have."""

    def __init__(self, kind: str, suite: str, name: str) -> None:
        super().__init__(f"the page asks for the {kind} {name!r} of suite {suite!r}, which its stored results do not have")
        self.kind, self.suite, self.name = kind, suite, name


class Block(NamedTuple):
    """One block of a page: ``kind`` table or figure, and what stands in it."""

    kind: str
    suite: str
    name: str
    content: str


def blocks(page: str) -> list[Block]:
    """All blocks of a page, in order."""
    return [Block(match[2], match[3], match[4], match[5]) for match in _BLOCK.finditer(page)]


def read_evidence(folder: Path) -> dict[str, dict[str, Any]]:
    """Stored results by suite, of the folders in ``folder`` that have them."""
    return {path.parent.name: read_json(path, "stored results") for path in sorted(folder.glob(f"*/{RESULTS}"))}


def filled(page: str, evidence: Mapping[str, Mapping[str, Any]], pictures: str) -> str:
    """The page with every block made anew; a suite without evidence says that it was not run.

    Args:
        page: Markdown.
        evidence: content of ``results.json`` by suite.
        pictures: where the page finds the folders ``SUITE/figures``, relative to itself.

    Raises:
        UnknownBlock: evidence without the table or figure.
    """

    def replaced(match: re.Match[str]) -> str:
        kind, suite, name = match[2], match[3], match[4]
        content = f"\n{NOT_RUN}\n\n"
        if suite in evidence:
            content = "\n" + (_table if kind == "table" else _figure)(evidence[suite], suite, name, pictures) + "\n"
        return match[1] + content + match[6]

    return _BLOCK.sub(replaced, page)


def _table(results: Mapping[str, Any], suite: str, name: str, pictures: str) -> str:
    for table in make_tables(results):
        if table.name == name:
            return markdown(table)
    raise UnknownBlock("table", suite, name)


def _figure(results: Mapping[str, Any], suite: str, name: str, pictures: str) -> str:
    for spec in results["figures"]:
        if spec["name"] == name:
            return f"![{spec['title'] or name}]({pictures}/{suite}/figures/{name}.png)\n"
    raise UnknownBlock("figure", suite, name)


def store_evidence(out: Path, folder: Path) -> Path:
    """Copy what the page needs of a suite's results from ``out`` into ``folder``/SUITE; returns that folder.

    Raises:
        MissingFile, CorruptFile: ``out`` holds no results.
    """
    results = read_json(out / RESULTS, "results")
    home = folder / str(results["suite"])
    for part in ("tables", "figures"):
        shutil.rmtree(home / part, ignore_errors=True)
        (home / part).mkdir(parents=True)
        for path in sorted((out / part).iterdir()):
            if path.suffix in (".csv", ".md", ".png"):
                shutil.copy(path, home / part / path.name)
    shutil.copy(out / RESULTS, home / RESULTS)
    return home
