"""What a search may change: ranges of training settings, read from YAML (``configs/search``).

Each key of such a file is a setting of :class:`TrainConfig`, and says how it is drawn::

    algorithm.learning_rate: {type: float, low: 1.0e-4, high: 3.0e-3, log: true}
    algorithm.harmonics: {type: int, low: 0, high: 3}
    algorithm.hidden: {type: categorical, choices: [[128, 128], [256, 256]]}
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml
from optuna import Trial

from marl_handover.compose import from_text, to_yaml
from marl_handover.errors import CorruptFile, HandoverError, UnknownKey
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.parsing import parse_yaml, read_yaml

KINDS = ("float", "int", "categorical")


@dataclass(frozen=True)
class Parameter:
    """One setting and where its values come from: the numbers from ``low`` to ``high``, both included, or one of ``choices``."""

    key: str
    type: str
    low: float = math.nan
    high: float = math.nan
    log: bool = False
    choices: tuple[Any, ...] = ()

    def about(self) -> dict[str, Any]:
        """The description that YAML has of it."""
        if self.type == "categorical":
            return {"type": self.type, "choices": list(self.choices)}
        return {"type": self.type, "low": self.low, "high": self.high, "log": self.log}

    def suggest(self, trial: Trial) -> Any:
        """A value for a trial."""
        if self.type == "categorical":
            return self.read(trial.suggest_categorical(self.key, [_text(choice) for choice in self.choices]))
        if self.type == "int":
            return trial.suggest_int(self.key, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(self.key, self.low, self.high, log=self.log)

    def stored(self, value: Any) -> Any:
        """``value`` as a study holds it: choices need not be numbers, so a study is given their texts."""
        return _text(value) if self.type == "categorical" else value

    def read(self, stored: Any) -> Any:
        """Inverse of :meth:`stored`."""
        return next(choice for choice in self.choices if _text(choice) == stored) if self.type == "categorical" else stored

    def contains(self, value: Any) -> bool:
        """Whether the search could come upon ``value``."""
        return value in self.choices if self.type == "categorical" else bool(self.low <= value <= self.high)

    def samples(self) -> tuple[Any, ...]:
        """Values that show whether a setting can have them all: both ends, or every choice."""
        return self.choices or (self.low, self.high)


def _text(choice: Any) -> str:
    return yaml.safe_dump(choice, default_flow_style=True, width=math.inf).removesuffix("\n").removesuffix("\n...")


def load_space(path: Path, config: TrainConfig, fixed: Collection[str] = ()) -> tuple[Parameter, ...]:
    """The parameters in a file, in its order, without those named in ``fixed``.

    Raises:
        MissingFile, CorruptFile: no such file, no such description, a setting that does not exist or cannot have such a value.
        UnknownKey: ``fixed`` names a key that the file does not have.
    """
    tree = read_yaml(path, "search space")
    space = tuple(_parameter(str(key), about, path) for key, about in tree.items())
    for key in fixed:
        if key not in tree:
            raise UnknownKey(f"{key} in fixed", map(str, tree))
    space = tuple(parameter for parameter in space if parameter.key not in fixed)
    if not space:
        raise CorruptFile("search space", path, "no key is left to search over")
    _check(space, config, path)
    return space


def _check(space: tuple[Parameter, ...], config: TrainConfig, path: Path) -> None:
    """Raise :class:`CorruptFile` for a parameter with a value that its setting cannot have."""
    samples = {parameter.key: parameter.samples() for parameter in space}
    rounds = max(map(len, samples.values()))
    try:
        for number in range(rounds):
            applied(config, {key: values[number % len(values)] for key, values in samples.items()}, path).validate()
        return
    except HandoverError:
        pass  # one by one, then, to name the key; values that are only wrong together are the matter of their trial
    for key, values in samples.items():
        for value in values:
            try:
                applied(config, {key: value}, path).validate()
            except HandoverError as error:
                reason = error.reason if isinstance(error, CorruptFile) else error
                raise CorruptFile("search space", path, f"{key} = {value!r}: {reason}") from error


def _parameter(key: str, about: Any, path: Path) -> Parameter:
    """A parameter from its description in YAML."""
    known = [field.name for field in fields(Parameter) if field.name != "key"]
    if not isinstance(about, Mapping) or about.get("type") not in KINDS:
        raise CorruptFile("search space", path, f"{key}: expected a mapping with type: {', '.join(KINDS)}")
    if unknown := [str(name) for name in about if name not in known]:
        raise CorruptFile("search space", path, f"{key}: unknown {', '.join(unknown)}; known: {', '.join(known)}")
    kind, choices = about["type"], about.get("choices", [])
    if kind == "categorical":
        if set(about) != {"type", "choices"} or not isinstance(choices, list) or not choices:
            raise CorruptFile("search space", path, f"{key}: categorical takes choices: [...] and nothing else")
        return Parameter(key, kind, choices=tuple(choices))
    low: Any = about.get("low")
    high: Any = about.get("high")
    log = about.get("log", False)
    numbers = (int,) if kind == "int" else (int, float)
    fit = all(isinstance(end, numbers) and not isinstance(end, bool) and math.isfinite(end) for end in (low, high))
    if not fit or choices or not isinstance(log, bool) or not low <= high or (log and low <= 0):
        raise CorruptFile("search space", path, f"{key}: {kind} takes finite numbers low <= high, and log: true or false (true: low > 0)")
    return Parameter(key, kind, low, high, log)


def applied(config: TrainConfig, values: Mapping[str, Any], origin: Path) -> TrainConfig:
    """``config`` with some settings changed; types are checked. ``origin``: the file that errors name.

    Raises :class:`CorruptFile` for a key that does not exist or a value of another type.
    """
    tree = parse_yaml(to_yaml(config))
    for key, value in values.items():
        *sections, name = key.split(".")
        section = tree
        for part in sections:
            section = section.setdefault(part, {})
            if not isinstance(section, dict):
                raise CorruptFile("search space", origin, f"{key}: {part} has no settings below it")
        section[name] = value
    changed: TrainConfig = from_text(TrainConfig, yaml.safe_dump(tree), origin, {"algorithm": ALGORITHMS}, stored=False)
    return changed


def value_of(config: TrainConfig, key: str) -> Any:
    """A setting by its dotted key."""
    value: Any = config
    for name in key.split("."):
        value = getattr(value, name)
    return value
