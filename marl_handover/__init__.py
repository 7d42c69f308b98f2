"""Learned supervision of cooperating robot arms: hand-overs that bring an object to a goal pose.

With the package imported, Gymnasium knows ``marl_handover/SupervisorA-v0``, ``marl_handover/SupervisorB-v0`` and an id for each rung of the
ladder, such as ``marl_handover/Ladder-3-Triangle-v0``. Gymnasium itself is not imported for that: ``marl-handover stop`` must not wait
for it.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

__version__ = "0.1.0"


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
