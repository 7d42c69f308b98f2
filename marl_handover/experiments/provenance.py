"""What is written down of a run: its settings, by which a changed one is told, and where and by what it was made."""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from marl_handover.compose import flat, present_names
from marl_handover.control.evaluation import AssessmentConfig
from marl_handover.errors import HandoverError
from marl_handover.files import package_path, read_bounded, write_whole
from marl_handover.learning.settings import TrainConfig
from marl_handover.parsing import LINES_BYTES, parse_json, read_json
from marl_handover.policies.registry import content_hash
from marl_handover.task.ladder import rung
from marl_handover.task.rules import Outcome

PLACES = ("out", "resume", "progress", "policy")
"""Settings that say where something is, not what it is."""

Settings = dict[str, Any]
Needed = Mapping[str, type | tuple[type, ...]]

_NUMBER = (int, float)
_MADE_BY: Needed = {"config_hash": str, "commit": str, "machine": dict}

# Dotted keys that a record is of no use without.
ASKED_KEYS: Needed = {"commit": str, "settings": dict}
TRAINED_KEYS: Needed = {**_MADE_BY, "step": int, "gradient_step": int, "wall_s": _NUMBER}
REPORT_KEYS: Needed = {
    **{key: _NUMBER for key in ("success_rate", "mean_steps", "wall_s")},
    **{f"outcomes.{kind.name.lower()}": int for kind in Outcome if kind is not Outcome.NONE},
    **{f"provenance.{key}": kind for key, kind in {**_MADE_BY, "policy": str, "settings": dict}.items()},
    "episodes": int,
    "backend": str,
}
DONE_KEYS: Needed = {"row": str, "seed": int, "evaluations": dict}


def settings_of(config: TrainConfig | AssessmentConfig) -> Settings:
    """All settings by dotted key, as JSON has them, without those that only say where things are."""
    return {key: value for key, value in flat(parse_json(json.dumps(asdict(config)))).items() if key not in PLACES}


def fingerprint(settings: Settings) -> str:
    """Short hash of settings."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def usual_settings(config: TrainConfig | AssessmentConfig) -> Settings:
    """What :func:`settings_of` gives if nobody says otherwise; with the same algorithm."""
    usual = type(config)()
    if isinstance(config, TrainConfig) and isinstance(usual, TrainConfig):
        usual.algorithm = type(config.algorithm)()
    return settings_of(usual)


def differences(stored: Settings, config: TrainConfig | AssessmentConfig) -> Iterator[tuple[str, Any, Any]]:
    """Key, stored value and present value of each setting in which ``config`` is not what was stored.

    A setting that is younger than the record had its default. One that is gone from the schema says nothing, but one of a section that is
    left out now was taken back.
    """
    usual, now, stored = usual_settings(config), settings_of(config), present_names(stored)
    for key, value in now.items():
        before = stored.get(key, usual.get(key))
        if before != value:
            yield key, before, value
    for key, before in stored.items():
        parts = key.split(".")
        sections = {".".join(parts[:count]) for count in range(1, len(parts))}
        if any(section in now and now[section] is None for section in sections):
            yield key, before, None


def contents_of(config: AssessmentConfig, own_run: bool) -> dict[str, str]:
    """Short hashes of the files that an evaluation reads, by the setting that names them; what cannot be read is left out.

    Args:
        config: of the evaluation.
        own_run: whether its policy is what the same task trained, which its own record is about.
    """
    found: dict[str, str] = {}
    with suppress(HandoverError):
        if not own_run and (digest := content_hash(config.policy)):
            found["policy"] = digest
        if config.ladder:
            found["ladder"] = rung(config.ladder).sha256[:12]
        if config.problems:
            found["problems"] = hashlib.sha256(read_bounded(Path(config.problems), LINES_BYTES, "problems")).hexdigest()[:12]
    return found


def read_record(path: Path, needed: Needed | None = None) -> dict[str, Any] | None:
    """A JSON file of a task's folder; None if it is not there, not whole, or lacks a key of ``needed`` or has one of another type.

    Records are written as a whole, so that a damaged one is as good as none: what it told is made again.
    """
    try:
        record = read_json(path, "record", finite=False)
    except HandoverError:
        return None
    return record if all(isinstance(_value(record, key), kind) for key, kind in (needed or {}).items()) else None


def _value(tree: Any, key: str) -> Any:
    """What stands at a dotted key; None if nothing does."""
    for name in key.split("."):
        tree = tree.get(name) if isinstance(tree, dict) else None
    return tree


def commits_of(record: Mapping[str, Any]) -> list[str]:
    """All commits that a training ran under; a record from before these were kept has its one."""
    return list(record.get("commits", [record["commit"]]))


def write_record(path: Path, content: Mapping[str, Any]) -> None:
    """Write such a file as a whole."""
    write_whole(path, json.dumps(content, indent=1) + "\n")


def commit() -> str:
    """Short name of the commit this package is a checkout of, with ``+`` if files differ from it; ``none`` if it is installed."""
    package = package_path("")
    if not (package.parent / ".git").exists():
        return "none"

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(package.parent), *arguments], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    try:
        name = git("rev-parse", "--short", "HEAD")
        return name + ("+" if git("status", "--porcelain") else "") if name else "none"
    except OSError:
        return "none"
