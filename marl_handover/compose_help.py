"""The table of keys that ``marl-handover COMMAND --help`` prints, read from the dataclasses and their comments."""

from __future__ import annotations

import ast
import enum
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from marl_handover.compose import Groups, option_names, without_none
from marl_handover.errors import MissingFile
from marl_handover.files import resource_path


class KeyRow(NamedTuple):
    """A key, its type or choices, its default and its comment, as text."""

    key: str
    kind: str
    default: str
    doc: str


class _FieldNotes(NamedTuple):
    kind: str  # the annotation as written
    doc: str


def keys_help(schema: type, aliases: Mapping[str, str] | None = None, groups: Groups | None = None, configs: Path | None = None) -> str:
    """One line for each key of the dataclass ``schema``: key (and its shorthand), type, default, comment.

    Args:
        schema: root dataclass.
        aliases: short key -> dotted key, as for :func:`marl_handover.compose.compose`.
        groups: options that are code; each option's own keys get a block.
        configs: folder with the YAML options; the shipped one unless given.
    """
    rows = key_rows(schema, aliases, groups, configs)
    if not rows:
        return "no keys"
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    widths = [min(width, limit) for width, limit in zip(widths, (44, 28, 24), strict=True)]
    return "\n".join("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row.doc]).rstrip() for row in rows)


def key_rows(
    schema: type, aliases: Mapping[str, str] | None = None, groups: Groups | None = None, configs: Path | None = None
) -> list[KeyRow]:
    """What :func:`keys_help` prints, row by row; same arguments; empty for a schema without fields."""
    if not fields(schema):
        return []
    if configs is None:
        try:
            configs = resource_path("configs")
        except MissingFile:
            configs = Path()
    short = {long: alias for alias, long in (aliases or {}).items()}
    rows = list(_rows(schema, "", groups or {}, configs))
    presets = option_names(configs / "preset")
    if presets and "preset" not in {field.name for field in fields(schema)}:
        rows.append(KeyRow("preset", " | ".join(presets), "", "named differences over all keys; or a YAML file"))
    return [row._replace(key=f"{short[row.key]} = {row.key}" if row.key in short else row.key) for row in rows]


def _rows(schema: type, prefix: str, groups: Groups, configs: Path) -> Iterator[KeyRow]:
    notes, hints = _notes(schema), get_type_hints(schema)
    for field in fields(schema):
        key = prefix + field.name
        note = notes.get(field.name, _FieldNotes(getattr(hints[field.name], "__name__", str(hints[field.name])), ""))
        default = field.default_factory() if field.default_factory is not MISSING else field.default
        if key in groups:
            yield KeyRow(key, " | ".join(groups[key]), str(getattr(default, "name", "")), note.doc)
            for name, option in groups[key].items():
                own = [row for row in _rows(option, f"{key}.", groups, configs) if row.key != f"{key}.name"]
                yield from (row._replace(doc=f"[{name}] {row.doc}".rstrip()) for row in own)
            continue
        section = type(default) if is_dataclass(default) else without_none(hints[field.name])
        if not (isinstance(section, type) and is_dataclass(section)):
            yield KeyRow(key, note.kind, _show(default), note.doc)
            continue
        options = option_names(configs / field.name) if field.name != "preset" else ()
        if options or note.doc:
            yield KeyRow(key, " | ".join((*options, "FILE.yaml")), "", note.doc)
        yield from _rows(section, f"{key}.", groups, configs)


def _show(default: Any) -> str:
    if default is MISSING or default == "???":
        return "(must be given)"
    if default is None:
        return "null"
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, enum.Enum):
        return default.name
    return str(default) if default != "" else "''"


def _notes(schema: type) -> dict[str, _FieldNotes]:
    """Annotation and trailing comment (or docstring below) of each field, base classes first; empty where there is no source."""
    notes: dict[str, _FieldNotes] = {}
    for cls in reversed(schema.__mro__):
        if not is_dataclass(cls):
            continue
        try:
            source = textwrap.dedent(inspect.getsource(cls))
            body = ast.parse(source).body[0].body  # type: ignore[attr-defined]  # the source of a class is a ClassDef
        except (OSError, TypeError, SyntaxError):
            continue
        comments = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        for statement, following in zip(body, [*body[1:], None], strict=True):
            if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                doc = comments.get(statement.end_lineno or 0, "")
                if not doc and isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                    doc = " ".join(str(following.value.value).split())
                notes[statement.target.id] = _FieldNotes(ast.unparse(statement.annotation), doc)
    return notes
