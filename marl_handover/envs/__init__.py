"""Environments: thin skins over the rule book."""

from marl_handover.envs import handover_aec
from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.envs.supervisor_env import SupervisorEnv

__all__ = ["SupervisorEnv", "SupervisorGoalEnv", "handover_aec"]
