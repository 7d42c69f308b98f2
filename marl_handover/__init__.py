"""Learned supervision of cooperating robot arms: hand-overs that bring an object to a goal pose.

With the package imported, Gymnasium knows ``marl_handover/SupervisorA-v0`` and ``marl_handover/SupervisorB-v0``. Gymnasium itself is not
imported for that: ``marl-handover stop`` must not wait for it.
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
            kwargs={"architecture": architecture},
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
