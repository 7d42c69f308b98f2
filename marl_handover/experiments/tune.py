"""A search for better settings of training: an Optuna study whose trials are short training runs.

A trial is judged by the trainer's own score on its validation problems, never on those of evaluations. Studies continue: a second call does
the trials that are left, and those whose process was killed are started again from their first step, with the same settings and seed.

What a search may change is read from YAML (``configs/search``). Each key is a setting of :class:`TrainConfig`, and says how it is drawn::

    algorithm.learning_rate: {type: float, low: 1.0e-4, high: 3.0e-3, log: true}
    algorithm.harmonics: {type: int, low: 0, high: 3}
    algorithm.hidden: {type: categorical, choices: [[128, 128], [256, 256]]}
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Collection, Generator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import optuna
import yaml
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState

from marl_handover.compose import from_text, to_yaml
from marl_handover.config import MAX_SEED
from marl_handover.errors import CorruptFile, HandoverError, UnknownKey, WorkFailed
from marl_handover.experiments.executor import Failure, fan_out, summary
from marl_handover.experiments.provenance import settings_of, usual_settings
from marl_handover.experiments.tune_storage import abandoned, asked, claimed, counted, ended, give_back, open_study, place_of, running
from marl_handover.files import write_whole
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer, validation_score
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


STARTUP_TRIALS = 5
"""Finished trials before the median is one."""


@dataclass(frozen=True)
class Search:
    """What a study is about; every worker gets one.

    Attributes:
        study: its name.
        storage: URL or path, see :func:`marl_handover.experiments.tune_storage.open_storage`.
        train: the settings that are searched from.
        space: what is changed.
        origin: the file that the space was read from, for errors.
        folder: trials train in its subfolders.
        trials: how many the study should have in the end.
        seed: of the search, and of its trials' seeds.
        pruner: ``median``, ``hyperband`` or ``none``.
    """

    study: str
    storage: str
    train: TrainConfig
    space: tuple[Parameter, ...]
    origin: Path
    folder: Path
    trials: int
    seed: int
    pruner: str


@dataclass(frozen=True)
class Note:
    """How a trial went. ``value`` is None if it failed."""

    number: int
    state: str
    value: float | None
    error: str = ""


class ChangedStudy(HandoverError):
    """A study that was begun with other settings."""

    def __init__(self, study: str, key: str, stored: Any, asked: Any) -> None:
        super().__init__(f"study {study} was begun with {key} = {stored!r}, and now it is {asked!r}; give this one another name: study=…")
        self.study, self.key, self.stored, self.asked = study, key, stored, asked


def prepare(search: Search) -> tuple[Study, int]:
    """The study, begun or continued, and how many trials are left. Trials whose process is gone are queued again.

    Raises:
        ChangedStudy: it was begun with other settings, another space or another seed.
        StorageUnavailable: its storage cannot be opened.
    """
    study = open_study(search.storage, search.study)
    about = {**settings_of(search.train), **{f"search.{parameter.key}": parameter.about() for parameter in search.space}}
    stored = study.user_attrs.get("about")
    if stored is None:
        study.set_user_attr("about", about)
        _propose_usual(study, search)
    else:
        _compare(search, stored, about)
    for trial in running(study):
        if abandoned(trial):
            give_back(study, trial)
    return study, max(0, search.trials - counted(study))


def _propose_usual(study: Study, search: Search) -> None:
    """The first trial has the settings as they are, so that what is found is at least as good, if the space has them."""
    usual = {parameter.key: value_of(search.train, parameter.key) for parameter in search.space}
    if all(parameter.contains(usual[parameter.key]) for parameter in search.space):
        study.enqueue_trial({parameter.key: parameter.stored(usual[parameter.key]) for parameter in search.space})


def _compare(search: Search, stored: dict[str, Any], about: dict[str, Any]) -> None:
    younger = usual_settings(search.train)  # a setting that an old study does not know had its default
    for key in sorted(stored.keys() | about.keys()):
        before, now = stored.get(key, younger.get(key)), about.get(key)
        if before != now and (key in about or key.startswith("search.")):
            raise ChangedStudy(search.study, key, before, now)


def run_trials(search: Search, study: Study, left: int, **options: Any) -> Generator[Note, None, None]:
    """Do ``left`` trials and tell how each went. ``options`` go to :func:`marl_handover.experiments.executor.fan_out`."""
    begun = counted(study)
    # Another call may count the same trials as left: what tells its slots from this one's is the last part.
    call = uuid4().hex
    slots = [f"{search.seed}/{begun + index}/{call}" for index in range(left)]
    for slot, result in fan_out(partial(run_trial, search), slots, label=lambda slot: f"trial {slot.split('/')[1]}", **options):
        if not isinstance(result, Failure):
            if result is not None:
                yield result
            continue
        _take_back(study, slot, again=False)
        yield Note(-1, "FAIL", None, result.error)


def _take_back(study: Study, slot: str, again: bool = True) -> None:
    """Give back what a dead worker left in a slot; the launcher says that it died, but one that is seen to live is left alone."""
    for trial in running(study):
        if trial.user_attrs.get("slot") == slot and abandoned(trial, told=True):
            give_back(study, trial, again)


def run_trial(search: Search, slot: str) -> Note | None:
    """One trial, in a worker. None if others have done enough meanwhile.

    Args:
        search: what to do.
        slot: a name that no other item of any call has. One that is run again takes over what a dead worker left.
    """
    study = open_study(search.storage, search.study, pruner=_pruner(search))
    _take_back(study, slot)
    if counted(study) >= search.trials:
        return None
    trial = asked(study, search.storage, search.folder)
    study.sampler = TPESampler(seed=_seed(search.seed, place_of(study, trial.number), "proposals"))
    try:
        with claimed(trial, slot):
            value = _train(search, trial)
    except optuna.TrialPruned:
        told = ended(study, trial, state=TrialState.PRUNED)
    except Exception as error:  # settings that cannot be trained with are a result of a search like others
        ended(study, trial, state=TrialState.FAIL, error=summary(error))
        return Note(trial.number, "FAIL", None, summary(error))
    except BaseException:
        give_back(study, study.trials[trial.number])
        raise
    else:
        told = ended(study, trial, value)
    if told is None:
        return Note(trial.number, "FAIL", None, "somebody took this trial for dead and ended it; its result counts for nothing")
    return Note(trial.number, told.state.name, told.value)


def _train(search: Search, trial: Trial) -> float:
    """Train with a trial's settings and return its score."""
    values = {parameter.key: parameter.suggest(trial) for parameter in search.space}
    seed = _seed(search.seed, trial.user_attrs.get("origin", trial.number), "training")
    folder = search.folder / f"{trial.number:04d}"
    config = replace(applied(search.train, values, search.origin), seed=seed, out=str(folder), resume="", progress=False)
    trial.set_user_attr("seed", seed)
    rows: list[dict[str, float]] = []

    def judge(row: dict[str, float]) -> None:
        rows.append(row)
        trial.report(validation_score(row), len(rows))
        if row["step"] < config.steps and trial.should_prune():
            raise optuna.TrialPruned

    try:
        best_step = Trainer(config, folder, judge).run()["best_step"]
        best = next(row for row in rows if row["step"] == best_step)
    finally:
        _describe(trial, max(rows, key=validation_score, default={}))
    _describe(trial, best)
    return validation_score(best)


def _describe(trial: Trial, row: dict[str, float]) -> None:
    for name in ("step", "success_rate", "mean_steps", "steps_ratio", "wall_s"):
        if math.isfinite(row.get(name, math.nan)):
            trial.set_user_attr(name, row[name])


def _pruner(search: Search) -> BasePruner:
    """Resources are counted in validations."""
    validations = math.ceil(search.train.steps / search.train.evaluation_interval)
    pruners: dict[str, Callable[[], BasePruner]] = {
        "median": lambda: MedianPruner(n_startup_trials=STARTUP_TRIALS, n_warmup_steps=validations // 4 + 1),
        "hyperband": lambda: HyperbandPruner(min_resource=1, max_resource=max(2, validations)),
        "none": NopPruner,
    }
    return pruners[search.pruner]()


def _seed(study_seed: int, index: int, purpose: str) -> int:
    """A seed that depends on these alone."""
    sequence = np.random.SeedSequence([study_seed, index, len(purpose)])
    return int(sequence.generate_state(1)[0]) % MAX_SEED


def require_result(study: Study, notes: list[Note]) -> None:
    """Raise :class:`WorkFailed` if no trial of the study was completed."""
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        reasons = [note.error for note in notes if note.error]
        raise WorkFailed(f"no trial of study {study.study_name} was completed" + (f": {reasons[0]}" if reasons else ""))


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
