"""The pages in a real browser, with a real mouse."""

from __future__ import annotations

import io
import math
import re

import numpy as np
import pytest
from PIL import Image
from viewer_client import Client

from marl_handover import cli
from marl_handover.cell import build_cell, cell_config
from marl_handover.viewer.scene import EYE_MM, PAIR_EXTENT_MM, TARGET_MM, VIEW_DEG

pytestmark = pytest.mark.slow

SIZE = (1280, 720)
LOADED_MS = 3000
"""For the first pictures of a browser that draws without a graphics card."""


def pixel(point_mm, away=1.0):
    """Where the page shows a point at first; ``away``: how far the eye is, in distances from a pair."""
    eye, target = away * np.array(EYE_MM), away * np.array(TARGET_MM)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    seen = np.asarray(point_mm, float) - eye
    scale = SIZE[1] / 2 / math.tan(math.radians(VIEW_DEG) / 2) / (seen @ forward)
    return SIZE[0] / 2 + scale * (seen @ right), SIZE[1] / 2 - scale * (seen @ np.cross(right, forward))


def colours(png):
    """How many different colours a picture has, to 4 bits a channel."""
    image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[::2, ::2] // 16
    return len(np.unique(image.reshape(-1, 3).astype(np.int64) @ [1, 16, 256]))


def drag(page, start_mm, end_mm, away=1.0):
    """With the left button, in many small moves."""
    page.mouse.move(*pixel(start_mm, away))
    page.wait_for_timeout(300)
    page.mouse.down()
    for share in np.linspace(0, 1, 15)[1:]:
        page.mouse.move(*pixel(np.asarray(start_mm) + share * (np.asarray(end_mm) - start_mm), away))
        page.wait_for_timeout(60)
    page.wait_for_timeout(300)
    page.mouse.up()


def goal_of(viewer):
    return 1e3 * np.asarray(viewer.nodes["/goal"]["position"][:2])


def test_a_goal_dragged_with_the_mouse_is_reached_and_stop_stops(serving, opened, tmp_path):
    with serving(seed=3, speed=4.0) as address, Client(address) as viewer:
        page = opened(address)
        asked = []
        page.on("request", lambda request: asked.append(request.url))
        page.get_by_text("STOP", exact=True).wait_for()
        page.wait_for_timeout(LOADED_MS)
        page.get_by_role("button", name="pause").click()  # in mid-motion, so that no arm is in the way of the mouse later
        page.get_by_role("button", name="go on").wait_for()
        before, wanted = goal_of(viewer), np.array([-120.0, 60.0])
        drag(page, [*before, 7.0], [*wanted, 7.0])
        viewer.wait(lambda: np.hypot(*(goal_of(viewer) - wanted)) < 12.0, 20)
        page.get_by_role("button", name="go on").click()
        page.get_by_text("Done: the block is at its goal.").wait_for()
        picture = page.screenshot(path=tmp_path / "play.png")
        assert colours(picture) > 60
        body = page.inner_text("body")
        for text in ("transfers so far", "the fewest possible", "problems solved", "Last decision:", "policy", "speed", "pause"):
            assert text in body
        page.get_by_text("STOP", exact=True).click()
        page.get_by_text("STOPPED").wait_for()
        page.get_by_role("button", name="clear the stop").click()
        page.get_by_role("button", name="go on").click()
        page.get_by_text("STOPPED").wait_for(state="detached")
        assert all(re.match(r"(blob:)?http://127\.0\.0\.1:", url) for url in asked)


def test_a_trace_is_played_and_scrubbed(serving, opened, tmp_path):
    file = tmp_path / "trace.jsonl"
    assert cli.main(["evaluate", "policy=exact", "episodes=4", f"trace={file}", "progress=false"]) == 0
    with serving(trace=str(file), speed=20.0) as address, Client(address) as viewer:
        page = opened(address)
        page.get_by_text("play", exact=True).wait_for()
        page.wait_for_timeout(LOADED_MS)
        assert colours(page.screenshot(path=tmp_path / "trace.png")) > 60
        page.get_by_role("button", name="next", exact=True).click()
        page.get_by_text(re.compile("transfer 1 of")).wait_for()
        page.get_by_text("play", exact=True).click()
        page.get_by_text("success").wait_for()
        viewer.wait(lambda: "Episode 3" in viewer.text() and "success" in viewer.text(), 120)
        page.get_by_text("play", exact=True).wait_for()
        page.get_by_role("button", name="previous", exact=True).click()
        viewer.wait(lambda: "success" not in viewer.text(), 20)


def test_six_arms_are_moved_added_switched_off_and_saved(serving, opened, tmp_path):
    """One cell after the other: a base is dragged, a disc dropped, an arm switched off and one added; the file has all that."""
    cell = build_cell(cell_config("ring6")).cell
    away = max(cell.extent_mm) / PAIR_EXTENT_MM
    with serving(cell=cell.config, policy="pretrained_any", seed=3) as address, Client(address) as viewer:
        page = opened(address)
        page.get_by_text("STOP", exact=True).wait_for()
        page.wait_for_timeout(LOADED_MS)
        page.get_by_text("the cell: arms and keep-out discs").click()
        page.get_by_text("hand-over angles", exact=True).click()
        wanted = np.array([-60.0, 360.0])
        drag(page, [0.0, 440.0, 25.0], [*wanted, 25.0], away)
        viewer.wait(lambda: np.hypot(*(1e3 * np.asarray(viewer.nodes["/arm_0"]["position"][:2]) - wanted)) < 12.0, 20)
        page.get_by_role("button", name="drop").click()
        viewer.wait(lambda: viewer.nodes.get("/disc_0", {}).get("visible"), 20)
        page.get_by_role("button", name="on / off").click()
        page.get_by_role("button", name="add").click()
        viewer.wait(lambda: "/arm_6" in viewer.nodes, 20)
        page.wait_for_timeout(LOADED_MS)
        assert colours(page.screenshot(path=tmp_path / "six.png")) > 60
        with page.expect_download() as download:
            page.get_by_role("button", name="save as YAML").click()
        file = tmp_path / download.value.suggested_filename
        download.value.save_as(file)
        assert file.name == "ring6_2.yaml"
        saved = cell_config(str(file))
        assert [arm.name for arm in saved.arms] == [*cell.names, "seven"]
        assert saved.enabled == [*cell.names[1:], "seven"]
        assert math.hypot(saved.arms[0].x_mm - wanted[0], saved.arms[0].y_mm - wanted[1]) < 12.0
        assert len(saved.obstacles) == 1
        drag(page, [381.0, -220.0, 25.0], [381.0, 190.0, 25.0], away)  # into the base of another arm
        page.get_by_text("The arms wait: the cell cannot be like this.").wait_for()
        page.get_by_role("button", name="the cell as it was").click()
        page.get_by_text("The arms wait").wait_for(state="detached")
        viewer.wait(lambda: "/arm_6" not in viewer.nodes or "problems solved" in viewer.text(), 20)
    assert cli.main(["evaluate", "policy=exact", f"cell={file}", "episodes=5", "progress=false"]) == 0


def test_a_trace_of_six_arms_is_shown(serving, opened, tmp_path):
    file = tmp_path / "trace.jsonl"
    assert cli.main(["evaluate", "policy=exact", "cell=ring6", "episodes=4", f"trace={file}", "progress=false"]) == 0
    with serving(trace=str(file), cell=cell_config("ring6"), speed=20.0) as address, Client(address) as viewer:
        page = opened(address)
        page.get_by_text("play", exact=True).wait_for()
        page.wait_for_timeout(LOADED_MS)
        assert colours(page.screenshot(path=tmp_path / "trace.png")) > 60
        page.get_by_text("play", exact=True).click()
        viewer.wait(lambda: "Episode 3" in viewer.text() and "success" in viewer.text(), 120)


def test_on_a_phone_the_cell_is_above_the_panel(serving, opened, tmp_path):
    with serving(cell=cell_config("triangle"), seed=3) as address:
        page = opened(address)
        page.set_viewport_size({"width": 390, "height": 844})
        page.reload()
        page.get_by_text("STOP", exact=True).wait_for()
        page.wait_for_timeout(LOADED_MS)
        picture = Image.open(io.BytesIO(page.screenshot(path=tmp_path / "phone.png"))).crop((0, 140, 390, 340))
        assert len(np.unique(np.asarray(picture.convert("RGB"))[::2, ::2].reshape(-1, 3) // 16, axis=0)) > 60
