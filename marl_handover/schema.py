"""The keys of a schema of dataclasses: which there are, their types, their older names; and the table of them that ``--help`` prints."""

from __future__ import annotations

import ast
import difflib
import enum
import functools
import inspect
import io
import textwrap
import tokenize
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from marl_handover.errors import BadOverride, HandoverError, MissingFile, RenamedKey, UnknownKey
from marl_handover.files import resource_path

Groups = Mapping[str, Mapping[str, type]]
"""Dotted key -> option name -> dataclass."""

Keys = tuple[str, ...]
"""A dotted key, split."""

RENAMED = {
    "decay_from": "lr_decay_start",
    "steps_per_update": "env_steps_per_gradient_step",
    "modes": "mixture_components",
    "greedy_share": "deterministic_env_fraction",
    "velocity_share": "velocity_scale",
    "starts": "num_initial_guesses",
    "edge_mm": "reach_slack_mm",
    "glance_s": "poll_period_s",
    "patience_s": "timeout_s",
    "missed_mm": "lost_threshold_mm",
    "cards": "hand_markers",
    "fresh": "overwrite",
}
"""Keys of 0.1 and what they are called now, each without its section. Who types one is told; what was stored with one is read."""

SYNONYMS = {"urdf": "robot"}
"""Older keys that still may be typed, each without its section, and what they are called now."""

RENAMED_OPTIONS = {("algorithm", "box_sac"): "flat_sac"}
"""The same of options that are chosen by name."""


class SchemaTree:
    """A configuration being built, and the questions one can ask about its keys."""

    def __init__(self, schema: type, aliases: Mapping[str, str]) -> None:
        self.config: DictConfig = OmegaConf.structured(schema)
        self._schema, self._aliases = schema, aliases

    def kind(self, keys: Keys, where: str = "") -> Any:
        """Type annotation of a key. Raises :class:`UnknownKey` (with ``where`` after the key) or :class:`BadOverride`."""
        kind: Any = self._schema
        for depth, name in enumerate(keys):
            kind = self._step(keys[:depth], kind, name, where)
        return kind

    def has(self, keys: Keys) -> bool:
        """Whether the key exists."""
        try:
            self.kind(keys)
        except HandoverError:
            return False
        return True

    def names(self, keys: Keys) -> tuple[str, ...]:
        """The keys below a section; empty if it is none."""
        section = self._section(keys, self.kind(keys))
        return tuple(field.name for field in fields(section)) if is_dataclass(section) else ()

    def merge(self, keys: Keys, value: Any) -> None:
        """Merge one value in; OmegaConf's own errors pass through. An optional section that is None starts from its defaults."""
        for depth in range(1, len(keys)):
            above, section = ".".join(keys[:depth]), without_none(self.kind(keys[:depth]))
            if is_dataclass(section) and OmegaConf.select(self.config, above) is None:
                OmegaConf.update(self.config, above, OmegaConf.structured(section), merge=False)
        OmegaConf.update(self.config, ".".join(keys), value, merge=True)

    def _section(self, keys: Keys, kind: Any) -> Any:
        """The type that is in place now, which may be a subclass of the annotated one."""
        node = OmegaConf.select(self.config, ".".join(keys)) if keys else self.config
        live = OmegaConf.get_type(node) if isinstance(node, DictConfig) else None
        return live if is_dataclass(live) else without_none(kind)

    def _step(self, keys: Keys, kind: Any, name: str, where: str) -> Any:
        section = self._section(keys, kind)
        if isinstance(section, type) and is_dataclass(section):
            hints = _hints(section)
            names = [field.name for field in fields(section)]
            if name not in names:
                if RENAMED.get(name) in names:
                    raise RenamedKey(".".join((*keys, name)) + where, ".".join((*keys, RENAMED[name])))
                if (elsewhere := self._deeper(RENAMED.get(name, ""))) and not keys:
                    raise RenamedKey(name + where, elsewhere[0])
                extra = [*self._aliases, "preset"] if names and not keys else []
                raise UnknownKey(".".join((*keys, name)) + where, closest_first(name, [*names, *extra], self._deeper(name)) or ["(none)"])
            return hints[name]
        origin = get_origin(section) or section
        if origin is dict or origin is Mapping:
            return (*get_args(section), Any, Any)[1]
        if section is Any:
            return Any
        dotted = ".".join(keys)
        reason = f"{dotted} is set as a whole: {dotted}=[…]" if origin in (list, tuple) else f"{dotted} is a single value"
        raise BadOverride(".".join((*keys, name)) + where, reason)

    def _deeper(self, name: str) -> list[str]:
        """Dotted keys that end in ``name``: most unknown keys only lack their section."""
        found: list[str] = []

        def walk(node: DictConfig, prefix: str) -> None:
            for key in node:
                if prefix and key == name:
                    found.append(f"{prefix}{name}")
                if not OmegaConf.is_missing(node, key) and isinstance(node._get_node(key), DictConfig) and node[key] is not None:
                    walk(node[key], f"{prefix}{key!s}.")

        walk(self.config, "")
        return found


@functools.cache
def _hints(section: type) -> dict[str, Any]:
    return get_type_hints(section)


def without_none(kind: Any) -> Any:
    """``X`` of ``X | None``; any other annotation as it is."""
    if get_origin(kind) in (Union, types.UnionType):
        rest = tuple(arg for arg in get_args(kind) if arg is not type(None))
        return rest[0] if len(rest) == 1 else Union[rest]  # noqa: UP007  # the members are known only at run time
    return kind


def fitted(kind: Any, value: Any) -> Any:
    """``value`` with whole numbers made what ``kind`` asks for (1 -> 1.0, 1e6 -> 1000000), inside lists and mappings too.

    OmegaConf refuses these inside containers. Raises :class:`ValueError` for a number other than 0 and 1 where true or false is due,
    which OmegaConf would take.
    """
    kind = without_none(kind)
    origin, inner = get_origin(kind), get_args(kind)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if kind is bool and isinstance(value, (int, float)) and value not in (0, 1):
        raise ValueError(f"{value} is neither true nor false")
    if origin is list and isinstance(value, list):
        return [fitted(inner[0], item) for item in value]
    if origin is dict and isinstance(value, Mapping):
        return {key: fitted(inner[1], item) for key, item in value.items()}
    return value


def closest_first(name: str, choices: Iterable[str], before: Iterable[str] = ()) -> list[str]:
    """``before``, then ``choices`` with those that resemble ``name`` in front."""
    choices = list(dict.fromkeys(choices))
    close = difflib.get_close_matches(name, choices, n=3)
    return list(dict.fromkeys([*before, *close, *choices]))


def option_names(folder: Path) -> tuple[str, ...]:
    """Names of the YAML options in a folder, sorted."""
    return tuple(sorted(path.stem for path in folder.glob("*.yaml")))


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


def with_settings(settings: Any, changes: Mapping[str, Any], prefix: str = "") -> Any:
    """A copy of the dataclass instance ``settings`` with single fields changed; a mapping changes fields of a section.

    Raises:
        UnknownKey: there is no such field. ``prefix`` goes before its name.
    """
    names = [item.name for item in fields(settings)]
    values = {}
    for name, value in changes.items():
        if name not in names:
            raise UnknownKey(prefix + name, [prefix + each for each in closest_first(name, names)])
        section = getattr(settings, name)
        nested = isinstance(value, Mapping) and is_dataclass(section)
        values[name] = with_settings(section, value, f"{prefix}{name}.") if nested else value
    return replace(settings, **values)
