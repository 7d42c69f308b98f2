"""Pages that are really served, on a free port, and viewers that really connect."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("viser", reason="the view extra is not installed")
from marl_handover.commands.view import ViewCommand, serve
from marl_handover.viewer.server import open_server

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Without a graphics card; the page needs WebGL all the same.
OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture
def server():
    with open_server(0, "test") as server:
        yield server


@pytest.fixture(scope="session")
def serving():
    """``with serving(key=value, ...) as address:`` a page of ``view``, in another thread."""

    @contextlib.contextmanager
    def make(**settings) -> Iterator[str]:
        ended, ready, told, failed = threading.Event(), threading.Event(), [], []

        def tell(address: str) -> None:
            told.append(address)
            ready.set()

        def run() -> None:
            try:
                serve(ViewCommand(port=0, **settings), ended, tell)
            except BaseException as error:
                failed.append(error)
            ready.set()

        thread = threading.Thread(target=run)
        thread.start()
        ready.wait()
        try:
            if failed:
                raise failed[0]
            yield told[0]
        finally:
            ended.set()
            thread.join()
        if failed:
            raise failed[0]

    return make


@pytest.fixture(scope="session")
def opened() -> Iterator[Callable[[str], object]]:
    """``opened(address)``: the page in a headless browser, 1280 x 720; the one before is closed."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next((found for found in map(shutil.which, BROWSERS) if found), None)
    if path is None:
        pytest.skip(f"none of these browsers is installed: {', '.join(BROWSERS)}")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=list(OPTIONS))

        def make(address: str):
            for old in [page for context in browser.contexts for page in context.pages]:
                old.close()
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.set_default_timeout(60_000)
            page.goto(address)
            return page

        yield make
        browser.close()
