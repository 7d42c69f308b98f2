"""How an arm carries out a command: splines, collision-free paths, timing, and the executor agent that plays an arm."""

from marl_handover.motion.executor import ExecutorAgent

__all__ = ["ExecutorAgent"]
