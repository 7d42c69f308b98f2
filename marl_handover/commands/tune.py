"""``marl-handover tune``: search for better settings of training."""

from __future__ import annotations

import sys
from copy import deepcopy
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_handover.commands import train
from marl_handover.config import bounded, check_bounds, chosen, name_field, path_field
from marl_handover.errors import InvalidSetting, counted
from marl_handover.files import read_bounded, resource_path, write_whole
from marl_handover.learning.settings import TrainConfig
from marl_handover.progress import say

if TYPE_CHECKING:
    from optuna.study import Study

    from marl_handover.experiments.tune import Note, Search


STUDY_FILE = "study.txt"
"""In the folder of a study: its name. Trials are numbered, so that a folder holds those of one study only."""


@dataclass
class TuneConfig(TrainConfig):
    """Settings of ``tune``: those of the trials' training, which the search starts from, and its own."""

    search: str = path_field()  # ranges to search in: a name or a YAML file; the algorithm's own if empty
    fixed: list[str] = field(default_factory=list)  # keys of the search space that are left as they are
    trials: int = bounded(20, 1, 100_000)  # that the study has in the end; a call does those that are left
    study: str = name_field()  # its name in the storage; the algorithm's if empty
    storage: str = ""  # postgresql://user:password@host/name, sqlite:///file or a journal file's path; <out>/study.journal if empty
    pruner: str = chosen("median", ("median", "hyperband", "none"))  # what ends hopeless trials: median, hyperband or none
    launcher: str = chosen("loky", ("loky", "ray"))  # loky: the cores of this machine; ray: a cluster
    address: str = ""  # of the Ray cluster: auto, host:port or local
    jobs: int = bounded(0, 0, 1024)  # trials at the same time; 0: one a core
    steps: int = bounded(16_000, 1, 10**9)  # of each trial
    evaluation_interval: int = bounded(2_000, 1, 10**9)  # environment steps; after each, a trial may be ended
    evaluation_episodes: int = bounded(1_000, 1, 10**6)
    checkpoint_interval: int = bounded(16_000, 1, 10**9)  # environment steps


SCHEMA = TuneConfig
ALIASES = train.ALIASES
GROUPS = train.GROUPS


def run(config: TuneConfig) -> int:
    """Do the trials that are left; write ``trials.csv`` and ``best.yaml``; print the best settings."""
    from marl_handover.experiments.tune import prepare, run_trials

    search, out = _search(config)
    study, left = prepare(search)
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / STUDY_FILE, search.study + "\n")
    if config.progress:
        print(f"study {search.study}: {search.trials - left} of {search.trials} trials are done", file=sys.stderr)
    notes: list[Note] = []
    options: dict[str, Any] = {"launcher": config.launcher, "address": config.address, "jobs": config.jobs, "progress": config.progress}
    for note in run_trials(search, study, left, **options):
        notes.append(note)
        if config.progress or note.error:
            say(_line(note))
    _report(search, study, out, notes)
    return 0


def _search(config: TuneConfig) -> tuple[Search, Path]:
    """What to do, checked, and the folder for it."""
    from marl_handover.cell import build_cell
    from marl_handover.compose import option_file
    from marl_handover.experiments.tune import Search, load_space
    from marl_handover.experiments.tune_storage import located
    from marl_handover.learning.trainer import usable_device

    check_bounds(config)
    if config.address and config.launcher == "loky":
        raise InvalidSetting("address", config.address, "left out with launcher=loky; it is that of a Ray cluster")
    if config.resume:
        raise InvalidSetting("resume", config.resume, "left empty; a study continues by itself")
    settings = TrainConfig(**{item.name: getattr(config, item.name) for item in fields(TrainConfig)})
    deepcopy(settings).validate()  # which fills in what follows from the rest, and a trial may change that
    usable_device(settings.device)
    build_cell(settings.cell)
    name = config.study or config.algorithm.name
    out = Path(config.out or f"runs/tune/{name}")
    if out.exists() and not out.is_dir():
        raise InvalidSetting("out", str(out), "a folder; this is a file")
    owner = read_bounded(out / STUDY_FILE, 1000, "study").decode(errors="replace").strip() if (out / STUDY_FILE).exists() else name
    if owner != name:
        raise InvalidSetting("out", str(out), f"a folder for study {name}; this one has the trials of study {owner}")
    origin = option_file("search", config.search or config.algorithm.name, resource_path("configs") / "search", None)
    space = load_space(origin, settings, config.fixed)
    storage = located(config.storage, out)
    search = Search(name, storage, settings, space, origin, (out / "trials").absolute(), config.trials, config.seed, config.pruner)
    return search, out


def _line(note: Note) -> str:
    score = "" if note.value is None else f" with score {note.value:.4f}"
    return f"trial {note.number}: {note.state.lower()}{score}{note.error and ': ' + note.error}"


def _report(search: Search, study: Study, out: Path, notes: list[Note]) -> None:
    """Write what is known of the trials, and the best of them."""
    from marl_handover.experiments.tune import arguments, best_settings, require_result, write_preset, write_trials

    write_trials(study, search, out / "trials.csv")
    require_result(study, notes)
    settings = best_settings(study, search)
    write_preset(settings, study, out / "best.yaml")
    best = study.best_trial
    print(f"best of {counted(len(study.trials), 'trial')}: {best.number}, score {best.value:.4f}, {_measured(best.user_attrs)}")
    print(f"marl-handover train {' '.join(arguments(settings))}")
    print(f"the same: marl-handover train preset={out / 'best.yaml'}; all trials: {out / 'trials.csv'}")


def _measured(about: dict[str, Any]) -> str:
    ratio = about.get("steps_ratio")
    times = f", {ratio:.3f} times the fewest transfers" if ratio is not None else ""
    return f"success {100 * about['success_rate']:.2f} %{times} on its validation problems"
