"""The files of a servo calibration: one for each arm and the play. Only those of one calibration mean anything together."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path

from numpy.typing import ArrayLike

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import keep, make_folder, read_bounded, write_together
from marl_handover.hardware.calibration import ArmCalibration, CalibrationProblem
from marl_handover.hardware.settings import ARMS
from marl_handover.parsing import JSON_BYTES, read_json
from marl_handover.runtime.play import AGAIN, play_text
from marl_handover.runtime.play import FILE as PLAY_FILE

SET_FILE = "servos.json"
"""Names the others' content, so that files of two calibrations are told from those of one."""

VERSION = 1


def arm_file(arm: str) -> str:
    """The name of an arm's file."""
    return f"{arm}.json"


NAMES = (*(arm_file(arm) for arm in ARMS), PLAY_FILE)


def save_servos(folder: Path, arms: Mapping[str, ArmCalibration], half_us: Mapping[str, ArrayLike], sd_us: Mapping[str, ArrayLike]) -> None:
    """Write what was found for all arms into ``folder``; what was there is kept beside it. The last file makes the others valid.

    Args:
        folder: where; made if it is missing.
        arms: calibration of each arm.
        half_us: half the dead bands (5,) in us of each arm's servos.
        sd_us: their standard deviations (5,).

    Raises:
        CannotWrite: there is no room for them, and then those that were there stay.
    """
    make_folder(folder)
    texts = {arm_file(arm): arms[arm].text() for arm in ARMS} | {PLAY_FILE: play_text(half_us, sd_us)}
    digests = {name: hashlib.sha256(texts[name].encode()).hexdigest() for name in NAMES}
    texts[SET_FILE] = json.dumps({"version": VERSION, "sha256": digests}, indent=1) + "\n"
    for name in texts:
        keep(folder / name)
    write_together({folder / name: text for name, text in texts.items()})


def require_one_set(folder: Path, names: Collection[str] = NAMES) -> None:
    """See that the files ``names`` in ``folder`` come from one calibration.

    Raises:
        MissingFile: one is not there.
        CorruptFile: the one that names the others cannot be read.
        CalibrationProblem: they do not belong together, or were changed since.
    """
    for name in (*names, SET_FILE):
        if not (folder / name).is_file():
            raise MissingFile("servo calibration", folder / name, AGAIN)
    path = folder / SET_FILE
    try:
        content = read_json(path, "servo calibration")
        if content["version"] != VERSION:
            raise CorruptFile("servo calibration", path, f"it has version {content['version']!r}, this program reads {VERSION}; {AGAIN}")
        wanted = {name: str(content["sha256"][name]) for name in names}
        others = [name for name in names if _digest(folder / name) != wanted[name]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CorruptFile("servo calibration", path, f"{type(error).__name__}: {error}") from error
    if others:
        raise CalibrationProblem(str(folder), f"{' and '.join(others)} changed since the others were written; {AGAIN}")


def _digest(path: Path) -> str:
    return hashlib.sha256(read_bounded(path, JSON_BYTES, "servo calibration")).hexdigest()
