"""The command line's own manners: speed of ``--help``, one line for each error, exit statuses."""

from __future__ import annotations

import re
import subprocess
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import pytest

from marl_handover import cli
from marl_handover.errors import InvalidSetting, MissingExtra, WorkFailed, by_extra, install_line, name_of, requirements

ROOT = Path(__file__).resolve().parent.parent


@dataclass
class ToyConfig:
    seed: int = 0  # of the random generator
    what: str = "nothing"


def act(config: ToyConfig) -> int:
    failures = {
        "limit": InvalidSetting("seed", config.seed, "positive"),
        "work": WorkFailed("the work\nfailed"),
        "bug": ValueError("two\nlines"),
        "stop": KeyboardInterrupt(),
    }
    if config.what in failures:
        raise failures[config.what]
    print(f"seed {config.seed}")
    return 0


@pytest.fixture
def toy(monkeypatch):
    module = types.ModuleType("toy_command")
    module.SCHEMA, module.ALIASES, module.GROUPS, module.run = ToyConfig, {"s": "seed"}, {}, act
    monkeypatch.setitem(sys.modules, "toy_command", module)
    monkeypatch.setitem(cli.COMMANDS, "toy", cli.Command("a toy", "toy_command"))


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["help"]])
def test_help_lists_the_commands(arguments, capsys):
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in cli.COMMANDS)


def test_help_imports_nothing_heavy():
    heavy = {"torch", "torchrl", "hydra", "matplotlib"}
    code = f"import sys; from marl_handover.cli import main; main(['--help']); print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_no_command_and_unknown_command(capsys):
    assert cli.main([]) == 2
    assert "usage" in capsys.readouterr().err
    assert cli.main(["evalute", "seed=1"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("marl-handover: unknown command 'evalute'; did you mean 'evaluate'? commands: doctor")
    assert err.count("\n") == 1


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("marl-handover ")


def test_a_command_runs_with_its_settings(toy, capsys):
    assert cli.main(["toy", "s=3"]) == 0
    assert capsys.readouterr().out == "seed 3\n"
    assert cli.main(["toy", "--help"]) == 0
    out = capsys.readouterr().out
    assert "a toy" in out
    assert "s = seed" in out
    assert "of the random generator" in out


@pytest.mark.parametrize(
    ("argument", "status", "message"),
    [
        ("what=limit", 2, "seed = 0: must be positive"),
        ("what=work", 1, "the work failed"),
        ("what=bug", 1, "internal error: ValueError: two lines; run again with debug=true to see where"),
        ("what=stop", 130, "interrupted"),
        ("sed=1", 2, "unknown key 'sed'; valid keys: seed, what, s, preset"),
        ("seed=x", 2, "cannot read 'seed=x': Value 'x' of type 'str' could not be converted to Integer"),
        ("--seed=1", 2, "cannot read '--seed=1': options are written key=value, without dashes; see --help"),
        ("debug=maybe", 2, "cannot read 'debug=maybe': debug is true or false"),
    ],
)
def test_errors_are_one_line(toy, capsys, argument, status, message):
    assert cli.main(["toy", argument]) == status
    assert capsys.readouterr().err == f"marl-handover toy: {message}\n"


@pytest.mark.parametrize(("what", "error"), [("limit", InvalidSetting), ("bug", ValueError), ("stop", KeyboardInterrupt)])
def test_debug_lets_errors_through(toy, what, error):
    with pytest.raises(error):
        cli.main(["toy", f"what={what}", "debug=true"])
    assert cli.main(["toy", f"what={what}", "debug=true", "debug=false"]) in (1, 2, 130)


def test_a_reader_that_leaves():
    code = (
        "import sys, types; from dataclasses import dataclass; from marl_handover import cli\n"
        "Config = dataclass(type('Config', (), {}))\n"
        "m = types.ModuleType('m'); m.SCHEMA, m.ALIASES, m.GROUPS, m.run = Config, {}, {}, lambda c: print('x' * 10**6) or 0\n"
        "sys.modules['m'] = m; cli.COMMANDS['toy'] = cli.Command('', 'm'); sys.exit(cli.main(['toy']))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141


def test_doctor(capsys, monkeypatch):
    from marl_handover.commands import doctor

    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("python", "torch", "compiler", "cameras", "serial ports", "[dev]"))
    assert "pip install marl_handover" not in out
    assert "pip install 'marl_handover" not in out
    monkeypatch.setattr(doctor, "requirements", lambda: {"": ("numpy>=2", "no-such-package>=1; python_version > '3'")})
    assert cli.main(["doctor"]) == 1
    assert "missing: no-such-package" in capsys.readouterr().out


def test_no_message_tells_to_install_this_package_from_an_index_that_has_it_not():
    """What is missing is named with the versions that are needed."""
    for path in (ROOT / "marl_handover").rglob("*.py"):
        assert not re.search(r"pip install ['\"\\]*marl[_-]handover", path.read_text(encoding="utf-8")), path
    assert install_line("view") == "pip install 'viser>=1.1'"
    assert str(MissingExtra("view", "viser", "view")).endswith("run: pip install 'viser>=1.1'")
    assert "'pandas>=2.2.3,<3'" in install_line("compare")
    assert install_line("no-such-extra", ["something"]) == "pip install something"


def test_metadata_and_pyproject_tell_the_same_requirements():
    lines = ["numpy>=2", "viser>=1.1; extra == 'view'", 'pandas<3,>=2.2; extra == "compare"']
    assert by_extra(lines) == {"": ("numpy>=2",), "view": ("viser>=1.1",), "compare": ("pandas<3,>=2.2",)}
    assert {name_of(line) for line in requirements()["compare"]} == {"rliable", "pandas"}


def test_python_m_runs_the_command_line():
    done = subprocess.run([sys.executable, "-m", "marl_handover", "--version"], capture_output=True, text=True, env=_with_root())
    assert (done.returncode, done.stdout.split()[0]) == (0, "marl-handover")


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_scripts_are_the_same_entry_points(name):
    text = (ROOT / "scripts" / f"{name}.py").read_text()
    assert f'main(["{name}", *sys.argv[1:]])' in text
    assert len(text.splitlines()) <= 30


def test_a_script_runs():
    done = subprocess.run(
        [sys.executable, "scripts/doctor.py", "--help"], capture_output=True, text=True, cwd=ROOT, check=True, env=_with_root()
    )
    assert "usage: marl-handover doctor" in done.stdout


def _with_root() -> dict[str, str]:
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT)}
