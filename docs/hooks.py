"""What the site takes from elsewhere at build time: the commands' keys, the package's docstrings, the stored figures of results."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import marl_handover
from marl_handover.cli import COMMANDS, PROGRAM
from marl_handover.schema import KeyRow, key_rows

ROOT = Path(__file__).resolve().parents[1]
STORED = "bench/results"
ALONE = ("config", "errors")
"""Modules outside the package's folders that users meet."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill in the two lists of the navigation that follow from the code."""
    reference: list[dict[str, Any]] = next(entry["Reference"] for entry in config.nav or [] if "Reference" in entry)
    for section in reference:
        if "Commands" in section:
            section["Commands"] = [{name: f"reference/commands/{name}.md"} for name in COMMANDS]
        if "Package" in section:
            section["Package"] = [{name: f"reference/package/{name}.md"} for name in packages()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages made here, and the stored figures."""
    for name in COMMANDS:
        files.append(File.generated(config, f"reference/commands/{name}.md", content=command_page(name)))
    for name in packages():
        files.append(File.generated(config, f"reference/package/{name}.md", content=package_page(name)))
    for picture in sorted((ROOT / STORED).rglob("*.png")):
        files.append(File.generated(config, picture.relative_to(ROOT).as_posix(), abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """In the repository ``bench`` stands beside ``docs``; in the site, inside it."""
    return markdown.replace(f"](../{STORED}/", f"]({STORED}/")


def packages() -> list[str]:
    """The package's folders, in the order of their names, then single modules."""
    folders = sorted(module.name for module in pkgutil.iter_modules(marl_handover.__path__) if module.ispkg)
    return [*(name for name in folders if name != "commands"), *ALONE]


def package_page(name: str) -> str:
    """A page that mkdocstrings fills from the docstrings of ``marl_handover.<name>``."""
    return f"# marl_handover.{name}\n\n::: marl_handover.{name}\n    options: {{show_root_heading: false, show_root_toc_entry: false}}\n"


def command_page(name: str) -> str:
    """What ``marl-handover <name> --help`` says, as a page."""
    command = COMMANDS[name]
    lines = ["---", "hide: [toc]", "---", "", f"# {PROGRAM} {name}", "", f"{command.summary[0].upper()}{command.summary[1:]}.", ""]
    lines += ["Keys are given as `key=value`; `debug=true` shows the traceback of an error.", ""]
    rows = command_rows(name)
    if not rows:
        return "\n".join([*lines, "It has no keys.", ""])
    lines += ["| key | type or choices | default | |", "| --- | --- | --- | --- |"]
    for key, kind, default, doc in rows:
        lines.append(f"| {_code(key)} | {_code(kind)} | {_code(default)} | {_plain(doc)} |")
    return "\n".join([*lines, ""])


def command_rows(name: str) -> list[KeyRow]:
    """Key, type, default and comment of every key of a command."""
    module = importlib.import_module(COMMANDS[name].module)
    return key_rows(module.SCHEMA, module.ALIASES, module.GROUPS)


def _code(text: str) -> str:
    return f"<code>{_plain(text)}</code>" if text else ""


def _plain(text: str) -> str:
    """``text`` with every sign that means something in Markdown, a table or HTML as an entity."""
    return "".join(f"&#{ord(sign)};" if sign in "\\`*_[]|<>&~^" else sign for sign in text)
