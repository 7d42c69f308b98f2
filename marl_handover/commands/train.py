"""``marl-handover train``: train a supervisor into a run directory."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from marl_handover.config import CELL_ALIASES
from marl_handover.errors import CheckpointMismatch, InvalidSetting, MissingFile
from marl_handover.files import read_bounded
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.locks import claimed, new_folder
from marl_handover.parsing import YAML_BYTES
from marl_handover.progress import working

if TYPE_CHECKING:
    from marl_handover.learning.trainer import Trainer

SCHEMA = TrainConfig
ALIASES = CELL_ALIASES | {"architecture": "task.architecture"}
GROUPS = {"algorithm": ALGORITHMS}
FREE_ON_RESUME = ("resume", "out", "progress")


def run(config: TrainConfig) -> int:
    """Start a run, or continue one from its last checkpoint with the settings it was started with."""
    trained(config, lambda text: print(text, file=sys.stderr))
    return 0


def trained(config: TrainConfig, say: Callable[[str], None]) -> Path:
    """Start a run, or continue one, say what came of it, and return its directory.

    Raises:
        FolderBusy: another process trains in that folder.
    """
    if config.resume:
        folder = Path(config.resume)
        if not folder.is_dir():
            raise MissingFile("run directory", folder)
        with claimed(folder):
            trainer = resumed(folder, config)
            summary = trainer.run()
    else:
        trainer = _begun(config)
        with claimed(trainer.folder):
            _require_no_run(trainer.folder)  # somebody else may have made one meanwhile
            summary = trainer.run()
    validation = summary["validation"]
    say(
        f"{trainer.folder}: {summary['step']} environment steps, {summary['gradient_step']} gradient steps, "
        f"{summary['wall_s']:.0f} s; success {100 * validation['success_rate']:.2f} % on its validation problems"
    )
    return trainer.folder


def _begun(config: TrainConfig) -> Trainer:
    """A trainer of a new run, in ``out`` or in a folder of its own; bad settings make none."""
    with working("loading the libraries", logged=False):
        from marl_handover.learning.trainer import Trainer

    if config.out:
        _require_no_run(Path(config.out))
        return Trainer(config, Path(config.out))
    folder = new_folder(Path(datetime.now().strftime("runs/%Y%m%d-%H%M%S")))
    config.out = str(folder)
    try:
        return Trainer(config, folder)
    except BaseException:
        folder.rmdir()
        raise


def _require_no_run(folder: Path) -> None:
    from marl_handover.learning.checkpoint import FILE

    if folder.exists() and not folder.is_dir():
        raise InvalidSetting("out", str(folder), "a folder; this is a file")
    if (folder / FILE).exists():
        raise InvalidSetting("out", str(folder), f"a folder without a run; continue that one with resume={folder}")


def resumed(folder: Path, asked: TrainConfig | None = None) -> Trainer:
    """A trainer that stands where the run in ``folder`` was last saved, or at its start if it never was.

    Raises:
        CheckpointMismatch: ``asked`` changes a setting; a run keeps the ones it was started with.
    """
    from marl_handover.compose import flat
    from marl_handover.learning.checkpoint import FILE, load_checkpoint, train_config
    from marl_handover.learning.trainer import Trainer

    unsaved = not (folder / FILE).exists() and (folder / "config.yaml").exists()
    source = folder / ("config.yaml" if unsaved else FILE)
    text = read_bounded(source, YAML_BYTES, "settings").decode(errors="replace") if unsaved else load_checkpoint(folder)["config"]
    config = train_config(text, source)
    asked = asked or TrainConfig(progress=False)
    own, wanted, default = (flat(asdict(settings)) for settings in (config, asked, TrainConfig()))
    for key, value in wanted.items():
        if key not in FREE_ON_RESUME and value != default.get(key) and value != own.get(key):
            raise CheckpointMismatch(source, key, own.get(key), value)
    config.progress = asked.progress
    trainer = Trainer(config, folder)
    if not unsaved:
        trainer.restore()
    return trainer
