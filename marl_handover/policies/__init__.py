"""Supervisor policies by name, as plain callables on numpy. Nothing here needs torch unless a run directory's checkpoint is read."""

from marl_handover.policies.actor import NetworkPolicy
from marl_handover.policies.files import read_policy, stored_settings
from marl_handover.policies.policy import ResigningPolicy, ShieldedPolicy, SupervisorPolicy
from marl_handover.policies.registry import POLICIES, ExactPolicy, GreedyPolicy, RandomPolicy, adapted, load, names

__all__ = [
    "POLICIES",
    "ExactPolicy",
    "GreedyPolicy",
    "NetworkPolicy",
    "RandomPolicy",
    "ResigningPolicy",
    "ShieldedPolicy",
    "SupervisorPolicy",
    "adapted",
    "load",
    "names",
    "read_policy",
    "stored_settings",
]
