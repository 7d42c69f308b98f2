"""Make the pictures of the docs, into docs/img: ``python scripts/docs_images.py [NAME ...]``.

Without names all but the film, which takes minutes. Names: workspace, plan, motion, learning, errors, confusion, twin_camera, handover, and
those of ``many_arms_images.py``.
"""

import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from many_arms_images import FIGURES
from PIL import Image

from marl_handover import cli
from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.geometry.se3 import flat_pose
from marl_handover.motion.home import parked_poses
from marl_handover.palette import YELLOW
from marl_handover.perception.calibration import hung_camera
from marl_handover.perception.detector import Detector
from marl_handover.perception.overlay import Mark, annotated
from marl_handover.perception.scene import CellPainter
from marl_handover.perception.settings import MountConfig, TargetConfig
from marl_handover.report.figure_style import SERIES, save_figure

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "img"
SEEDS = [str(ROOT / "bench" / "results" / "2026-11-22" / name) for name in ("b0", "b1", "b2")]
NOISE = ["task.noise.position_mm=2", "task.noise.yaw_deg=2"]
TRACE = "pretrained_b_noisy.jsonl"

COMMANDS = {
    "workspace": ["plot", "kind=workspace"],
    "plan": ["plot", "kind=plan", "json={work}/plan.json"],
    "motion": ["plot", "kind=motion", "json={work}/motion.json"],
    "learning": ["plot", "kind=run", f"run=[{','.join(SEEDS)}]"],
    "errors": ["plot", "kind=errors", f"trace={{work}}/{TRACE}"],
    "confusion": ["plot", "kind=confusion", f"trace={{work}}/{TRACE}"],
}
FIRST = {
    "plan": ["plan", "json={work}/plan.json"],
    "motion": ["plan", "motion={work}/motion.json"],
    "errors": ["evaluate", "policy=pretrained_b", "episodes=2000", "seed=100", *NOISE, f"trace={{work}}/{TRACE}"],
    "confusion": ["evaluate", "policy=pretrained_b", "episodes=2000", "seed=100", *NOISE, f"trace={{work}}/{TRACE}"],
}
FILM = ["simulate", "policy=pretrained_b", "start=[130,-60,0]", "goal=[-130,60,180]", "fps=20", f"video={IMAGES}/handover.gif"]


def twin_camera(path: Path) -> None:
    """What the twin's camera sees, and what the detector makes of it."""
    model, target = build_cell(cell_config("paper")), TargetConfig()
    camera = hung_camera(MountConfig(), (1280, 720))
    block = np.array([70.0, -15.0, math.radians(35)])
    parked = parked_poses(model, MotionConfig())
    image = CellPainter(model, camera, target).picture(flat_pose(*block), parked, np.array([-60.0, 25.0, math.radians(100)]))
    side_mm, height_mm = model.cell.config.block.side_mm, model.cell.config.block.height_mm
    seen = Detector(camera, model.cell.config.block, target).detect(image)
    marks = [
        Mark(
            found.pose, edge_mm, z_mm, colour, f"{name} {found.pose[0]:.0f}, {found.pose[1]:.0f} mm, {math.degrees(found.pose[2]):.0f} deg"
        )
        for name, found, edge_mm, z_mm, colour in (
            ("block", seen.block, side_mm, height_mm, YELLOW),
            ("goal", seen.goal, target.goal_mm, target.goal_height_mm, SERIES[4]),
        )
        if found is not None
    ]
    Image.fromarray(np.ascontiguousarray(annotated(image, camera, marks, 1280)[..., ::-1])).crop((190, 130, 1090, 590)).save(path)
    print(f"written: {path}")


def lighten(path: Path) -> None:
    """A palette of 256 colours is enough for figures, and a third of the bytes."""
    with Image.open(path) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def lines(name: str) -> list[list[str]]:
    """The commands that make one of the pictures."""
    if name == "handover":
        return [FILM]
    if name == "twin_camera" or name in FIGURES:
        return []
    first = [FIRST[name]] if name in FIRST else []
    return [*first, [*COMMANDS[name], f"out={IMAGES / name}.png"]]


def main(names: list[str]) -> int:
    """Make them; the first command that fails gives the exit status."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            if name == "twin_camera":
                twin_camera(IMAGES / "twin_camera.png")
            if name in FIGURES:
                save_figure(FIGURES[name](), IMAGES / f"{name}.png")
                print(f"written: {IMAGES / name}.png")
            for line in lines(name):
                if status := cli.main([part.format(work=work) for part in line]):
                    return status
            if name != "handover":
                lighten(IMAGES / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or [*COMMANDS, "twin_camera", *FIGURES]))
