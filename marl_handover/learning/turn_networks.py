"""Networks of arms that take turns. Each sees the problem in its own frame and knows nothing of left and right."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_handover.learning.networks import LOG_STD_RANGE, AfterstateCritic, Branches, Harmonics, Mirror, TwinMLP, mlp

FINISH, PASS, PLACE = 0, 1, 2
"""An arm's branches; its place modes come from ``PLACE`` on."""


class TurnActor(nn.Module):
    """The policy of an arm, for its turn.

    Args:
        hidden: widths.
        modes: place modes.
        canonical: fold the symmetry M_x.
        harmonics: see :class:`~marl_handover.learning.networks.Harmonics`.
    """

    def __init__(self, hidden: Sequence[int], modes: int, canonical: bool, harmonics: int) -> None:
        super().__init__()
        self.modes = modes
        self.mirror, self.harmonics = Mirror(canonical), Harmonics(harmonics)
        self.net = mlp(self.harmonics.width, hidden, PLACE + 5 * modes)
        last = self.net[-1]
        if modes > 1 and isinstance(last, nn.Linear):  # start the modes apart, so that they do not learn the same thing
            with torch.no_grad():
                last.bias[PLACE + modes : PLACE + 3 * modes : 2] = torch.linspace(-0.8, 0.8, modes)

    def forward(self, block: Tensor) -> Branches:
        """Branches of own blocks (n, fields): logits (n, 1, 2 + modes), places (n, 1, modes, 2) in the arm's frame."""
        blocks, sign = self.mirror(block.unsqueeze(-2))
        out = self.net(self.harmonics(blocks))
        modes, split = self.modes, PLACE + self.modes
        mean = out[..., split : split + 2 * modes].unflatten(-1, (modes, 2))
        log_std = out[..., split + 2 * modes :].unflatten(-1, (modes, 2)).clamp(*LOG_STD_RANGE)
        alpha_sign = sign[..., None, None].expand(*mean.shape[:-1], 1)
        return Branches(out[..., :split], mean * torch.cat([alpha_sign, torch.ones_like(alpha_sign)], -1), log_std)


class TurnCritic(AfterstateCritic):
    """Twin values of an arm's branches. As kinematics says where an arm puts the object, placing is judged by what follows, and a pass as a
    placement that leaves the object where it is and is marked as such.

    Args:
        place_hidden: widths for placing and passing.
        final_hidden: widths for finishing.
        canonical: fold the symmetry M_x.
        harmonics: see :class:`~marl_handover.learning.networks.Harmonics`.
        seen: 1: it knows what its arm knows; 2: it sees the blocks of both arms, the acting one's first.
    """

    def __init__(self, place_hidden: Sequence[int], final_hidden: Sequence[int], canonical: bool, harmonics: int, seen: int) -> None:
        super().__init__(place_hidden, final_hidden, canonical, harmonics)
        self.seen = seen
        self.place = TwinMLP(seen * self.harmonics.width + 1, place_hidden)

    def value_place(self, following: Tensor, passed: Tensor | None = None) -> Tensor:
        """Values (2, ...) of afterstates (..., 2, fields): the acting arm's block, then the other's; ``passed`` (...) marks passes."""
        blocks, _ = self.mirror(following[..., : self.seen, :])
        features = self.harmonics(blocks).flatten(-2)
        mark = torch.zeros_like(features[..., 0]) if passed is None else passed.to(features.dtype)
        return self.place(torch.cat([features, mark[..., None]], -1).flatten(0, -2)).unflatten(-1, following.shape[:-2])


def turn_action(logits: Tensor, place: Tensor, noise: Tensor | None = None) -> Tensor:
    """Actions (n, 3) of the branch with the largest logit, after adding ``noise`` to the logits: (n, 1, 2 + modes), (n, 1, modes, 2)."""
    flat = logits.flatten(1) if noise is None else logits.flatten(1) + noise
    branch = flat.argmax(-1)
    rows = torch.arange(len(logits), device=logits.device)
    where = place[rows, 0, (branch - PLACE).clamp_min(0)]
    choice = torch.where(branch == FINISH, 1.0, torch.where(branch == PASS, -1.0, 0.0))
    return torch.cat([choice[:, None], where], -1)
