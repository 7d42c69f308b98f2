"""What a search leaves: a table of its trials, and the best settings as a preset and as arguments to paste."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from optuna.study import Study
from optuna.trial import FrozenTrial

from marl_handover.compare.records import settings_of, usual_settings
from marl_handover.compare.tune import Search
from marl_handover.compare.tune_space import applied
from marl_handover.files import write_whole

MEASURED = ("seed", "step", "success_rate", "mean_steps", "steps_ratio", "wall_s")
OF_THE_RUN = ("seed", "steps", "device", "threads", "compile", "evaluation_interval", "evaluation_episodes", "checkpoint_interval")
"""Settings that say how a trial was run; a preset leaves them alone."""

Settings = dict[str, Any]


def write_trials(study: Study, search: Search, path: Path) -> None:
    """Write one row for each trial, in their order."""
    keys = [parameter.key for parameter in search.space]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["number", "state", "score", *MEASURED, *keys, "folder", "error"])
    for trial in study.get_trials(deepcopy=False):
        measured = [trial.user_attrs.get(name, "") for name in MEASURED]
        values = [trial.params.get(key, "") for key in keys]
        value = "" if trial.value is None else trial.value
        folder = _folder(search, trial) if "seed" in trial.user_attrs else ""
        writer.writerow([trial.number, trial.state.name, value, *measured, *values, folder, trial.user_attrs.get("error", "")])
    write_whole(path, buffer.getvalue())


def _folder(search: Search, trial: FrozenTrial) -> str:
    return str(search.folder / f"{trial.number:04d}")


def best_settings(study: Study, search: Search) -> Settings:
    """By dotted key, what to change in the algorithm's defaults to train as the best trial did, apart from how long."""
    found = study.best_trial.params
    values = {parameter.key: parameter.read(found[parameter.key]) for parameter in search.space}
    config = applied(search.train, values, search.origin)
    usual = usual_settings(config)
    changed = {key: value for key, value in settings_of(config).items() if value != usual.get(key) and key not in OF_THE_RUN}
    return {"algorithm.name": config.algorithm.name, **{key: value for key, value in changed.items() if key != "algorithm.name"}}


def write_preset(settings: Mapping[str, Any], study: Study, path: Path) -> None:
    """Write settings as a preset file, with a line that says where they come from."""
    tree: dict[str, Any] = {}
    for key, value in settings.items():
        *sections, name = key.split(".")
        section = tree
        for part in sections:
            section = section.setdefault(part, {})
        section[name] = value
    best = study.best_trial
    head = f"# Trial {best.number} of study {study.study_name}: score {best.value:.4f} on its validation problems.\n"
    write_whole(path, head + yaml.safe_dump(tree, sort_keys=False))


def arguments(settings: Mapping[str, Any]) -> list[str]:
    """Settings as arguments of ``train``, ready for a shell."""
    texts = ["algorithm=" + settings["algorithm.name"]] if "algorithm.name" in settings else []
    texts += [f"{key}={_literal(value)}" for key, value in settings.items() if key != "algorithm.name"]
    return [f"'{text}'" if any(sign in text for sign in "[]{}") else text for text in texts]


def _literal(value: Any) -> str:
    """A value in the grammar of arguments."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_literal(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(_literal, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
