"""Supervisor policies by name, as plain callables on numpy. Nothing here needs torch unless a run directory's checkpoint is read."""

from marl_handover.policies.baselines import ExactPolicy, GreedyPolicy, RandomPolicy
from marl_handover.policies.files import read_policy, stored_settings
from marl_handover.policies.network import NetworkPolicy
from marl_handover.policies.policy import SupervisorPolicy
from marl_handover.policies.registry import NAMES, adapted, load
from marl_handover.policies.shielded import ShieldedPolicy

__all__ = [
    "NAMES",
    "ExactPolicy",
    "GreedyPolicy",
    "NetworkPolicy",
    "RandomPolicy",
    "ShieldedPolicy",
    "SupervisorPolicy",
    "adapted",
    "load",
    "read_policy",
    "stored_settings",
]
