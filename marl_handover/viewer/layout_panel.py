"""The panel on which the cell itself is changed: arms and keep-out discs, dragged on the table or by buttons, and saved as a file."""

from __future__ import annotations

import math
import re
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from marl_handover.arrays import Floats
from marl_handover.config import CellConfig, require_choice
from marl_handover.control.interactive import layout
from marl_handover.control.interactive.cell import InteractiveCell, Snapshot
from marl_handover.errors import HandoverError, InvalidSetting, UnconnectedArms
from marl_handover.geometry.se2 import SE2
from marl_handover.viewer.handles import PlaneHandle
from marl_handover.viewer.scene import CellScene
from marl_handover.viewer.words import by_hand, number, write

NONE = "none"
HEIGHT_MM = 5.0
"""At which arms and discs are dragged."""

RADIUS_MM = (5.0, 100.0)
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}")

Edit = Callable[[CellConfig], CellConfig]


class LayoutPanel:
    """Shows a cell's layout, and passes on what people change of it.

    Args:
        server: of the page.
        cell: what plays.
        scene: of the page.
        dragged: is set when something should not wait.
    """

    def __init__(self, server: viser.ViserServer, cell: InteractiveCell, scene: CellScene, dragged: threading.Event) -> None:
        self.server, self.cell, self.scene, self._hurry = server, cell, scene, dragged
        self._given = cell.layout
        self._first = self._config = layout.placed_arms(self._given, cell.model)
        self._edits: deque[Edit] = deque(maxlen=64)
        self._arms: list[PlaneHandle] = []
        self._discs: list[PlaneHandle] = []
        self._generation = -1
        self._arm, self._disc, self._broken = NONE, NONE, False
        self._drawn: tuple[Any, ...] = ()
        self._told: tuple[Any, ...] = ()
        self.note = ""
        """What people should know of the cell as it is, one line; empty if nothing."""
        self._add_controls()

    def obey(self, lost: bool) -> str | None:
        """Take up what was dragged and pressed since the last time; nothing of it if it is ``lost``.

        Returns:
            What is wrong with it, "" if nothing is; None if there was nothing to take up.
        """
        for handles, noted in ((self._arms, self._note_arm), (self._discs, self._note_disc)):
            for index, handle in enumerate(handles):
                if (moved := handle.fetch()) is not None:
                    self._told = ()
                    noted(index, moved.pose)
        said = None
        while self._edits:
            edit = self._edits.popleft()
            if not lost:
                said = self._apply(edit)
        return said

    def show(self, snapshot: Snapshot) -> None:
        """The cell as it is, or as it is held if it cannot be so."""
        self._broken = snapshot.state == "broken"
        drawn = self._config if self._broken else self.cell.model, self._config.enabled, bool(self._dials.value), self._broken
        if len(self._drawn) != len(drawn) or any(one is not other for one, other in zip(drawn, self._drawn, strict=True)):
            self._drawn = drawn
            self._draw()
        stopped = snapshot.state == "stopped"
        told = id(self._config), self._arm, self._disc, stopped
        if self._told != told:
            self._told = told
            self._tell(stopped)

    def _tell(self, stopped: bool) -> None:
        """Put handles where things are, and the lists to what there is."""
        for handle, arm in zip(self._arms, self._config.arms, strict=False):
            pose = np.array([arm.x_mm, arm.y_mm, math.radians(arm.facing_deg)])
            handle.show(None if stopped else pose, arrows=arm.name == self._arm)
        for index, handle in enumerate(self._discs):
            there = index < len(self._config.obstacles) and not stopped
            disc = self._config.obstacles[index] if there else None
            handle.show(None if disc is None else np.array([disc.x_mm, disc.y_mm, 0.0]), arrows=False)
        self._list_choices()
        if any(handle.held is not None for handle in (*self._arms, *self._discs)):
            self._told = ()  # what is held is not moved, and has to be when it is let go

    def _draw(self) -> None:
        working = self.cell.in_order
        groups = [[working.names[arm] for arm in group] for group in working.graph.components]
        self.note = "" if self._broken or len(groups) == 1 else str(UnconnectedArms(groups, bool(working.keep_out)))
        if not self._broken:
            self.scene.show_cell(self.cell.model, self._config.enabled, bool(self._dials.value))
        elif [arm.name for arm in self._config.arms] == list(self.scene.model.cell.names):
            self.scene.show_bases([SE2.facing_deg(arm.x_mm, arm.y_mm, arm.facing_deg) for arm in self._config.arms])
        self._told = ()
        if self._generation != self.scene.generation:  # other nodes are to be dragged now
            for handle in self._arms:
                handle.remove()
            self._generation = self.scene.generation
            self._arms = [self._handle(f"/base_{self._generation}_{index}", nodes) for index, nodes in enumerate(self.scene.bases)]
        for index, node in enumerate(self.scene.discs[len(self._discs) :], len(self._discs)):
            self._discs.append(self._handle(f"/keep_out_{index}", [node]))

    def _handle(self, name: str, nodes: Sequence[str]) -> PlaneHandle:
        return PlaneHandle(self.server, name, HEIGHT_MM, nodes, self._hurry)

    def _note_arm(self, index: int, pose: Floats) -> None:
        if index < len(self._config.arms):
            name = self._arm = self._config.arms[index].name
            self._edits.append(lambda config: layout.with_base(config, name, pose))

    def _note_disc(self, index: int, pose: Floats) -> None:
        if index < len(self._config.obstacles):
            self._disc = str(index + 1)
            self._edits.append(lambda config: layout.with_disc_at(config, index, pose))

    def _apply(self, edit: Edit) -> str | None:
        """Change the layout; what is wrong with that, or None if nothing is taken up now."""
        try:
            config = edit(self._config)
        except HandoverError as error:
            return str(error)
        if not self.cell.set_layout(self._given if config == self._first else config):
            return None
        self._config = config
        return ""

    def _add_controls(self) -> None:
        gui = self.server.gui
        with gui.add_folder("the cell: arms and keep-out discs", expand_by_default=False):
            gui.add_markdown("**Drag an arm by its base**, a disc by its middle. The arm chosen here has arrows and an arc to turn it.")
            self._arm_choice = gui.add_dropdown("arm", (NONE, *(arm.name for arm in self._config.arms)), initial_value=NONE)
            self._arm_buttons = gui.add_button_group("arms", ("add", "on / off", "remove"))
            self._disc_choice = gui.add_dropdown("disc", (NONE,), initial_value=NONE)
            self._disc_buttons = gui.add_button_group("discs", ("drop", "remove"))
            self._radius = gui.add_slider("radius [mm]", min=RADIUS_MM[0], max=RADIUS_MM[1], step=1.0, initial_value=layout.DISC_MM)
            self._dials = gui.add_checkbox(
                "hand-over angles", False, hint="which angles each two arms offer: thick on a circle of all of them"
            )
            reset = gui.add_button("the cell as it was")
            self._file = gui.add_text("file", f"{_file_name(self._given.name)}_2")
            save = gui.add_button("save as YAML", hint="for cell=FILE of every command")
        self._arm_choice.on_update(self._choose_arm)
        self._disc_choice.on_update(self._choose_disc)
        self._radius.on_update(self._resize)
        self._arm_buttons.on_click(lambda _: self._press(self._arm_edit(str(self._arm_buttons.value))))
        self._disc_buttons.on_click(lambda _: self._press(self._disc_edit(str(self._disc_buttons.value))))
        reset.on_click(lambda _: self._press(lambda _: self._first))
        save.on_click(self._save)

    def _press(self, edit: Edit) -> None:
        self._edits.append(edit)
        self._hurry.set()

    def _arm_edit(self, what: str) -> Edit:
        name = self._arm
        if what == "add":
            return lambda config: layout.with_arm(self._sound(config), self.cell.model)
        return lambda config: (layout.switched if what == "on / off" else layout.without_arm)(config, self._chosen_arm(config, name))

    def _disc_edit(self, what: str) -> Edit:
        chosen = self._disc
        if what == "drop":
            return self._dropped
        return lambda config: layout.without_disc(config, self._chosen_disc(config, chosen))

    def _dropped(self, config: CellConfig) -> CellConfig:
        """A disc off the block and the goal, which is chosen then."""
        wider = layout.with_disc(self._sound(config), self.cell.model, self.cell.kept_clear())
        self._disc = str(len(wider.obstacles))
        return wider

    def _sound(self, config: CellConfig) -> CellConfig:
        if self._broken:
            raise InvalidSetting("cell", config.name, "one that can be, before something is added: move what is red")
        return config

    def _chosen_arm(self, config: CellConfig, name: str) -> str:
        names = [arm.name for arm in config.arms]
        if name == NONE:
            raise InvalidSetting("arm", NONE, f"chosen first, or dragged: one of {', '.join(names)}")
        require_choice("arm", name, names)
        return name

    def _chosen_disc(self, config: CellConfig, chosen: str) -> int:
        if chosen == NONE:
            raise InvalidSetting("disc", NONE, "chosen first, or dragged")
        require_choice("disc", chosen, [str(index + 1) for index in range(len(config.obstacles))])
        return int(chosen) - 1

    def _choose_arm(self, event: viser.GuiEvent[Any]) -> None:
        if by_hand(event):
            self._told = ()
            self._arm = str(self._arm_choice.value)

    def _choose_disc(self, event: viser.GuiEvent[Any]) -> None:
        if by_hand(event):
            self._told = ()
            self._disc = str(self._disc_choice.value)

    def _resize(self, event: viser.GuiEvent[Any]) -> None:
        """The disc that is chosen gets another radius."""
        if by_hand(event) and self._disc != NONE:
            chosen, radius_mm = self._disc, number(self._radius, *RADIUS_MM)
            self._press(lambda config: layout.with_radius(config, self._chosen_disc(config, chosen), radius_mm))

    def _list_choices(self) -> None:
        """The lists to choose from, where they have changed."""
        names = [arm.name for arm in self._config.arms]
        discs = [str(index + 1) for index in range(len(self._config.obstacles))]
        self._arm = self._arm if self._arm in names else NONE
        self._disc = self._disc if self._disc in discs else NONE
        for choice, options, value in ((self._arm_choice, names, self._arm), (self._disc_choice, discs, self._disc)):
            if tuple(choice.options) != (NONE, *options):
                choice.options = (NONE, *options)
            if choice.value != value:
                write(choice, value)
        if self._disc != NONE and self._radius.value != (radius_mm := self._config.obstacles[int(self._disc) - 1].radius_mm):
            write(self._radius, radius_mm)

    def _save(self, event: viser.GuiEvent[Any]) -> None:
        """Send the cell as a file to whoever pressed the button; the browser keeps it."""
        name = _file_name(str(self._file.value))
        if event.client is not None:
            event.client.send_file_download(f"{name}.yaml", layout.file_text(self._config, name).encode(), save_immediately=True)


def _file_name(text: str) -> str:
    """What of a text can be the name of a file; ``cell`` if nothing can."""
    kept = re.sub(r"[^A-Za-z0-9_-]+", "_", text.removesuffix(".yaml")).strip("_-")[:60]
    return kept if FILE_NAME.fullmatch(kept) else "cell"
