"""The live page in a real browser, before a real twin session in a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time

import pytest

from marl_handover.control.telemetry_reader import TelemetryReader

pytestmark = pytest.mark.slow

PATIENCE_MS = 120_000
LEAST_COLOURS = 500


def says(page, pattern):
    page.get_by_text(re.compile(pattern)).first.wait_for(timeout=PATIENCE_MS)


def press(page, name):
    button = page.get_by_role("button", name=name, exact=True)
    page.wait_for_function("button => !button.disabled", arg=button.element_handle(), timeout=PATIENCE_MS)
    button.click()


def test_a_session_is_started_watched_and_stopped_from_the_page(serving, opened, twin_calibration, tmp_path):
    folder = tmp_path / "live"
    command = ["hardware=twin", f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}", "policy=pretrained_b"]
    steered = [f"publish={folder}", "episodes=50", "real_time=true", "view_control=true", "paused=true"]
    folder.mkdir()
    session = subprocess.Popen(
        [sys.executable, "-m", "marl_handover.cli", "run", *command, *steered],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        with serving(live=str(folder)) as address:
            page = opened(address)
            says(page, "no transfer begins before somebody goes on")
            press(page, "start")
            says(page, "(left|right) arm (goes to|lifts|carries)")
            picture = page.locator("img[src^='blob:']").first
            picture.wait_for(timeout=PATIENCE_MS)
            assert picture.evaluate("image => [image.naturalWidth, image.naturalHeight]") == [640, 360]
            says(page, "confidence 0\\.[0-9]+")
            says(page, "to the goal")
            page.close()  # whoever closes the tab disturbs nobody
            before = TelemetryReader(folder).read().state["number"]
            page = opened(address)
            says(page, "(left|right) arm carries")
            time.sleep(1.0)
            shot = page.screenshot(path=os.environ.get("LIVE_SHOT", str(tmp_path / "live.png")))
            assert colours(shot) > LEAST_COLOURS
            assert TelemetryReader(folder).read().state["number"] > before
            press(page, "STOP")
            says(page, "STOPPED")
            says(page, f"process {session.pid} has stopped its arms")
            assert "stopped: STOP pressed in the browser" in session.communicate(timeout=60)[0]
            assert page.get_by_role("button", name="clear").count() == 0
            page.close()
    finally:
        session.kill()
        session.wait()
        session.stdout.close()


def colours(png):
    import io

    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return len(image.convert("RGB").getcolors(1 << 24))
