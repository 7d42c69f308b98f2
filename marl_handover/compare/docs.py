"""The page of results: its tables and pictures come from stored evidence, between marks, and from nowhere else.

``<!-- table:SUITE/NAME -->`` or ``<!-- figure:SUITE/NAME -->`` opens a block, ``<!-- end -->`` closes it. What stands between is replaced.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from marl_handover.compare.tables import make_tables, markdown
from marl_handover.errors import HandoverError
from marl_handover.parsing import read_json

NOT_RUN = "Not run yet."
RESULTS = "results.json"

_BLOCK = re.compile(r"(<!-- (table|figure):([a-z0-9_]+)/([a-z0-9_]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


class UnknownBlock(HandoverError):
    """A mark on the page for a table or figure that the stored results do not have."""

    def __init__(self, kind: str, suite: str, name: str) -> None:
        super().__init__(f"the page asks for the {kind} {name!r} of suite {suite!r}, which its stored results do not have")
        self.kind, self.suite, self.name = kind, suite, name


class UnfitEvidence(HandoverError):
    """Results that the page must not show."""

    def __init__(self, out: Path, reason: str) -> None:
        super().__init__(f"{out}: {reason}")
        self.out, self.reason = out, reason


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
        content = NOT_RUN + "\n"
        if suite in evidence:
            results = evidence[suite]
            shown = _table(results, suite, name) if kind == "table" else _figure(results, suite, name, pictures)
            content = (partial_line(results) + "\n\n" if results["partial"] else "") + shown
        return match[1] + "\n" + content + "\n" + match[6]

    return _BLOCK.sub(replaced, page)


def partial_line(results: Mapping[str, Any]) -> str:
    """How many seeds of which rows partial results have: ``2 of 5 seeds so far: ...``."""
    groups: dict[str, list[str]] = {}
    for part in results["progress"]:
        groups.setdefault(f"{part['done']} of {part['of']} seeds so far", []).append(f"*{part['label']}*")
    if len(groups) == 1:
        return f"Partial: {next(iter(groups))}, of all rows."
    return "Partial: " + "; ".join(f"{count}: {', '.join(labels)}" for count, labels in groups.items()) + "."


def _table(results: Mapping[str, Any], suite: str, name: str) -> str:
    for table in make_tables(results):
        if table.name == name:
            return markdown(table)
    if results["partial"] and name in [spec["name"] for spec in results["tables"]]:
        return NOT_RUN + "\n"
    raise UnknownBlock("table", suite, name)


def _figure(results: Mapping[str, Any], suite: str, name: str, pictures: str) -> str:
    for spec in results["figures"]:
        if spec["name"] == name:
            return (
                NOT_RUN + "\n"
                if name in results["empty_figures"]
                else f"![{spec['title'] or name}]({pictures}/{suite}/figures/{name}.png)\n"
            )
    raise UnknownBlock("figure", suite, name)


def store_evidence(out: Path, folder: Path, partial: bool = False) -> Path:
    """Put what the page needs of a suite's results from ``out`` in place of what ``folder``/SUITE holds; returns that folder.

    Args:
        out: folder that ``compare`` filled.
        folder: of all evidence.
        partial: take results that do not have all rows and seeds of the suite, too.

    Raises:
        MissingFile, CorruptFile: ``out`` holds no results.
        UnfitEvidence: they are partial, of the smoke size, have failures, or their tables or pictures are not all there.
    """
    results = read_json(out / RESULTS, "results")
    files = _required(results, out, partial)
    home = folder / str(results["suite"])
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as temporary:
        new = Path(temporary) / home.name
        for name in files:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(out / name, new / name)
        if home.exists():
            home.rename(Path(temporary) / "old")
        new.rename(home)
    return home


def _required(results: Mapping[str, Any], out: Path, partial: bool) -> list[str]:
    """The files to keep, all of them there."""
    again = "make them again with report_only=true"
    if not {"partial", "progress", "empty_figures"} <= set(results):
        raise UnfitEvidence(out, f"its results are of an older version; {again}")
    if results["size"] != "full":
        raise UnfitEvidence(out, f"its results are of the size {results['size']}")
    if results["failures"]:
        raise UnfitEvidence(out, f"its results have failures: {', '.join(results['failures'])}")
    if results["partial"] and not partial:
        raise UnfitEvidence(out, f"its results are not the whole suite ({partial_line(results)}); partial=true takes them all the same")
    tables = [f"tables/{table.name}.{suffix}" for table in make_tables(results) for suffix in ("md", "csv")]
    drawn = [spec["name"] for spec in results["figures"] if spec["name"] not in results["empty_figures"]]
    files = [RESULTS, *tables, *(f"figures/{name}.png" for name in drawn)]
    if lacking := [name for name in files if not (out / name).is_file()]:
        raise UnfitEvidence(out, f"it lacks {', '.join(lacking)}; {again}")
    return files
