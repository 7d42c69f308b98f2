"""What :mod:`marl_handover.compose` knows about a tree of dataclasses: its keys, their types, and the files of named options."""

from __future__ import annotations

import difflib
import functools
import types
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from marl_handover.errors import BadOverride, HandoverError, MissingFile, UnknownChoice, UnknownKey
from marl_handover.files import expanded

Groups = Mapping[str, Mapping[str, type]]
"""Dotted key -> option name -> dataclass."""

Keys = tuple[str, ...]
"""A dotted key, split."""


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


def option_file(key: str, value: str, folder: Path, named_in: Path | None) -> Path:
    """The YAML file that ``key=value`` means: a name in ``folder``, or a path.

    A path is one with a slash or a YAML suffix; inside a file (``named_in``) it counts from that file's folder.
    Raises :class:`MissingFile`, :class:`UnknownChoice`, or :class:`BadOverride` if ``key`` has no named options at all.
    """
    if "/" in value or value.endswith((".yaml", ".yml")):
        path = expanded(value)
        path = named_in.parent / path if named_in is not None else path
        if not path.is_file():
            raise MissingFile(f"{key} file", path, "check the path, or use a name" + _listing(folder))
        return path
    names = option_names(folder)
    if value in names:
        return folder / f"{value}.yaml"
    if not names:
        raise BadOverride(
            f"{key}={value}", f"{key} is a section: set its keys one by one ({key}.key=value) or give a YAML file (./file.yaml)"
        )
    raise UnknownChoice(key, value, [*closest_first(value, names), "a path such as ./my.yaml"])


def _listing(folder: Path) -> str:
    names = option_names(folder)
    return f": {', '.join(names)}" if names else ""
