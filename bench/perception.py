"""Perception in numbers, on rendered pictures of the whole reach of the `paper` cell, through a calibration made from rendered boards.

python bench/perception.py frames=1200 boards=20 seed=0 results=bench/results

Each of twelve cameras hangs a little differently, is calibrated by itself (lens: boards held before it; place: a board laid at three places
on the table, as exactly as the twin's people lay one), stored and loaded. Then it sees block and goal anywhere, with another blur, noise
and light every ten pictures, half of the pictures cluttered, the arms parked, the pin in its place. Times are of a processor, one thread.
"""

from __future__ import annotations

import datetime
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent))
import cv2
import numpy as np
from common import ROOT, commit, machine, parse, table
from tqdm import tqdm

from marl_handover.arrays import wrap
from marl_handover.cell.build import CellModel, build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.control.settings import TwinConfig
from marl_handover.geometry.se3 import flat_pose
from marl_handover.motion.home import parked_poses
from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels, calibrate_lens, hung_camera
from marl_handover.perception.detector import Detector
from marl_handover.perception.plane import BoardOnTable, locate_by_board
from marl_handover.perception.printables import charuco_sheet
from marl_handover.perception.scene import CellPainter, held_boards
from marl_handover.perception.settings import BoardConfig, LookConfig, MountConfig

DEFAULTS = {"frames": 1200, "cameras": 12, "boards": 20, "seed": 0, "results": "bench/results"}
SIZE_PX = (1280, 720)
PLACES = ((0.0, 0.0, 0.0), (-90.0, 20.0, math.pi / 2), (90.0, -20.0, -math.pi / 2))
BINS_MM = (0, 100, 200, 250, 310)
BARS = {"position_mm": (0.5, 1.5), "yaw_deg": (0.2, 1.7), "detected": 0.99, "frame_ms": 35.0, "tracked_ms": 3.0}


class Result(NamedTuple):
    """One picture: how far off the axis the block stood, errors (NaN: not detected), the stage, times in ms."""

    radius_mm: float
    position_mm: float
    yaw_deg: float
    stage: str
    frame_ms: float
    tracked_ms: float
    render_ms: float


def random_mount(random: np.random.Generator) -> MountConfig:
    """A camera hung by hand."""
    eye = np.array([0.0, 0.0, 700.0]) + random.uniform(-4, 4, 3)
    return MountConfig(eye.tolist(), random.uniform(-0.35, 0.35, 2).tolist(), float(random.uniform(-1, 1)), float(random.uniform(912, 922)))


def random_look(random: np.random.Generator) -> LookConfig:
    """Blur, noise and light of a lab."""
    return LookConfig(*(float(random.uniform(*span)) for span in ((0.5, 1.3), (2, 5), (0, 0.5), (0.5, 1.1))))


def cluttered(random: np.random.Generator) -> Pixels:
    """A table with 60 scraps on it."""
    image = np.full((SIZE_PX[1], SIZE_PX[0], 3), (226, 229, 230), np.uint8)
    for _ in range(60):
        points = random.uniform(0, 1, 2) * SIZE_PX + random.normal(0, 40, (random.integers(3, 6), 2))
        colour = random.uniform(40, 255, 3).tolist()
        cv2.fillConvexPoly(image, cv2.convexHull(np.rint(points).astype(np.int32).reshape(-1, 1, 2)), colour, cv2.LINE_AA)
    return image


def calibrated(model: CellModel, truth: CameraCalibration, boards: int, seed: int) -> CameraCalibration:
    """What calibrating this camera comes out at, by way of its file."""
    board = BoardConfig()
    painter = CellPainter(model, truth, look=LookConfig(), seed=seed)
    sheet = charuco_sheet(board, margin_mm=10)
    lens = calibrate_lens((painter.picture(None, sheets=[(sheet, T)]) for T in held_boards(truth, boards, seed)), board)
    people, random = TwinConfig(), np.random.default_rng([seed, 1])
    laid = np.array(PLACES) + random.normal(size=(len(PLACES), 3)) * (
        people.board_sd_mm,
        people.board_sd_mm,
        math.radians(people.board_sd_deg),
    )
    views = [
        BoardOnTable(painter.picture(None, sheets=[(sheet, flat_pose(*lies))]), *place) for lies, place in zip(laid, PLACES, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.json"
        locate_by_board(lens, views, board).save(path)
        return CameraCalibration.load(path)


def reachable(model: CellModel, random: np.random.Generator, count: int) -> Floats:
    """Poses (count, 3), uniform over the reach of the arms and over all orientations."""
    reach = max(abs(base.y_mm) for base in model.cell.bases) + model.cell.r_max_mm
    points = random.uniform(-reach, reach, (60 * count, 2))
    points = points[model.cell.reaches(points).any(-1)][:count]
    return np.column_stack([points, random.uniform(-math.pi, math.pi, len(points))])


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result, and ms of a processor."""
    began = time.process_time()
    return work(), (time.process_time() - began) * 1e3


def see(painter: CellPainter, detector: Detector, pose: Floats, goal: Floats, parked: Floats) -> Result:
    """Render and detect once, from nothing and from where it is known to be."""
    image, render_ms = timed(lambda: painter.picture(flat_pose(*pose), parked, goal))
    sighting, frame_ms = timed(lambda: detector.detect(image))
    found, radius = sighting.block, math.hypot(*pose[:2])
    if found is None:
        return Result(radius, math.nan, math.nan, "none", frame_ms, math.nan, render_ms)
    near = None if sighting.goal is None else sighting.goal.pose
    _, tracked_ms = timed(lambda: detector.detect(image, found.pose, near, near is None))
    yaw = abs(math.degrees(float(wrap(found.pose[2] - pose[2]))))
    error, tracked_ms = math.hypot(*(found.pose[:2] - pose[:2])), math.nan if near is None else tracked_ms
    return Result(radius, error, yaw, found.stage, frame_ms, tracked_ms, render_ms)


def measure(values: dict[str, Any]) -> tuple[list[Result], list[float]]:
    """Results of all pictures; and how far off the calibrated map of the table is at worst, in mm, per camera."""
    model, random = build_cell(cell_config("paper")), np.random.default_rng(values["seed"])
    parked = parked_poses(model, MotionConfig())
    block = model.cell.config.block
    each = -(-values["frames"] // values["cameras"])
    results, maps = [], []
    for number in tqdm(range(values["cameras"]), desc="cameras", leave=False):
        truth = hung_camera(random_mount(random), SIZE_PX)
        detector = Detector(calibrated(model, truth, values["boards"], number), block)
        poses, goals = reachable(model, random, each), reachable(model, random, each)
        tops = np.column_stack([poses[:, :2], np.full(len(poses), block.height_mm)])
        maps.append(float(np.hypot(*(detector.calibration.on_plane(truth.project(tops), block.height_mm) - poses[:, :2]).T).max()))
        for part in range(0, each, 10):
            background = cluttered(random) if part // 10 % 2 else None
            painter = CellPainter(model, truth, look=random_look(random), seed=part, background=background)
            results += [
                see(painter, detector, *pair, parked) for pair in zip(poses[part : part + 10], goals[part : part + 10], strict=True)
            ]
    return results, maps


def summary(results: Sequence[Result]) -> dict[str, Any]:
    """Errors, share detected and times."""
    names = ("position_mm", "yaw_deg", "frame_ms", "tracked_ms", "render_ms")
    columns = {name: np.array([getattr(result, name) for result in results]) for name in names}
    found = np.isfinite(columns["position_mm"])
    spread = {
        name: dict(zip(("p50", "p95", "p99", "max"), np.nanpercentile(column, [50, 95, 99, 100]).round(4).tolist(), strict=True))
        for name, column in columns.items()
    }
    return {"frames": len(results), "detected": float(found.mean()), **spread}


def show(found: dict[str, Any]) -> str:
    """The numbers as a table."""
    rows = []
    for name, it in found["groups"].items():
        errors = [" / ".join(f"{it[key][point]:.3f}" for point in ("p50", "p99", "max")) for key in ("position_mm", "yaw_deg")]
        times = [" / ".join(f"{it[key][point]:.1f}" for point in ("p50", "p95")) for key in ("frame_ms", "tracked_ms")]
        rows.append([name, str(it["frames"]), f"{100 * it['detected']:.2f} %", *errors, *times])
    rows.append(["bar", "", f"{100 * BARS['detected']:.0f} %", "0.5 / 1.5", "0.2 / 1.7", "35", "3"])
    heads = ["pictures", "n", "detected", "position mm 50/99/100 %", "yaw deg 50/99/100 %", "frame ms 50/95 %", "tracked ms 50/95 %"]
    map_mm, drawn_ms = max(found["map_error_mm"]), found["groups"]["all"]["render_ms"]["p50"]
    notes = f"the calibrated map of the table is off by at most {map_mm:.3f} mm; a picture is drawn in {drawn_ms:.0f} ms"
    return f"{table(heads, rows)}\n{notes}"


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    cv2.setNumThreads(1)
    results, maps = measure(values)
    groups = {"all": results}
    for low, high in pairwise(BINS_MM):
        groups[f"{low} to {high} mm off the axis"] = [it for it in results if low <= it.radius_mm < high]
    for stage in ("plain", "opened"):
        groups[f"found by the {stage} stage"] = [it for it in results if it.stage == stage]
    found = {"groups": {name: summary(some) for name, some in groups.items() if some}, "map_error_mm": maps, "bars": BARS}
    print(show(found))
    folder = ROOT / values["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(1)}
    (folder / "perception.json").write_text(json.dumps({**about, **found}, indent=1) + "\n")
    print(f"-> {folder / 'perception.json'}")


if __name__ == "__main__":
    main(sys.argv[1:])
