"""The command line: ``marl-handover COMMAND [key=value ...]``.

This module imports nothing heavy, so that ``--help`` answers at once; a command's module is imported when that command runs.
"""

from __future__ import annotations

import difflib
import importlib
import io
import os
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

from marl_handover.errors import BadOverride, HandoverError, exit_status_of, shortened, shown

PROGRAM = "marl-handover"
LONGEST_LINE = 300
"""Characters of the line that refuses bad input, its end included."""
EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 1, 2, 130, 141


class Command(NamedTuple):
    """Where a command lives. The module also offers ``SCHEMA``, ``ALIASES``, ``GROUPS``, and ``POSITIONAL``: the key of a bare first word.

    ``first`` names a module whose ``at_once(arguments)`` is called before anything else is imported; the function gets what it returned as
    a second argument.
    """

    summary: str
    module: str
    function: str = "run"
    first: str = ""


COMMANDS: dict[str, Command] = {
    "doctor": Command(
        "versions, devices, cameras and serial ports; what is missing and how to install it", "marl_handover.commands.doctor"
    ),
    "workspace": Command("the cell's grid, annulus fit and chart, as JSON and a picture", "marl_handover.commands.workspace"),
    "robot": Command("how a URDF is read as an arm: roles of its joints, ring, gripper, what was assumed", "marl_handover.commands.robot"),
    "plan": Command("solve one problem: the sequence, its cost and every intermediate pose", "marl_handover.commands.plan"),
    "train": Command("train a supervisor into a run directory", "marl_handover.commands.train"),
    "evaluate": Command("play episodes with a policy: table, JSON, trace", "marl_handover.commands.evaluate"),
    "compare": Command("a suite of runs over seeds: statistics, tables, figures", "marl_handover.commands.compare"),
    "tune": Command("search for better settings of training, as an Optuna study", "marl_handover.commands.tune"),
    "simulate": Command("play episodes in simulated physics: text, MP4 or GIF", "marl_handover.commands.simulate"),
    "calibrate": Command("camera and servos of a cell, or of its twin: measured, saved and checked", "marl_handover.commands.calibrate"),
    "run": Command("the closed loop on hardware or its twin; dry_run=true moves nothing", "marl_handover.commands.run"),
    "stop": Command(
        "stop all arms, and keep them stopped until clear=true", "marl_handover.commands.stop", first="marl_handover.commands.stop_now"
    ),
    "emulate": Command("a servo controller on a pseudo-terminal, with faults if wanted", "marl_handover.commands.emulate"),
    "view": Command("the cell in a browser: to play with, a trace, a session", "marl_handover.commands.view"),
    "plot": Command("a figure of a run, a trace or a cell", "marl_handover.commands.plot"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 1 the work failed, 2 bad input, 130 interrupted, 141 the reader of a pipe left.

    ``debug=true`` among the arguments lets every exception through, with its traceback.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without some letter, a path of other bytes: shown by their codes
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:2], "--help"]
    name = arguments[0] if arguments else None
    if name is None or name in ("--help", "-h"):
        print(_overview(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else EXIT_BAD_INPUT
    if name == "--version":
        print(f"{PROGRAM} {_version()}")
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        return _fail(PROGRAM, f"unknown command {shown(name, 30)}; {hint}commands: {', '.join(COMMANDS)}", EXIT_BAD_INPUT)
    return _guarded(name, arguments[1:])


def _guarded(name: str, arguments: list[str]) -> int:
    """Run a known command; every exception becomes one line and an exit status."""
    speaker, debug = f"{PROGRAM} {name}", False
    try:
        debug, arguments = _take_debug(arguments)
        status = _dispatch(name, arguments)
        sys.stdout.flush()  # here, so that a closed pipe shows itself inside this try
        return status
    except BrokenPipeError:
        # The interpreter flushes stdout once more on its way out; let that go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        if debug:
            raise
        return _fail(speaker, "interrupted", EXIT_INTERRUPTED)
    except HandoverError as error:
        if debug:
            raise
        return _fail(speaker, str(error), error.exit_status)
    except OSError as error:
        if debug:
            raise
        name = error.filename or ("standard output" if _output_lost() else "a file")
        return _fail(speaker, f"cannot read or write {name}: {error.strerror or error}", exit_status_of(error))
    except Exception as error:
        if debug:
            raise
        return _fail(speaker, f"internal error: {type(error).__name__}: {error}; run again with debug=true to see where", EXIT_FAILED)


def _output_lost() -> bool:
    """Whether what was printed cannot be written; then nothing more is tried, as the interpreter would on its way out."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _dispatch(name: str, arguments: list[str]) -> int:
    command = COMMANDS[name]
    begun = (importlib.import_module(command.first).at_once(arguments),) if command.first else ()
    from marl_handover.progress import working  # after that: a stop waits for nothing

    with working("loading the libraries", logged=False):
        module: Any = importlib.import_module(command.module)
    from marl_handover.plugins import added

    plugins, arguments = take_plugins(arguments)
    with added(plugins):
        return _run(command, module, name, arguments, begun)


def _run(command: Command, module: Any, name: str, arguments: list[str], begun: tuple[Any, ...]) -> int:
    from marl_handover.compose import compose
    from marl_handover.progress import showing
    from marl_handover.schema import keys_help

    if any(argument in ("--help", "-h") for argument in arguments):
        print(f"usage: {PROGRAM} {name} [key=value ...]\n\n{command.summary}\n\n{keys_help(module.SCHEMA, module.ALIASES, module.GROUPS)}")
        return 0
    if arguments and "=" not in arguments[0] and not arguments[0].startswith("-") and hasattr(module, "POSITIONAL"):
        arguments = [f"{module.POSITIONAL}={arguments[0]}", *arguments[1:]]
    for argument in arguments:
        if argument.startswith("-"):
            raise BadOverride(argument, "options are written key=value, without dashes; see --help")
    config = compose(module.SCHEMA, arguments, groups=module.GROUPS, aliases=module.ALIASES)
    with showing(getattr(config, "progress", True)):
        return int(getattr(module, command.function)(config, *begun))


def _take_debug(arguments: list[str]) -> tuple[bool, list[str]]:
    """``debug=...`` is a key of every command and of no schema: take it out. The last one counts."""
    debug, rest = False, []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if key != "debug" or not equals:
            rest.append(argument)
        elif value.lower() in ("true", "false"):
            debug = value.lower() == "true"
        else:
            raise BadOverride(argument, "debug is true or false")
    return debug, rest


def take_plugins(arguments: list[str]) -> tuple[list[str], list[str]]:
    """``plugins=FILE.py``, or ``plugins=[ONE.py,OTHER.py]``, is a key of every command too: take the files out."""
    given = [argument.partition("=")[2].strip("[]").split(",") for argument in arguments if argument.startswith("plugins=")]
    paths = [path.strip() for files in given for path in files if path.strip()]
    return paths, [argument for argument in arguments if not argument.startswith("plugins=")]


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND [key=value ...]",
            "",
            *lines,
            "",
            f"{PROGRAM} COMMAND --help shows a command's keys and defaults; debug=true shows the traceback of an error.",
            "plugins=FILE.py adds algorithms, policies, backends and layouts of your own, which that file registers.",
        ]
    )


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("marl_handover")
    except PackageNotFoundError:
        return "(not installed)"


def _fail(speaker: str, message: str, status: int) -> int:
    """Print ``message`` as one line on stderr, and pass ``status`` on. Bad input is told briefly: whoever sent it may have sent much."""
    line = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in " ".join(message.split()))
    print(f"{speaker}: {shortened(line, LONGEST_LINE - len(speaker) - 3) if status == EXIT_BAD_INPUT else line}", file=sys.stderr)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
