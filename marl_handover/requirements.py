"""The packages that this one needs, by extra, and the line that installs them. The package itself is in no index, so no line names it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

PACKAGE = "marl_handover"
CORE = ""
"""The name under which :func:`requirements` has what is needed without any extra."""


def requirements() -> dict[str, tuple[str, ...]]:
    """Requirements such as ``"viser>=1.1"`` of the core and of each extra; empty if nothing tells.

    They are those of the checkout's pyproject.toml or of the installed package's metadata. An editable install's metadata is as old as the
    install, so the checkout goes first.
    """
    file = Path(__file__).resolve().parents[1] / "pyproject.toml"
    if file.is_file():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        return {CORE: tuple(project["dependencies"]), **{extra: tuple(lines) for extra, lines in project["optional-dependencies"].items()}}
    try:
        return by_extra(requires(PACKAGE) or [])
    except PackageNotFoundError:
        return {}


def by_extra(lines: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Requirements of the core and of each extra, from the lines of a package's metadata."""
    found: dict[str, list[str]] = {}
    for line in lines:
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)", line)
        found.setdefault(extra[1] if extra else CORE, []).append(line.partition(";")[0].strip())
    return {extra: tuple(needed) for extra, needed in found.items()}


def name_of(requirement: str) -> str:
    """The package of a requirement, without versions, extras and conditions."""
    return re.split(r"[^\w.-]", requirement.strip(), maxsplit=1)[0]


def install_line(extra: str = CORE, only: Iterable[str] = ()) -> str:
    """The command that installs what an extra needs, or, of that, the packages named in ``only``."""
    wanted = {name.lower() for name in only}
    needed = [line for line in requirements().get(extra, ()) if not wanted or name_of(line).lower() in wanted] or list(only)
    return "pip install " + " ".join(f"'{line}'" if re.search(r"[<>=!~\[; ]", line) else line for line in needed)
