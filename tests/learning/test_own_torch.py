"""A training leaves torch's threads and random state as its caller had them, and still draws the same numbers."""

from __future__ import annotations

import torch

from marl_handover.learning.algorithm import OwnTorch
from marl_handover.learning.trainer import Trainer


def test_a_training_leaves_no_trace(tmp_path, small):
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    trainer = Trainer(small("td3", "steps=128", "threads=3", "compile=off", "evaluation_interval=128"), tmp_path)
    assert (torch.get_num_threads(), torch.equal(torch.get_rng_state(), state)) == (threads, True)
    trainer.run()
    trainer.save()
    trainer.restore()
    assert (torch.get_num_threads(), torch.equal(torch.get_rng_state(), state)) == (threads, True)


def test_its_numbers_go_on_where_they_were_whatever_the_caller_draws():
    torch.manual_seed(7)
    expected = torch.rand(4)
    own, drawn = OwnTorch(1, 7, torch.device("cpu")), []
    for _ in range(4):
        with own, own:
            drawn.append(torch.rand(1))
        torch.rand(3)
    assert torch.equal(torch.cat(drawn), expected)
