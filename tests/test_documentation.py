"""The README and the documentation site: every code block runs, no key is made up, the site builds without a warning.

The rules of blocks stand in ``docs_blocks.py``.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys

import pytest
import yaml

from marl_handover.cli import COMMANDS, PROGRAM
from marl_handover.errors import MissingExtra
from marl_handover.hardware.errors import BoardReset, BoardSilent, NotConfirmed, PortNotFound, PulseMismatch, Stopped
from marl_handover.viewer.server import PortTaken
from tests.docs_blocks import PAGES, ROOT, Session, blocks, check_line, command, command_lines, matches, write_file

names = [str(page.relative_to(ROOT)) for page in PAGES]


def load_hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "docs" / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_page(page, tmp_path, monkeypatch, slow):
    """All blocks of a page in their order, those marked slow only if ``slow``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench").symlink_to(ROOT / "bench")
    session = Session()
    for block in blocks(page):
        if block.excused or (block.slow and not slow):
            session.skip()
        else:
            session.run(block)


def wanted(slow):
    """Pages that have something to run; slow ones only if they have slow blocks."""
    for page, name in zip(PAGES, names, strict=True):
        run = [block for block in blocks(page) if not block.excused]
        if any(block.slow for block in run) if slow else run:
            yield pytest.param(page, id=name)


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_every_block_has_a_language_and_a_rule(page):
    text = page.read_text(encoding="utf-8")
    found = blocks(page)
    assert [f"{block.where}: {block.problem()}" for block in found if block.problem()] == []
    assert len(re.findall(r"^ *```", text, re.M)) == 2 * len(found), "a fence is not closed, or a block is not seen"
    assert len(re.findall(r"<!-- test:", text)) == sum(bool(block.words) for block in found), "a rule does not stand above a block"


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_every_command_line_is_one(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.value("file"):
            write_file(block)
        if block.language != "bash" or block.value("status"):
            continue
        for words in command_lines(block):
            if words[0] == PROGRAM:
                check_line(words)


@pytest.mark.parametrize("page", list(wanted(slow=False)))
def test_blocks_run(page, tmp_path, monkeypatch, no_new_plugins):
    run_page(page, tmp_path, monkeypatch, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", list(wanted(slow=True)))
def test_slow_blocks_run(page, tmp_path, monkeypatch, no_new_plugins):
    run_page(page, tmp_path, monkeypatch, slow=True)


@pytest.mark.parametrize(
    ("expected", "printed", "same"),
    [("a b", "x\na b  \n", True), ("a … d", "a b\nc d", True), ("a … e", "a b\nc d", False), ("1.5", "105", False)],
)
def test_output_is_compared_as_it_stands(expected, printed, same):
    assert matches(expected, printed) == same


@pytest.mark.parametrize(
    ("rule", "fence", "code"),
    [
        ("", "", "no language"),
        ("", "ruby", "puts 1"),
        ("", "text", "no rule"),
        ("", "yaml", "no: file"),
        ("sloow", "python", "1"),
        ("steps=3", "python", "1"),
        ("not run:", "bash", "no reason"),
    ],
)
def test_a_block_without_language_or_rule_is_found(tmp_path, rule, fence, code):
    (block,) = blocks(page_of(tmp_path, rule, fence, code))
    assert block.problem()


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        ("", "marl-handover plan goal=[0,-100,0]"),  # fails
        ("status=2", "marl-handover plan"),  # does not
        ("fps=3", "marl-handover plan"),  # no such key there
        ("", "rm -r x"),
        ("", "marl-handover plan\n```\n\n<!-- test: output -->\n```text\nsuccess: 3 transfers"),
        ("", "marl-handover doctor\n```\n\n```python\n1 / 0"),
    ],
)
def test_a_block_that_does_not_do_what_it_says_is_found(tmp_path, monkeypatch, rule, code):
    page = page_of(tmp_path, rule, "bash", code)
    with pytest.raises((AssertionError, ZeroDivisionError)):
        run_page(page, tmp_path, monkeypatch, slow=True)


def page_of(folder, rule, fence, code):
    """A page of one block or more."""
    page = folder / "page.md"
    page.write_text((f"<!-- test: {rule} -->\n" if rule else "") + f"```{fence}\n{code}\n```\n")
    return page


@pytest.mark.parametrize("name", COMMANDS)
def test_reference_of_commands_says_what_help_says(name):
    page = load_hooks().command_page(name)
    status, text = command([name, "--help"])
    assert status == 0
    cells = [
        [re.sub(r"<[^>]*>", "", cell).strip() for cell in row.strip("|").split("|")] for row in page.splitlines() if row.startswith("| <")
    ]
    told = [[_signs(cell) for cell in row] for row in cells]
    helped = [line for line in text.split("\n\n")[-1].splitlines() if line and line != "no keys"]
    assert len(told) == len(helped)
    for row, line in zip(told, helped, strict=True):
        assert line.split() == " ".join(row).split()


def _signs(cell):
    """Entities as the signs they stand for."""
    return re.sub(r"&#(\d+);", lambda match: chr(int(match[1])), cell)


def test_navigation_and_pages_are_the_same():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    listed = re.findall(r"[\w/-]+\.md", str(nav))
    assert sorted(listed) == sorted(path.relative_to(ROOT / "docs").as_posix() for path in PAGES[1:])


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_links_and_pictures_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path = target.partition("#")[0]
        if path and "://" not in path and not path.partition("docs/")[2].startswith("reference/") and "reference/" not in path:
            assert (page.parent / path).exists(), f"{page.name}: {target}"


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, timeout=500, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES) + len(COMMANDS)
    outside = re.compile(
        r"<(?:script|img|iframe|source|video)[^>]+src=\"?https?:|<link[^>]+href=\"?https?:[^>]*(?:stylesheet|preload|icon)|@import|url\(\"?https?:"
    )
    for path in [*pages, *(tmp_path / "site").rglob("*.css")]:
        assert not outside.search(path.read_text(encoding="utf-8")), path


def messages():
    """Errors that need hardware to be met, each as it would be raised."""
    found = ["/dev/ttyUSB0"]
    denied = "it cannot be opened (Permission denied); run: sudo usermod -aG dialout $USER, and log in again"
    return [
        MissingExtra(f"{PROGRAM} view", "viser", "view"),
        PortNotFound("/dev/ttyUSB0", denied, found),
        PortNotFound("", "none looks like a controller board", []),
        BoardSilent("/dev/ttyUSB0", [115200, 9600]),
        BoardReset("main", [0, 1]),
        PulseMismatch("main", 3, 1500, (1700, 1730), 15),
        NotConfirmed(),
        Stopped("a reason"),
        PortTaken(8080, "Address already in use"),
    ]


@pytest.mark.parametrize("error", messages(), ids=lambda error: type(error).__name__)
def test_errors_that_need_hardware_are_told_word_for_word(error):
    shown = [block.code for block in blocks(ROOT / "docs" / "faq.md") if block.language == "text" and block.excused]
    assert any(matches(text, str(error)) for text in shown)


def test_no_error_is_shown_that_no_test_knows():
    shown = [block for block in blocks(ROOT / "docs" / "faq.md") if block.language == "text" and block.excused]
    assert len(shown) == len(messages())
