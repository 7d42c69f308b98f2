"""``marl-handover train``: train a supervisor into a run directory."""

from __future__ import annotations

import logging
import sys
from datetime import datetime
from pathlib import Path

from marl_handover.errors import InvalidSetting, MissingFile
from marl_handover.learning.checkpoint import FILE, load_checkpoint
from marl_handover.learning.export import train_config
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer

SCHEMA = TrainConfig
ALIASES = {"architecture": "task.architecture", "epsilon_deg": "task.epsilon_deg"}
GROUPS = {"algorithm": ALGORITHMS}


def run(config: TrainConfig) -> int:
    """Start a run, or continue one from its last checkpoint with the settings it was started with."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if config.resume:
        trainer = resumed(Path(config.resume), config.progress)
    else:
        folder = Path(config.out or datetime.now().strftime("runs/%Y%m%d-%H%M%S"))
        if folder.exists() and not folder.is_dir():
            raise InvalidSetting("out", str(folder), "a folder; this is a file")
        if (folder / FILE).exists():
            raise InvalidSetting("out", str(folder), f"a folder without a run; continue that one with resume={folder}")
        config.out = str(folder)
        trainer = Trainer(config, folder)
    summary = trainer.run()
    validation = summary["validation"]
    print(
        f"{trainer.folder}: {summary['step']} environment steps, {summary['gradient_step']} gradient steps, "
        f"{summary['wall_s']:.0f} s; success {100 * validation['success_rate']:.2f} % on its validation problems",
        file=sys.stderr,
    )
    return 0


def resumed(folder: Path, progress: bool = True) -> Trainer:
    """A trainer that stands where the run in ``folder`` was last saved, or at its start if it never was."""
    if folder.is_dir() and not (folder / FILE).exists() and (folder / "config.yaml").exists():
        config = train_config((folder / "config.yaml").read_text(encoding="utf-8"), folder / "config.yaml")
        config.progress = progress
        return Trainer(config, folder)
    if not folder.is_dir():
        raise MissingFile("run directory", folder)
    config = train_config(load_checkpoint(folder)["config"], folder / FILE)
    config.progress = progress
    trainer = Trainer(config, folder)
    trainer.restore()
    return trainer
