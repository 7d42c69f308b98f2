"""Whatever is read is a regular file of bounded size; whatever is written is whole or not there."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import read_bounded

OTHER_USER = 12345


def test_a_regular_file_is_read_up_to_its_limit_and_no_further(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5, "thing") == b"12345"
    with pytest.raises(CorruptFile, match="5 bytes, more than the 4"):
        read_bounded(path, 4, "thing")


def test_a_sparse_file_is_refused_by_its_size(tmp_path):
    path = tmp_path / "sparse"
    with path.open("wb") as stream:
        stream.truncate(10**13)
    with pytest.raises(CorruptFile, match="more than"):
        read_bounded(path, 1000, "thing")


def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    os.mkfifo("fifo")
    os.mkdir("folder")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        for name, kind in (("fifo", "a FIFO"), ("folder", "a folder"), ("socket", "No such device"), ("/dev/zero", "a device")):
            with pytest.raises(CorruptFile, match=kind):
                read_bounded(tmp_path / name, 1000, "thing")


def test_a_file_that_says_it_is_empty_is_bounded_too():
    with pytest.raises(CorruptFile, match="more than"):
        read_bounded(Path("/proc/self/maps"), 100, "thing")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MissingFile, match="thing not found: .*none"):
        read_bounded(tmp_path / "none", 10, "thing")


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_another_users_file_is_refused_where_ones_own_is_expected(tmp_path):
    path = tmp_path / "theirs"
    path.write_bytes(b"x")
    os.chown(path, OTHER_USER, OTHER_USER)
    assert read_bounded(path, 10, "thing") == b"x"
    with pytest.raises(CorruptFile, match=f"another user .{OTHER_USER}"):
        read_bounded(path, 10, "thing", own=True)


def test_a_link_is_refused_where_ones_own_is_expected(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to("file")
    assert read_bounded(tmp_path / "link", 10, "thing") == b"x"
    with pytest.raises(CorruptFile, match="symbolic link"):
        read_bounded(tmp_path / "link", 10, "thing", own=True)
