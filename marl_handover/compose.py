"""Settings from dataclasses, named YAML differences and ``key=value`` overrides in Hydra's grammar.

Hydra parses the values and OmegaConf checks the types; what is ours is the order, the errors and the freedom to use ``=`` in text.
From weak to strong, whatever the order typed:

1. the dataclass defaults,
2. the chosen options: a dataclass registered in code (``algorithm=td3``) or a YAML file (``cell=al5a``, ``cell=my/cell.yaml``),
3. the preset (``preset=paper_b``): differences over the whole tree, which may choose options itself (a schema with a field ``preset`` of
   its own has none: there, the word is that field),
4. single values (``task.epsilon_deg=3``).

Nothing global is touched: no run directory, no logging, no registered config.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from marl_handover.bounds import check_bounds, expand_paths
from marl_handover.errors import BadOverride, CorruptFile, HandoverError, MissingFile, RenamedKey, UnknownChoice
from marl_handover.files import expanded, resource_path
from marl_handover.parsing import DEPTH, nesting, parse_yaml, read_yaml
from marl_handover.schema import (
    RENAMED,
    RENAMED_OPTIONS,
    SYNONYMS,
    Groups,
    Keys,
    SchemaTree,
    closest_first,
    fitted,
    option_names,
    without_none,
)

LONGEST_ARGUMENT = 5000
"""Characters of a ``key=value``: Hydra's parser takes its time over long ones, and text is at most 4096."""

_KEY = re.compile(r"[A-Za-z_]\w*(\.[\w-]+)*")
_MANY_DIGITS = re.compile(r"\d{100,}")
_DEFAULTS_KEY = re.compile(r"(?:override\s+)?/?([\w.]+)")


def compose(
    schema: type,
    overrides: Sequence[str],
    groups: Groups | None = None,
    aliases: Mapping[str, str] | None = None,
    configs: Path | None = None,
) -> Any:
    """An instance of the dataclass ``schema`` with every override applied.

    Args:
        schema: root dataclass.
        overrides: ``key=value`` texts, in any order.
        groups: dotted key -> option name -> dataclass, for options that are code. Each such dataclass has a field ``name`` whose default is
            the option's name, so that a written configuration says which option it holds.
        aliases: short key -> dotted key, such as ``{"architecture": "task.architecture"}``.
        configs: folder of ``<group>/<name>.yaml`` and ``preset/<name>.yaml``; the shipped one unless given.

    Raises:
        UnknownKey, UnknownChoice, BadOverride, MissingFile, CorruptFile: each in one line that names what was typed.
    """
    composer = _Composer(schema, groups or {}, aliases or {}, configs if configs is not None else resource_path("configs"))
    return composer.run([composer.split(text) for text in overrides])


def to_yaml(config: Any) -> str:
    """Every value of the dataclass instance ``config`` as YAML, defaults included; :func:`from_yaml` reads it back."""
    return OmegaConf.to_yaml(OmegaConf.create(_plain(asdict(config))))


def changed_yaml(config: Any) -> str:
    """As :func:`to_yaml`, without what is as the dataclasses say by default, for people to read. Entries of lists lack empty texts only."""
    return OmegaConf.to_yaml(OmegaConf.create(_plain(_changed(config))))


def _changed(config: Any, entry_of_list: bool = False) -> Any:
    if isinstance(config, list):
        return [_changed(entry, entry_of_list=True) for entry in config]
    if not is_dataclass(config) or isinstance(config, type):
        return config
    usual = type(config)()
    values = {entry.name: (getattr(config, entry.name), getattr(usual, entry.name)) for entry in fields(config)}
    return {name: _changed(value) for name, (value, default) in values.items() if (value != "" if entry_of_list else value != default)}


def from_yaml(schema: type, path: Path | str, groups: Groups | None = None) -> Any:
    """The instance of ``schema`` that :func:`to_yaml` wrote to ``path``; keys that are absent keep their defaults.

    Raises :class:`MissingFile`, or :class:`CorruptFile` when the file is no YAML mapping or does not fit ``schema``.
    """
    path = Path(path)
    return _fitted_tree(schema, read_yaml(path, "configuration"), path, groups)


def from_text(schema: type, text: str, origin: Path, groups: Groups | None = None, stored: bool = True) -> Any:
    """As :func:`from_yaml`, of YAML text from the file ``origin``; if it was ``stored`` by a program, its keys may have older names."""
    try:
        tree = parse_yaml(text)
    except ValueError as error:
        raise CorruptFile("configuration in", origin, str(error)) from error
    return _fitted_tree(schema, tree, origin, groups, stored)


def from_mapping(schema: type, tree: Mapping[str, Any], origin: Path) -> Any:
    """As :func:`from_text`, of what a program stored in ``origin``, already parsed."""
    return _fitted_tree(schema, tree, origin, None, stored=True)


def present_names(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Stored settings, by dotted key, with the names that keys and options have now."""
    named = {".".join(RENAMED.get(part, part) for part in key.split(".")): value for key, value in settings.items()}
    options = {(f"{group}.name", old): new for (group, old), new in RENAMED_OPTIONS.items()}
    return {key: options.get((key, value), value) if isinstance(value, str) else value for key, value in named.items()}


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _fitted_tree(schema: type, tree: Mapping[Any, Any], path: Path, groups: Groups | None, stored: bool = False) -> Any:
    composer = _Composer(schema, groups or {}, {}, path.parent, stored)
    try:
        composer.assign_tree((), tree, path)
        return composer.finish()
    except CorruptFile:
        raise
    except HandoverError as error:
        raise CorruptFile("configuration", path, str(error)) from error


@dataclass(frozen=True)
class _Argument:
    """One command line override, its key already resolved to a path."""

    text: str
    keys: Keys
    raw: str

    @property
    def choice(self) -> str | None:
        """The option's name if this may choose one; None for a ``{...}`` value and for null."""
        return None if self.raw.startswith("{") or self.raw == "null" else self.raw.strip("'\"")


@dataclass(frozen=True)
class _Choice:
    """A chosen option and where it was written; a relative path in a file counts from that file's folder."""

    name: str
    file: Path | None = None


class _Composer:
    """Holds the growing configuration of one call."""

    def __init__(self, schema: type, groups: Groups, aliases: Mapping[str, str], configs: Path, stored: bool = False) -> None:
        self.tree = SchemaTree(schema, aliases)
        self.groups = {tuple(group.split(".")): options for group, options in groups.items()}
        self.aliases, self.configs, self.stored = aliases, configs, stored
        self.references: list[tuple[Keys, str, Path | None]] = []
        """What was set by a reference such as ``${seed}``: only when all is set is its value known, and its kind checked."""

    def split(self, text: str) -> _Argument:
        """``text`` at its first ``=``, with a shorthand replaced by the key it stands for."""
        if len(text) > LONGEST_ARGUMENT:
            raise BadOverride(text, f"it has {len(text)} characters, more than {LONGEST_ARGUMENT}")
        key, equals, raw = text.partition("=")
        key = key.strip()
        if key.startswith("~"):
            raise BadOverride(text, "a setting cannot be removed, only changed")
        key = key.lstrip("+")
        if not equals:
            raise BadOverride(text, "expected key=value")
        if not _KEY.fullmatch(key):
            raise BadOverride(text, f"{key!r} is not a key; expected key=value, such as seed=1 or section.key=1")
        first, _, rest = key.partition(".")
        if key in self.aliases:
            key = self.aliases[key]
        elif first in self.aliases and rest:
            key = f"{self.aliases[first]}.{rest}"
        keys = tuple(key.split("."))
        if keys[-1] in SYNONYMS and self.tree.has((*keys[:-1], SYNONYMS[keys[-1]])) and not self.tree.has(keys):
            keys = (*keys[:-1], SYNONYMS[keys[-1]])
        return _Argument(text, keys, raw.strip())

    def run(self, arguments: list[_Argument]) -> Any:
        """Apply choices, preset and values, weakest first."""
        choices: dict[Keys, _Choice] = {}
        preset: dict[str, Any] = {}
        file = None
        own = "preset" in self.tree.names(())  # then the word is a setting of the schema like any other
        preset_name = None if own else next((a.choice for a in reversed(arguments) if a.keys == ("preset",)), None)
        if preset_name:
            file = option_file("preset", preset_name, self.configs / "preset", None)
            preset = read_yaml(file, "preset")
            self._take_defaults(preset, choices, file)
            self._take_choices(preset, (), choices, file)
        values = []
        for argument in arguments:
            if argument.keys == ("preset",) and not own:
                continue
            chosen = argument.keys[:-1] if argument.keys[-1] == "name" and argument.keys[:-1] in self.groups else argument.keys
            if argument.choice is None or not self._is_section(chosen):
                values.append(argument)
                continue
            if chosen in choices and choices[chosen].name != argument.choice:
                _drop(preset, chosen)  # those differences were meant for the option that the command line replaced
            choices[chosen] = _Choice(argument.choice)
        for keys in sorted(choices, key=len):
            self._choose(keys, choices[keys])
        self.assign_tree((), preset, file)
        for argument in values:
            self._assign(argument.keys, self._read(argument), argument.text, None)
        return self.finish()

    def finish(self) -> Any:
        """The typed instance, every value within its bounds."""
        try:
            for keys, text, file in tuple(self.references):
                value = OmegaConf.select(self.tree.config, ".".join(keys))
                self._assign(keys, OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value, text, file)
            config = OmegaConf.to_object(self.tree.config)
        except MissingMandatoryValue as error:
            raise BadOverride(f"{error.full_key}=…", "this setting has no default and must be given") from error
        except OmegaConfBaseException as error:
            raise BadOverride(error.full_key or "configuration", _reason(error)) from error
        expand_paths(config)
        check_bounds(config)
        return config

    def assign_tree(self, keys: Keys, tree: Mapping[Any, Any], file: Path | None) -> None:
        """Merge a nested mapping below ``keys``."""
        name = tree.get("name")
        if keys in self.groups and isinstance(name, str):
            if self.stored:
                name = RENAMED_OPTIONS.get((".".join(keys), name), name)
                tree = {**tree, "name": name}
            self._choose(keys, _Choice(name, file))
        names = self.tree.names(keys)
        tree = {SYNONYMS[key] if key not in names and SYNONYMS.get(key) in names else key: value for key, value in tree.items()}
        if self.stored:
            tree = {RENAMED[key] if key not in names and RENAMED.get(key) in names else key: value for key, value in tree.items()}
        for key, value in tree.items():
            path = (*keys, str(key))
            self._assign(path, value, f"{'.'.join(path)}={value}", file)

    def _is_section(self, keys: Keys) -> bool:
        return keys in self.groups or (self.tree.has(keys) and is_dataclass(without_none(self.tree.kind(keys))))

    def _take_defaults(self, preset: dict[str, Any], choices: dict[Keys, _Choice], file: Path) -> None:
        """Move Hydra's ``defaults: [override /group: option]`` out of ``preset`` into ``choices``."""
        entries = preset.pop("defaults", [])
        for entry in entries if isinstance(entries, list) else [entries]:
            if entry == "_self_":
                continue
            pairs = list(entry.items()) if isinstance(entry, dict) else []
            match = _DEFAULTS_KEY.fullmatch(str(pairs[0][0])) if len(pairs) == 1 else None
            if match is None or not isinstance(pairs[0][1], str):
                raise CorruptFile("preset", file, f"defaults: expected entries like 'cell: al5a', got {entry!r}")
            choices[tuple(match[1].split("."))] = _Choice(pairs[0][1], file)

    def _take_choices(self, tree: dict[str, Any], keys: Keys, choices: dict[Keys, _Choice], file: Path) -> None:
        """Move ``cell: al5a`` and the name in ``algorithm: {name: td3, ...}`` out of ``tree`` into ``choices``."""
        for key in list(tree):
            path, value = (*keys, str(key)), tree[key]
            if isinstance(value, str) and self._is_section(path):
                choices[path] = _Choice(tree.pop(key), file)
            elif isinstance(value, dict):
                if path in self.groups and isinstance(value.get("name"), str):
                    choices[path] = _Choice(value.pop("name"), file)
                self._take_choices(value, path, choices, file)

    def _choose(self, keys: Keys, choice: _Choice) -> None:
        """Put a chosen option in place: a dataclass from code, or a YAML file over what is there."""
        dotted = ".".join(keys)
        if keys in self.groups:
            if (dotted, choice.name) in RENAMED_OPTIONS:
                raise RenamedKey(f"{dotted}={choice.name}", f"{dotted}={RENAMED_OPTIONS[dotted, choice.name]}")
            if choice.name not in self.groups[keys]:
                raise UnknownChoice(dotted, choice.name, self.groups[keys])
            option = self.groups[keys][choice.name]
            if getattr(option, "name", None) != choice.name:
                raise TypeError(f"option {dotted}={choice.name}: {option.__name__} needs the field: name: str = {choice.name!r}")
            OmegaConf.update(self.tree.config, dotted, OmegaConf.structured(option), merge=False)
            return
        if not self._is_section(keys):
            raise BadOverride(f"{dotted}={choice.name}", f"{dotted} is a single value, not a section with options")
        file = option_file(dotted, choice.name, self.configs / keys[-1], choice.file)
        tree = read_yaml(file, keys[-1])
        if "name" in self.tree.names(keys):
            tree.setdefault("name", file.stem)  # so that a user's cell does not pass for the shipped one
        self.assign_tree(keys, tree, file)

    def _read(self, argument: _Argument) -> Any:
        """The argument's value: literal text for a text setting, else Hydra's grammar."""
        kind = self.tree.kind(argument.keys)
        bare, raw = without_none(kind), argument.raw
        quoted = raw[:1] in ("'", '"')
        if bare in (str, Path) and not quoted:
            return None if raw == "null" and bare != kind else raw
        if nesting(raw) > DEPTH:
            raise BadOverride(argument.text, f"its brackets nest deeper than {DEPTH} levels")
        if digits := _MANY_DIGITS.search(raw):
            raise BadOverride(argument.text, f"it holds a number of {len(digits[0])} digits")
        try:
            override: Override = OverridesParser.create().parse_override(f"{argument.keys[0]}={raw}")
        except HydraException as error:
            if str in getattr(bare, "__args__", ()) and not quoted:
                return raw
            raise BadOverride(argument.text, f"{_reason(error)}; quote text that has special characters") from error
        if override.is_sweep_override():
            raise BadOverride(argument.text, f"one value is needed here; a list is written {'.'.join(argument.keys)}=[1,2]")
        return override.value()

    def _assign(self, keys: Keys, value: Any, text: str, file: Path | None) -> None:
        """Set one value, or each value of a mapping, with its type checked."""
        where = f" in {file}" if file else ""
        if keys == ("preset",) and file is not None and "preset" not in self.tree.names(()):
            raise BadOverride(text + where, "a preset cannot name another preset")
        kind = self.tree.kind(keys, where)
        bare = without_none(kind)
        if keys in self.groups or is_dataclass(bare):
            if isinstance(value, Mapping):
                return self.assign_tree(keys, value, file)
            if isinstance(value, str):
                return self._choose(keys, _Choice(value, file))
            if not (value is None and bare != kind):
                raise BadOverride(text + where, f"{'.'.join(keys)} is a section; set one of: {', '.join(self.tree.names(keys))}")
        if bare not in (str, Path) and "${" in str(value):
            self.references.append((keys, text, file))
        try:
            self.tree.merge(keys, fitted(bare, value))
        except (OmegaConfBaseException, ValueError, TypeError, OverflowError) as error:
            raise BadOverride(text + where, _reason(error)) from error
        return None


def _drop(tree: dict[str, Any], keys: Keys) -> None:
    for key in keys[:-1]:
        tree = tree.get(key) or {}
    tree.pop(keys[-1], None)


def _reason(error: Exception) -> str:
    """First line of a message; both libraries put the essence there."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def _plain(value: Any) -> Any:
    """``value`` in YAML's own types, with ``${`` escaped because OmegaConf would take it for a reference."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Path):
        value = str(value)
    if isinstance(value, str):
        return re.sub(r"(\\*)\$\{", lambda match: match[1] * 2 + "\\${", value)
    return value


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
