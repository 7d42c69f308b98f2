"""Gradient steps are made without subnormal numbers; whatever else runs in the process keeps them."""

from __future__ import annotations

import pytest
import torch

from marl_handover.learning.algorithm import subnormals_flushed
from marl_handover.learning.trainer import Trainer

TINY = 1e-39  # below 1.2e-38, the least normal number of 32 bits


def kept() -> bool:
    return bool((torch.full((64,), TINY) * 0.5 > 0.0).all())


def watched(method, seen):
    """The method, telling at each call whether tiny numbers are kept."""

    def call(*arguments):
        seen.add(kept())
        return method(*arguments)

    return call


def test_tiny_numbers_are_0_within_and_themselves_after():
    with subnormals_flushed():
        assert not kept()
    assert kept()


def test_an_error_leaves_them_as_they_were():
    with pytest.raises(KeyError), subnormals_flushed():
        raise KeyError
    assert kept()


@pytest.mark.parametrize("name", ["sac", "ppo"])
def test_updates_run_without_them_and_all_else_with(small, tmp_path, name):
    trainer = Trainer(small(name), tmp_path)
    seen = {"update": set(), "explore": set(), "evaluate": set()}
    for owner, method in ((trainer.algorithm, "update"), (trainer.algorithm, "explore"), (trainer, "evaluate")):
        setattr(owner, method, watched(getattr(owner, method), seen[method]))
    trainer.run()
    assert seen == {"update": {False}, "explore": {True}, "evaluate": {True}}
