"""Random command lines over every key of every command, made from the schemas, all in one process. ``make fuzz`` runs 20,000 of them.

A line is right if it ends with 0, 1 or 2, without an internal error, within :data:`LIMIT_S` of computing and :data:`LIMIT_MB` of memory;
and a refusal, exit 2, is one line of at most 300 characters. What is valid is run for real where that is cheap: ``plan``, ``workspace``,
``doctor``, ``stop``, ``plot`` and small kinematic evaluations. Where hours would follow (training, simulations, the closed loop, servers),
the line ends after everything has been read, checked and built: see :data:`LONG_WORK`.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import random
import resource
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
import types
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints
from unittest import mock

from marl_handover import cli
from marl_handover.bounds import Bounds, bounds_of

LIMIT_S, LIMIT_MB, LONGEST = 30.0, 1500, 300
LONG_WORK = (
    "marl_handover.learning.trainer.Trainer.run",  # after the trainer was built: networks, replay memory, environments
    "marl_handover.experiments.tune.run_trials",  # after the study was opened
    "marl_handover.commands.compare._run_tasks",  # after every task was composed and checked
    "marl_handover.commands.simulate.play",  # after the cell was built in PyBullet
    "marl_handover.motion.planner.MotionPlanner.warm_up",  # of closed loops and motions: after the planner was built
    "marl_handover.commands.calibrate._camera",  # after the twin was built
    "marl_handover.commands.calibrate._servos",
    "marl_handover.commands.calibrate._grippers",
    "marl_handover.hardware.emulator.pty.turn",  # after the port was made
    "marl_handover.motion.path_length_table.build_table",  # of rewards for short paths: before the first path
    "marl_handover.viewer.server.open_server",  # before the server listens
    "marl_handover.report.figure_style.save_figure",  # after the figure was made
)
"""Where work that takes long begins: here a line has passed."""

NO_SETTINGS = ("", "=", "--help=", "a.b.c.d=1", "seed", "~seed=1", "+seed=1", "preset=smoke", "x" * 400, "k" * 20_000)
LISTS = ("[]", "[1]", "[1,2]", "[1,2,3]", "[nan,0,0]", "[[1,2],[3]]", f"[{'1,' * 3000}1]", "[" * 2000 + "]" * 2000, "[1,[2,[3]]]", "[1")
TREES = (
    "{}",
    "{a:1}",
    "{" + "a:{" * 60 + "}" * 61,
    "{x:[1,2]}",
    "{'':1}",
    "{1:2}",
    "null",
    "true",
    "''",
    '""',
    "",
    " ",
    "${a}",
    "${oc.env:HOME}",
)
WORDS = ("é", "\U0001f600", "\udcff", "a\x1b[31mb", "a\nb", "a,b", "a b", "x" * 300, "x" * 5000, "y" * 20_000)
QUOTES = ("'", '"', "\\", "a=b", "#", "%s", "{0}")
PLACES = ("/", "..", "../..", "~", "~nobody-here/x", "/proc/nowhere/x", "no/such/place.json", "shielded:exact", "a/" * 500)
"""Values that nobody would mean. No path here leads to a device: as root, a fault would replace it."""


class Passed(BaseException):
    """A valid line reached what takes long."""


class TooLong(BaseException):
    """A line computed beyond its limit."""


@dataclass(frozen=True)
class Key:
    """A setting of a command: dotted key, annotation, bounds."""

    name: str
    hint: Any
    bounds: Bounds


def keys_of(schema: type, groups: dict[str, dict[str, type]], prefix: str = "") -> Iterator[Key]:
    """Every key of a schema, those of all options of its groups too."""
    hints = get_type_hints(schema)
    for item in fields(schema):
        name, hint = f"{prefix}{item.name}", hints[item.name]
        yield Key(name, hint, bounds_of(item))
        own = [each for each in (hint, *get_args(hint)) if isinstance(each, type) and is_dataclass(each)]
        for section in [*groups.get(name, {}).values(), *own] if get_origin(hint) not in (list, dict) else ():
            yield from keys_of(section, groups, f"{name}.")
        if get_origin(hint) is dict and is_dataclass(get_args(hint)[1]):
            for entry in ("main", "left", "right", "elbow", "nobody"):
                yield from keys_of(get_args(hint)[1], {}, f"{name}.{entry}.")


def hostile_files(folder: Path) -> list[str]:
    """Files that somebody could give a command, made in ``folder``; their names."""
    layers = (f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9))
    laughs = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(layers)
    step = {"episode": 0, "step": 0, "state": [-120, -60, 0], "goal": [150, 60, 1], "arm": "L", "final": False, "place": [-44, 0]}
    line = json.dumps({**step, "next_state": [-44, 0, 0], "outcome": None, "epsilon_rad": 0.08, "refusal": None})
    texts = {
        "empty.yaml": "",
        "laughs.yaml": laughs,
        "loop.yaml": "a: &a\n  b: *a\n",
        "deep.yaml": "a: " + "[" * 5000,
        "list.yaml": "[1, 2]",
        "digits.yaml": "seed: " + "9" * 6000,
        "keys.yaml": "1: 2\nnull: 3\n? [1, 2]\n: 4\n",
        "deep.json": "[" * 100_000,
        "deep.jsonl": '{"a":' * 1000,
        "digits.jsonl": line.replace('"episode": 0', '"episode": 1' + "0" * 400),
        "trace.jsonl": line + "\n",
        "torn.jsonl": line + "\n" + line[:40],
        "shape.jsonl": line.replace("[-120, -60, 0]", "[[-120], {}]"),
        "nan.jsonl": line.replace("-120", "NaN"),
        "problem.jsonl": '{"state": [-120, -60, 0], "goal": [150, 60, 1]}\n',
        "plan.json": "{}",
        "none.npz": "PK",
        "arm.urdf": "<robot/>",
        "entity.urdf": '<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>',
        "binary.png": "\0\1\2",
    }
    for name, text in texts.items():
        (folder / name).unlink(missing_ok=True) if not (folder / name).is_dir() else shutil.rmtree(folder / name)
        (folder / name).write_text(text)
    with contextlib.suppress(FileExistsError):
        os.mkfifo(folder / "fifo.npz")
    (folder / "folder").mkdir(exist_ok=True)
    (folder / "folder" / "config.yaml").write_text("a: " + "[" * 5000)
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / "socket"))
    return [*texts, "fifo.npz", "folder", "socket"]


class Generator:
    """Makes command lines; the same seed makes the same."""

    def __init__(self, seed: int, files: list[str]) -> None:
        self.random = random.Random(seed)
        self.files = files
        self.keys: dict[str, list[Key]] = {}
        self.aliases: dict[str, list[str]] = {}
        for name, command in cli.COMMANDS.items():
            module: Any = importlib.import_module(command.module)
            self.keys[name] = list(keys_of(module.SCHEMA, module.GROUPS))
            self.aliases[name] = [*module.ALIASES, "preset", "debug"]

    def line(self) -> list[str]:
        """A command and one to four settings; most lines have one that is odd."""
        name = self.random.choice(list(self.keys))
        arguments = [self._argument(name) for _ in range(self.random.choice((1, 1, 1, 2, 2, 3, 4)))]
        return [name, *dict.fromkeys(argument for argument in arguments if argument is not None)]

    def _argument(self, command: str) -> str | None:
        keys = self.keys[command]
        if not keys or self.random.random() < 0.03:
            return self.random.choice(NO_SETTINGS)
        key = self.random.choice(keys)
        value = self._within(key) if self.random.random() < 0.45 else self._odd(key)
        name = self.random.choice(self.aliases[command]) if self.random.random() < 0.02 else key.name
        return None if name == "debug" else f"{name}={value}"

    def _within(self, key: Key) -> str:
        """A value that the key's own bounds allow."""
        hint, bounds, draw = key.hint, key.bounds, self.random
        if get_origin(hint) in (Union, types.UnionType):
            hint = next(each for each in get_args(hint) if each is not type(None))
        if bounds.choices:
            return str(draw.choice(list(bounds.choices)))
        if hint is bool:
            return draw.choice(("true", "false"))
        if get_origin(hint) is list:
            low, high = bounds.length
            return f"[{','.join(self._number(bounds) for _ in range(draw.randint(low, min(high, low + 3))))}]"
        if hint in (int, float):
            return self._number(bounds)
        if hint is str:
            return draw.choice((*self.files, "exact", "paper", "a", "new", "new.json", "new.png", "new.mp4", "pretrained_b", "greedy"))
        return "{}"

    def _number(self, bounds: Bounds) -> str:
        low, high = (bounds.low, bounds.high) if bounds.numeric else (0.0, 10.0)
        small = low + min(high - low, 10.0 if not bounds.whole else 20)
        value = self.random.choice((low, high, small, self.random.uniform(low, high), self.random.uniform(low, small)))
        return str(int(value)) if bounds.whole else repr(float(value))

    def _odd(self, key: Key) -> str:
        """A value that nobody would mean."""
        draw, bounds = self.random, key.bounds
        numbers = ["0", "-1", "1e12", "1e308", "-1e308", "nan", "inf", "-inf", "1e-320", "0.5", "2.5", "1" * 5000, "0x10", "1_000"]
        if bounds.numeric:
            step = 1 if bounds.whole else max(abs(bounds.low), abs(bounds.high), 1.0) * 1e-3
            numbers += [str(bounds.low - step), str(bounds.high + step), str(bounds.high), str(bounds.low)]
        paths = [*self.files, *PLACES]
        return draw.choice(draw.choice((numbers, LISTS, TREES, WORDS, QUOTES, paths)))


@dataclass
class Result:
    """How a line ended."""

    line: list[str]
    status: int | str
    faults: list[str]
    seconds: float
    stderr: str


def run_line(line: list[str]) -> Result:
    """Run one command line in this process, and judge it."""
    out, err, status, faults = io.StringIO(), io.StringIO(), "", []
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main(line)
    except Passed:
        status = "passed"
    except TooLong:
        faults.append(f"more than {LIMIT_S:g} s")
    except BaseException as error:
        faults.append(f"{type(error).__name__}: {str(error)[:200]} {''.join(traceback.format_tb(error.__traceback__)[-3:])}")
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    text, peak = err.getvalue(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if "internal error" in text or "Traceback" in text:
        faults.append("internal error")
    if isinstance(status, int) and status not in (0, 1, 2):
        faults.append(f"status {status}")
    if status == 2 and (text.count("\n") != 1 or len(text) > LONGEST):
        faults.append(f"a refusal of {text.count(chr(10))} lines and {len(text)} characters")
    if peak > max(before, LIMIT_MB * 1000):
        faults.append(f"{peak // 1000} MB")
    return Result(line, status, faults, time.process_time() - began, text)


@contextlib.contextmanager
def prepared(folder: Path) -> Iterator[None]:
    """Stand in ``folder``, away from this user's arms and caches, with long work stopped where it begins."""

    def passed(*_: Any, **__: Any) -> None:
        raise Passed

    def too_long(*_: Any) -> None:
        raise TooLong

    def small(rules: Any, act: Any, problems: Any, *rest: Any, **options: Any) -> Any:
        if len(problems[0]) > 50 or rules.config.max_steps > 50:
            raise Passed
        return real(rules, act, problems, *rest, **options)

    assessment: Any = importlib.import_module("marl_handover.control.evaluation")
    real = assessment.evaluate
    before, home = signal.signal(signal.SIGPROF, too_long), os.getcwd()
    with contextlib.ExitStack() as stack:
        stack.callback(os.chdir, home)
        stack.callback(signal.signal, signal.SIGPROF, before)
        for place in LONG_WORK:
            importlib.import_module(place.rsplit(".", 2)[0] if place.rsplit(".", 2)[1][:1].isupper() else place.rsplit(".", 1)[0])
            stack.enter_context(mock.patch(place, passed))
        stack.enter_context(mock.patch.object(assessment, "evaluate", small))
        for name in ("session_registry", "settings", "estop"):
            module = importlib.import_module(f"marl_handover.hardware.{name}")
            stack.enter_context(mock.patch.object(module, "user_path", lambda suffix: folder / f"user{suffix}"))
        stack.enter_context(mock.patch.dict(os.environ, {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        os.chdir(folder)
        yield


def fuzz(count: int, seed: int, told: io.TextIOBase | Any = None) -> tuple[list[Result], Counter[str]]:
    """Run ``count`` lines; those that are wrong, and how many ended how."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    wrong, ends = [], Counter[str]()
    try:
        with prepared(folder):
            generator = Generator(seed, hostile_files(folder))
            for number in range(count):
                if number % 100 == 0:
                    for path in folder.iterdir():
                        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
                    hostile_files(folder)
                result = run_line(generator.line())
                ends[str(result.status)] += 1
                if result.faults:
                    wrong.append(result)
                if told is not None and result.faults:
                    shown = [argument if len(argument) < 90 else f"{argument[:60]}..[{len(argument)}]" for argument in result.line]
                    print("WRONG", shown, result.faults, result.stderr[-400:], file=told, flush=True)
                if told is not None and number % 500 == 499:
                    print(f"{number + 1} lines, {len(wrong)} wrong", dict(ends), file=told, flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return wrong, ends


def main() -> int:
    """``fuzz_command_lines.py [COUNT [SEED]]``."""
    given = [int(text) for text in sys.argv[1:]]
    count, seed = (*given, *(20_000, 0)[len(given) :])
    began = time.time()
    wrong, ends = fuzz(count, seed, sys.stdout)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000
    print(f"{count} command lines, seed {seed}: {len(wrong)} wrong; ended {dict(ends)}; {time.time() - began:.0f} s, {memory} MB at most")
    return bool(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
