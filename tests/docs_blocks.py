"""The code blocks of the README and of docs/, and how each is tested: the one place that knows the rules.

A rule is an HTML comment right above its block, ``<!-- test: WORDS -->``; the words, separated by blanks:

==================  ===================================================================================================
no comment          python: run in this process; bash: run line by line; yaml: written to the file that ``file=`` names
``key=value``       bash: put behind every ``marl-handover`` line that knows the key, to make a long line short; ``{here}``: the folder
``slow``            run only by ``make test-slow``
``status=N``        bash: the exit status that the block's commands have
``file=NAME``       yaml, python: written to NAME, for the blocks that follow
``alone``           python: run in a process of its own
``output``          text: what the block before printed, in part; ``…`` stands for anything
``shown: REASON``   text: printed by what a test cannot run in this size, or no output at all
``not run: REASON`` not run; command lines are still parsed and their keys and values checked
==================  ===================================================================================================

The blocks of a page are run in their order in one folder. A block without a language, or text without a rule, is an error.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from marl_handover.cli import COMMANDS, PROGRAM, main, take_plugins
from marl_handover.compose import compose
from marl_handover.errors import HandoverError, UnknownKey
from marl_handover.plugins import added

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = ("python", "bash", "yaml", "text")
QUIET = ("source",)
"""Shell words that change nothing a test could see."""

_FENCE = re.compile(
    r"(?:<!-- test: (?P<rule>.*?) -->\n\n?)?^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<code>.*?)^(?P=indent)```$", re.M | re.S
)


class Block(NamedTuple):
    """A fenced block: where it stands, its language, its text, the words of its rule."""

    page: Path
    line: int
    language: str
    code: str
    words: tuple[str, ...]

    @property
    def where(self) -> str:
        """For messages."""
        return f"{self.page.relative_to(ROOT) if self.page.is_relative_to(ROOT) else self.page}:{self.line}"

    @property
    def excused(self) -> bool:
        """Whether it says why it is not run, or not compared."""
        return " ".join(self.words).startswith(("not run: ", "shown: "))

    @property
    def slow(self) -> bool:
        """Whether only the slow tests run it."""
        return "slow" in self.words

    def value(self, key: str) -> str:
        """The value of ``key=value`` among the words; empty if there is none."""
        return next((word.partition("=")[2] for word in self.words if word.startswith(f"{key}=")), "")

    @property
    def overrides(self) -> list[str]:
        """The settings that make the block short."""
        return [
            word.replace("{here}", os.getcwd()) for word in self.words if "=" in word and word.partition("=")[0] not in ("file", "status")
        ]

    def problem(self) -> str:
        """What is wrong with the block's language and rule; empty if nothing."""
        if self.language not in LANGUAGES:
            return f"language {self.language!r} is none of {', '.join(LANGUAGES)}"
        if self.excused:
            return "" if len(self.words) > 2 else "a reason is missing"
        known = {
            "python": {"slow", "alone"},
            "bash": {"slow", "output"},
            "yaml": set(),
            "text": {"output"},
        }[self.language]
        unknown = [word for word in self.words if "=" not in word and word not in known]
        if unknown:
            return f"unknown words: {' '.join(unknown)}"
        if self.overrides and self.language != "bash":
            return "settings are for bash"
        if self.language == "text" and "output" not in self.words:
            return "text needs a rule: output, or shown: REASON"
        return "a yaml block needs a rule: file=NAME" if self.language == "yaml" and not self.value("file") else ""


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        code = "".join(line[len(match["indent"]) :] for line in match["code"].splitlines(keepends=True))
        start = match.start("language")
        found.append(Block(page, text.count("\n", 0, start) + 1, match["language"], code, tuple((match["rule"] or "").split())))
    return found


def command_lines(block: Block) -> Iterator[list[str]]:
    """The words of each line of a bash block, without comments; continued lines are one."""
    for line in block.code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


def check_line(words: list[str]) -> None:
    """Raise unless the command exists and takes its keys and values."""
    command, *arguments = words[1:]
    module = importlib.import_module(COMMANDS[command].module)
    if arguments and "=" not in arguments[0] and hasattr(module, "POSITIONAL"):
        arguments = [f"{module.POSITIONAL}={arguments[0]}", *arguments[1:]]
    plugins, arguments = take_plugins(arguments)
    given = [argument for argument in arguments if argument != "--help" and not argument.startswith("debug=")]
    with added(plugins):
        assert isinstance(compose(module.SCHEMA, given, groups=module.GROUPS, aliases=module.ALIASES), module.SCHEMA)


def write_file(block: Block) -> None:
    """Write the block to the file that its rule names."""
    Path(block.value("file")).write_text(block.code, encoding="utf-8")


class Session:
    """Runs the blocks of one page, in their order, in the present folder."""

    def __init__(self) -> None:
        self.printed: str | None = None

    def run(self, block: Block) -> None:
        """Run, write or compare one block."""
        if block.language == "text":
            if self.printed is not None:
                assert matches(block.code, self.printed), f"{block.where}: expected\n{block.code}\nin what was printed:\n{self.printed}"
            return
        self.printed = None
        if block.value("file"):
            write_file(block)
        if block.language == "python" and not block.value("file"):
            self.printed = alone(["-c", block.code]) if "alone" in block.words else here(block)
        elif block.language == "bash":
            self.printed = self._lines(block)

    def skip(self) -> None:
        """A block was left out, so what follows it cannot be compared."""
        self.printed = None

    def _lines(self, block: Block) -> str:
        status, out, unused = int(block.value("status") or 0), "", set(block.overrides)
        for words in command_lines(block):
            if words[0] in QUIET:
                continue
            if words[0] == "python":
                out += alone(words[1:])
                continue
            assert words[0] == PROGRAM, f"{block.where}: only {PROGRAM} and python lines can be run, not {words[0]!r}; say not run: REASON"
            extra = [text for text in block.overrides if _knows(words, text)]
            unused -= set(extra)
            got, printed = command([*words[1:], *extra])
            assert got == status, f"{block.where}: {' '.join(words)} ended with {got}:\n{printed}"
            out += printed
        assert not unused, f"{block.where}: no line takes {' '.join(sorted(unused))}"
        return out


def _knows(words: list[str], override: str) -> bool:
    try:
        check_line([*words, override])
    except UnknownKey:
        return False
    except HandoverError:
        return True  # of a line that is to fail
    return True


def command(arguments: list[str]) -> tuple[int, str]:
    """Exit status of a command of ours, and what it printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(arguments)
    return status, printed.getvalue()


def here(block: Block) -> str:
    """Run a python block in this process; what it printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile("\n" * block.line + block.code, str(block.page), "exec"), {"__name__": "__main__"})
    return printed.getvalue()


def alone(arguments: list[str]) -> str:
    """Run Python in a process of its own; what it printed."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def matches(expected: str, printed: str) -> bool:
    """Whether ``expected`` stands in ``printed``, blanks at line ends apart; ``…`` stands for anything."""
    wanted, got = ("\n".join(line.rstrip() for line in text.strip("\n").splitlines()) for text in (expected, printed))
    return re.search(".*?".join(re.escape(part) for part in wanted.split("…")), got, re.S) is not None
