"""Learned supervision of cooperating robot arms: hand-overs that bring an object to a goal pose.

Importing the package registers the Gymnasium environments ``marl_handover/SupervisorA-v0`` and ``marl_handover/SupervisorB-v0``.
"""

import gymnasium

__version__ = "0.1.0"

for _architecture in ("A", "B"):
    gymnasium.register(
        id=f"marl_handover/Supervisor{_architecture}-v0",
        entry_point="marl_handover.envs.goal_env:SupervisorGoalEnv",
        kwargs={"architecture": _architecture},
    )
