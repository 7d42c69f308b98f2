"""What a machine is like beside the product: terminals, fonts, backends, names of files. Each works, or says one line."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
import tempfile
from dataclasses import fields
from pathlib import Path

import matplotlib
import pytest
from matplotlib.figure import Figure

import marl_handover
from marl_handover import cli, progress
from marl_handover.commands import calibrate, compare, evaluate, plan, run, simulate, train, tune, view
from marl_handover.files import cache_folder
from marl_handover.report.figure_style import save_figure


def _marl_handover(folder, *arguments, **env):
    command = [sys.executable, "-m", "marl_handover.cli", *arguments]
    keep = {key: value for key, value in os.environ.items() if key not in ("PYTHONIOENCODING", "MPLBACKEND")}
    return subprocess.run(command, capture_output=True, cwd=folder, env={**keep, **env}, check=False)


def test_a_terminal_without_some_letters_shows_their_codes(tmp_path):
    done = _marl_handover(tmp_path, "workspace", "out=é", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"written: \xe9/workspace.json" in done.stdout
    assert (tmp_path / "é" / "workspace.png").is_file()


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "TkAgg", "nonsense"])
def test_a_backend_that_a_notebook_handed_down_does_not_matter(tmp_path, backend):
    done = _marl_handover(tmp_path, "plan", "goal=[150,60,90]", "picture=p.png", MPLBACKEND=backend)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "p.png").is_file()


def test_names_of_files_may_have_other_bytes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    trace, picture = (os.fsdecode(name) for name in (b"t\xff.jsonl", b"p\xff.png"))
    assert cli.main(["evaluate", "episodes=2", "progress=false", f"trace={trace}"]) == 0
    assert cli.main(["plot", "kind=errors", f"trace={trace}", f"out={picture}"]) == 0
    assert sorted(os.listdir(bytes(tmp_path))) == [b"p\xff.png", b"t\xff.jsonl"]
    capsys.readouterr()


def test_text_is_never_set_by_latex(tmp_path, monkeypatch):
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)
    monkeypatch.setenv("PATH", "")
    figure = Figure()
    figure.subplots().set_title("50 % of a_b")
    save_figure(figure, tmp_path / "p.png")
    assert (tmp_path / "p.png").is_file()


@pytest.mark.parametrize("module", [calibrate, compare, evaluate, plan, run, simulate, train, tune, view])
def test_progress_is_a_key_of_every_command_that_shows_it(module):
    assert "progress" in {item.name for item in fields(module.SCHEMA)}


def test_without_progress_nothing_is_shown(capsys, monkeypatch):
    monkeypatch.setattr(progress, "QUIET_S", 0.0)
    for shown in (False, True):
        with progress.showing(shown), progress.working("counting"):
            for _ in progress.Bar(range(3), desc="bar"):
                pass
        said = capsys.readouterr().err
        assert ("bar" in said) == ("counting" in said) == shown


def test_an_account_without_a_home_keeps_its_caches_among_temporary_files_of_its_own(tmp_path, monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = cache_folder()
    assert (folder.parent, stat.S_IMODE(folder.stat().st_mode)) == (tmp_path, 0o700)
    assert cache_folder() == folder
    folder.chmod(0o777)  # a stranger could put tables there
    assert cache_folder() != folder


def test_nobody_else_asks_for_the_home_folder():
    package = Path(marl_handover.__file__).parent
    found = {str(path.relative_to(package)) for path in package.rglob("*.py") if re.search(r"Path\.home\(|expanduser\(", path.read_text())}
    assert found == {"files.py"}
