"""Where training runs: without a compiler, on a GPU, on a device that is not there."""

from __future__ import annotations

import pytest
import torch

from marl_handover.errors import InvalidSetting
from marl_handover.learning import algorithm
from marl_handover.learning.hybrid_sac import unpacked
from marl_handover.learning.trainer import Trainer, usable_device


def test_without_a_compiler_auto_stays_eager(monkeypatch):
    monkeypatch.setenv("PATH", "")

    def function(x):
        return x + 1

    assert not algorithm.can_compile()
    assert algorithm.compiled(function, "auto") is function
    assert algorithm.compiled(function, "off") is function


def test_a_failing_compiler_falls_back_and_says_so(monkeypatch, caplog):
    def broken(function, **_):
        def call(*arguments):
            raise RuntimeError("no such compiler")

        return call

    monkeypatch.setattr(algorithm, "can_compile", lambda: True)
    monkeypatch.setattr(torch, "compile", broken)
    double = algorithm.compiled(lambda x: 2 * x, "auto")
    assert (double(3), double(4)) == (6, 8)
    assert caplog.text.count("uncompiled") == 1


def test_on_without_a_compiler_is_refused(monkeypatch):
    monkeypatch.setattr(algorithm, "can_compile", lambda: False)
    with pytest.raises(InvalidSetting, match="compile"):
        algorithm.compiled(abs, "on")


def test_a_missing_device_is_named():
    with pytest.raises(InvalidSetting, match="cpu"):
        usable_device("quantum")
    if not torch.cuda.is_available():
        with pytest.raises(InvalidSetting, match="cuda"):
            usable_device("cuda")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_training_on_a_gpu_resumes(small, tmp_path):
    Trainer(small("sac", "device=cuda", "steps=512"), tmp_path).run()
    again = Trainer(small("sac", "device=cuda", "steps=1024"), tmp_path)
    again.restore()
    assert again.run()["step"] == 1024


@pytest.mark.slow
@pytest.mark.skipif(not algorithm.can_compile(), reason="no C++ compiler")
def test_compiled_and_eager_losses_agree(small, tmp_path):
    trainer = Trainer(small("sac", "steps=512"), tmp_path)
    trainer.run()
    loss = trainer.algorithm.loss
    batch = trainer.replay.sample(32)
    noise = torch.randn(len(batch), 2, 1, 2)
    inputs = (*unpacked(batch), noise)
    torch.testing.assert_close(algorithm.compiled(loss.critic_loss, "on")(*inputs), loss.critic_loss(*inputs), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.skipif(not algorithm.can_compile(), reason="no C++ compiler")
def test_a_training_is_compiled_however_many_came_before_it_in_the_process(small, tmp_path, monkeypatch):
    monkeypatch.setattr(torch._dynamo.config, "recompile_limit", 2)
    monkeypatch.setattr(torch._dynamo.config, "fail_on_recompile_limit_hit", True)
    for gamma in (0.9, 0.91, 0.92, 0.93):  # a constant in what is compiled
        settings = small("sac", "compile=on", "steps=512", f"algorithm.gamma={gamma}")
        assert Trainer(settings, tmp_path / str(gamma)).run()["gradient_step"] > 0
