"""From a suite to its tasks: every row's settings composed and checked before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

from marl_handover.compare import records
from marl_handover.compare.runs import RUN_FOLDER, Judgement, Task
from marl_handover.compare.suite import EVALUATION_SEED_OFFSET, RowSpec, Suite
from marl_handover.compare.suite_check import RUN
from marl_handover.compose import Groups, compose
from marl_handover.errors import HandoverError, InvalidSetting, UnknownChoice
from marl_handover.files import expanded
from marl_handover.learning.settings import TrainConfig
from marl_handover.policies.registry import NAMES
from marl_handover.policies.shielded import SHIELDED
from marl_handover.runtime.assessment import AssessmentConfig

Config = TypeVar("Config", TrainConfig, AssessmentConfig)


class Grammar(NamedTuple):
    """What the arguments of a command may say beyond its schema: short keys, and options that are code."""

    aliases: Mapping[str, str]
    groups: Groups


class BadRow(HandoverError):
    """A row whose settings do not hold."""

    def __init__(self, row: str, error: HandoverError) -> None:
        super().__init__(f"row {row}: {error}")
        self.row = row


def plan_tasks(suite: Suite, out: Path, train: Grammar, evaluate: Grammar) -> list[Task]:
    """Every task of the suite, row by row, with all settings composed and checked.

    Args:
        suite: what to do.
        out: folder of all results; workers may stand in another folder, so it is made absolute, and so are policies that are paths.
        train: what arguments of ``train`` may say.
        evaluate: what arguments of ``evaluate`` may say.

    Raises:
        HandoverError: bad settings; the message names the row.
    """
    tasks: list[Task] = []
    # Asked here and once: in a worker, later, the files may be newer than the code that it runs.
    commit = records.commit()
    for row in suite.rows:
        try:
            tasks += _row_tasks(suite, row, out.absolute(), train, evaluate, commit)
        except HandoverError as error:
            raise BadRow(row.name, error) from error
    return tasks


def _row_tasks(suite: Suite, row: RowSpec, out: Path, train: Grammar, evaluate: Grammar, commit: str) -> list[Task]:
    """A row's tasks. Settings are composed once and differ in seed and place."""
    arguments = () if row.train is None else tuple(suite.train_arguments(row))
    config = None if row.train is None else _composed(TrainConfig, arguments, train)
    asked = {}
    for spec in suite.evaluations_of(row, 0):
        wanted = tuple(suite.evaluate_arguments(row, spec))
        judged = _composed(AssessmentConfig, wanted, evaluate)
        _check_fits(spec.name, judged, config, suite.policy_of(row, spec))
        asked[spec.name] = Judgement(spec.name, judged, wanted, suite.policy_of(row, spec))
    tasks = []
    for seed in suite.seeds_of(row):
        folder = out / row.name / f"seed{seed}"
        run = str(folder / RUN_FOLDER)
        judgements = []
        for judgement in (asked[spec.name] for spec in suite.evaluations_of(row, seed)):
            policy = _placed(judgement.policy.replace(RUN, run))
            own = replace(deepcopy(judgement.config), policy=policy, seed=EVALUATION_SEED_OFFSET + seed)
            judgements.append(replace(judgement, config=own))
        placed = None if config is None else replace(deepcopy(config), seed=seed, out=run, progress=False)
        tasks.append(Task(row.name, seed, folder, placed, arguments, tuple(judgements), commit))
    return tasks


def _check_fits(name: str, judged: AssessmentConfig, trained: TrainConfig | None, policy: str) -> None:
    """Refuse what an evaluation of a trained row would find out after the training. Raises :class:`InvalidSetting`."""
    if trained is None or RUN not in policy:
        return
    architecture = judged.task.architecture
    if architecture not in (None, trained.task.architecture):
        raise InvalidSetting(f"{name}: task.architecture", architecture, f"{trained.task.architecture}, which the row is trained for")
    if trained.variant == "centralised" and judged.backend != "kinematic":
        raise InvalidSetting(f"{name}: backend", judged.backend, "kinematic for variant=centralised, whose motions are its own")


def _placed(policy: str) -> str:
    """A policy's name, its path absolute if it is one."""
    if policy.startswith(SHIELDED):
        return SHIELDED + _placed(policy.removeprefix(SHIELDED))
    if policy in NAMES:
        return policy
    path = expanded(policy)
    if path.parent == Path() and path.suffix != ".npz" and not path.exists():
        raise UnknownChoice("policy", policy, (*NAMES, f"{SHIELDED}NAME", "a run directory", "a policy file (.npz)"))
    return str(path.absolute())


def _composed(schema: type[Config], arguments: Sequence[str], grammar: Grammar) -> Config:
    config: Config = compose(schema, arguments, groups=grammar.groups, aliases=grammar.aliases)
    config.validate()
    return config
