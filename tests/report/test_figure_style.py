"""Results are written whole or not at all."""

from __future__ import annotations

import subprocess
import sys

import pytest
from matplotlib.figure import Figure

from marl_handover.errors import CannotWrite, CorruptFile, InvalidSetting, MissingFile
from marl_handover.parsing import read_json
from marl_handover.report.figure_style import require_picture, save_figure, write_json


@pytest.mark.parametrize("name", ["a.png", "a.pdf", "a.SVG", "new/folder/a.png"])
def test_pictures_by_suffix(tmp_path, name):
    figure = Figure(figsize=(1, 1))
    figure.add_subplot()
    save_figure(figure, tmp_path / name)
    start = (tmp_path / name).read_bytes()[:5]
    assert start in (b"\x89PNG\r", b"%PDF-", b"<?xml")
    assert not list(tmp_path.rglob("*.tmp"))


def test_other_suffixes_and_folders_are_refused(tmp_path):
    with pytest.raises(InvalidSetting, match="ends in .png, .pdf or .svg"):
        require_picture("out", "a.gif")
    (tmp_path / "a.png").mkdir()
    with pytest.raises(CannotWrite, match=r"a\.png cannot be written: it is a folder"):
        save_figure(Figure(), tmp_path / "a.png")
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="file cannot be written"):
        write_json(tmp_path / "file" / "a.json", {})


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    assert read_json(path, "plan") == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_reading_json(tmp_path):
    with pytest.raises(MissingFile):
        read_json(tmp_path / "none.json", "plan")
    for text in ("[1]", "{", ""):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(CorruptFile):
            read_json(tmp_path / "a.json", "plan")


WRITER = """
import sys
from pathlib import Path
from marl_handover.files import write_whole
for _ in range(300):
    write_whole(Path(sys.argv[1]), sys.argv[2] * 5000)
"""


def test_two_processes_that_write_one_file_leave_one_of_both_wholly(tmp_path):
    path = tmp_path / "a.txt"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), letter]) for letter in "ab"]
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            assert path.read_text() in ("a" * 5000, "b" * 5000)
    assert [writer.returncode for writer in writers] == [0, 0]
    assert list(tmp_path.iterdir()) == [path]
