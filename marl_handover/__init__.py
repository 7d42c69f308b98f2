"""Learned supervision of cooperating robot arms: hand-overs that bring an object to a goal pose.

With the package imported, Gymnasium knows ``marl_handover/SupervisorA-v0``, ``marl_handover/SupervisorB-v0`` and an id for each rung of the
ladder, such as ``marl_handover/Ladder-3-Triangle-v0``. Gymnasium itself is not imported for that: ``marl-handover stop`` must not wait
for it.

``import marl_handover as mh`` has the commands as functions, environments and policies, and what plug-ins register with: all that
:data:`LAZY` lists. Each is imported when it is first asked for.
"""

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers; at run time LAZY says where each is
    from marl_handover.api import evaluate as evaluate
    from marl_handover.api import load_policy as load_policy
    from marl_handover.api import make as make
    from marl_handover.api import plan as plan
    from marl_handover.api import plot as plot
    from marl_handover.api import simulate as simulate
    from marl_handover.api import train as train
    from marl_handover.config import LAYOUTS as LAYOUTS
    from marl_handover.config import REWARDS as REWARDS
    from marl_handover.envs.goal_env import SupervisorGoalEnv as SupervisorGoalEnv
    from marl_handover.envs.goal_vector_env import SupervisorVectorEnv as SupervisorVectorEnv
    from marl_handover.envs.supervisor_env import SupervisorEnv as SupervisorEnv
    from marl_handover.learning.algorithm import register_algorithm as register_algorithm
    from marl_handover.policies import POLICIES as POLICIES
    from marl_handover.policies import SupervisorPolicy as SupervisorPolicy
    from marl_handover.task.observations import Layout as Layout

__version__ = "0.1.0"

LAZY = {
    **dict.fromkeys(("evaluate", "load_policy", "make", "plan", "plot", "simulate", "train"), "marl_handover.api"),
    **dict.fromkeys(("LAYOUTS", "REWARDS"), "marl_handover.config"),
    **dict.fromkeys(("POLICIES", "SupervisorPolicy"), "marl_handover.policies"),
    "Layout": "marl_handover.task.observations",
    "SupervisorEnv": "marl_handover.envs.supervisor_env",
    "SupervisorGoalEnv": "marl_handover.envs.goal_env",
    "SupervisorVectorEnv": "marl_handover.envs.goal_vector_env",
    "register_algorithm": "marl_handover.learning.algorithm",
}
"""Where each name of the package's own lives."""

__all__ = ["__version__", *LAZY]


def __getattr__(name: str) -> Any:
    """A name of :data:`LAZY`, imported now."""
    if name not in LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(LAZY[name]), name)
    return found


def __dir__() -> list[str]:
    """What there is, whether it was imported yet or not."""
    return sorted({*globals(), *LAZY})


def _register(gymnasium: ModuleType) -> None:
    for architecture in ("A", "B"):
        gymnasium.register(
            id=f"marl_handover/Supervisor{architecture}-v0",
            entry_point="marl_handover.envs.goal_env:SupervisorGoalEnv",
            vector_entry_point="marl_handover.envs.goal_vector_env:SupervisorVectorEnv",
            kwargs={"architecture": architecture},
        )
    from marl_handover.files import resource_path  # here, as Gymnasium
    from marl_handover.parsing import read_yaml

    for rung in read_yaml(resource_path("configs/ladder/rungs.yaml"), "ladder")["rungs"]:
        gymnasium.register(
            id=f"marl_handover/{rung['id']}", entry_point="marl_handover.envs.ladder:gymnasium_env", kwargs={"name": rung["name"]}
        )


class _Registrar:
    """Waits for the first import of Gymnasium, and registers what is ours once it is there."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Nothing is found here; Gymnasium's own loader is told to go on with us."""
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            _register(module)

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec


if hasattr(sys.modules.get("gymnasium"), "register"):
    _register(sys.modules["gymnasium"])
else:
    sys.meta_path.insert(0, _Registrar())
