"""Whatever is read is a regular file of bounded size; whatever is written is whole or not there."""

from __future__ import annotations

import errno
import json
import logging
import os
import resource
import select
import socket
import stat
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from marl_handover.errors import CannotWrite, CorruptFile, MissingFile
from marl_handover.files import GrowingFile, copy_whole, keep, read_bounded, read_lines, remove_temporaries, replacing, write_whole, writing

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


@contextmanager
def room_for(size_bytes):
    """No file may become larger, as on a disk that is full then."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_link_stays_one_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to("elsewhere/file")
    for text in ("made", "replaced"):  # the first time it leads nowhere
        write_whole(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "elsewhere/file").read_text() == text
    assert names(tmp_path / "elsewhere") == ["file"]


@pytest.mark.parametrize("device", ["/dev/null", "made"])
def test_a_device_is_written_to_and_stays_one(tmp_path, device):
    path = Path(device)
    if device == "made":
        path = tmp_path / "null"
        try:
            os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
            path.write_text("")
        except PermissionError:
            pytest.skip("no devices can be made here")
    write_whole(path, "text")
    assert stat.S_ISCHR(path.stat().st_mode)
    GrowingFile(path, fresh=True).write("line\n")
    assert stat.S_ISCHR(path.stat().st_mode)


def test_a_fifo_gets_it_all_and_one_without_a_reader_is_refused(tmp_path):
    path = tmp_path / "fifo"
    os.mkfifo(path)
    with pytest.raises(CannotWrite, match="nobody reads"):
        write_whole(path, "text")
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    thread = threading.Thread(target=lambda: write_whole(path, "x" * 1_000_000))
    thread.start()
    select.select([reader], [], [], 60)
    os.set_blocking(reader, True)
    with os.fdopen(reader, "rb") as stream:
        assert len(stream.read()) == 1_000_000
    thread.join()
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert names(tmp_path) == ["fifo"]


def test_standard_output_stays_where_a_shell_sent_it(tmp_path):
    code = (
        "from pathlib import Path; from marl_handover.files import GrowingFile, write_whole\n"
        "here = Path('/dev/stdout'); print('before'); write_whole(here, 'whole\\n'); GrowingFile(here).write('line\\n'); print('after')"
    )
    with (tmp_path / "out").open("w") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert (tmp_path / "out").read_text() == "before\nwhole\nline\nafter\n"


@pytest.mark.parametrize("where", ["folder", "none/file", "file/below", "socket"])
def test_what_cannot_be_written_is_named_and_bad_input(tmp_path, monkeypatch, where):
    monkeypatch.chdir(tmp_path)
    os.mkdir("folder")
    Path("file").write_text("mine")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        for write in (write_whole, lambda path, text: GrowingFile(path)):
            with pytest.raises(CannotWrite, match=where) as refused:
                write(Path(where), "text")
            assert refused.value.exit_status == 2
    assert names(tmp_path) == ["file", "folder", "socket"]


WRITERS = {
    "text": lambda path: write_whole(path, "x" * 5000),
    "bytes": lambda path: write_whole(path, bytes(5000)),
    "arrays": lambda path: _write(path, lambda stream: np.savez(stream, a=np.zeros(5000))),
    "packed": lambda path: _write(path, lambda stream: np.savez_compressed(stream, a=np.random.default_rng(0).random(5000))),
    "tensors": lambda path: _write(path, lambda stream: torch.save({"a": torch.zeros(5000)}, stream)),
    "copy": lambda path: copy_whole(Path(sys.executable), path),
}


def _write(path, save):
    with writing(path) as stream:
        save(stream)


@pytest.mark.parametrize("writer", WRITERS)
def test_without_room_the_old_file_stays_and_nothing_else_does(tmp_path, writer):
    path = tmp_path / "file"
    path.write_text("old")
    with room_for(3000), pytest.raises(CannotWrite, match=r"/file cannot be written: File too large") as full:
        WRITERS[writer](path)
    assert (full.value.exit_status, full.value.errno) == (1, errno.EFBIG)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["file"]
    WRITERS[writer](path)
    assert path.stat().st_size > 3000


def test_a_full_device_is_named():
    for write in (lambda: write_whole(Path("/dev/full"), "x"), lambda: GrowingFile(Path("/dev/full")).write("x\n")):
        with pytest.raises(CannotWrite, match="/dev/full cannot be written: No space") as full:
            write()
        assert full.value.exit_status == 1


def test_an_error_of_the_caller_leaves_the_old_file_and_is_his_own(tmp_path):
    (tmp_path / "file").write_text("old")

    def write():
        with writing(tmp_path / "file") as stream:
            stream.write(b"new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write()
    assert (tmp_path / "file").read_text() == "old"
    assert names(tmp_path) == ["file"]


def test_what_a_killed_process_had_begun_is_removed_and_nothing_else(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from marl_handover.files import replacing\n"
        "with replacing(Path(sys.argv[1]), '.mp4'): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "film.mp4")], check=False)
    for name in ("mine.tmp", "notes.txt.tmp", "checkpoint.pt"):
        (tmp_path / name).write_text("mine")
    assert len(names(tmp_path)) == 4
    remove_temporaries(tmp_path)
    assert names(tmp_path) == ["checkpoint.pt", "mine.tmp", "notes.txt.tmp"]


def test_a_long_name_has_room_for_its_temporary(tmp_path):
    write_whole(tmp_path / ("ä" * 120), "text")
    with replacing(tmp_path / ("x" * 255), suffix=".mp4") as temporary:
        temporary.write_text("text")
    assert len(names(tmp_path)) == 2


def test_what_is_kept_is_whole_or_not_there(tmp_path):
    (tmp_path / "file").write_bytes(bytes(5000))
    with room_for(3000), pytest.raises(CannotWrite, match=r"\.bak"):
        keep(tmp_path / "file")
    assert names(tmp_path) == ["file"]


def test_a_line_without_room_is_taken_back(tmp_path):
    file = GrowingFile(tmp_path / "log", fresh=True)
    file.write("a" * 99 + "\n")
    with room_for(150), pytest.raises(CannotWrite, match="log cannot be written: File too large"):
        file.write("b" * 99 + "\n")
    file.write("c\n")
    file.close()
    file.close()
    assert (tmp_path / "log").read_text() == "a" * 99 + "\nc\n"


def test_lines_are_read_to_the_last_whole_one_wherever_the_file_was_cut(tmp_path, caplog):
    rows = [{"number": number, "text": "naïve"} for number in range(3)]
    content = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows).encode()
    ends = [0, *(at + 1 for at, byte in enumerate(content) if byte == 10)]
    path = tmp_path / "log"
    for cut in range(len(content) + 1):
        path.write_bytes(content[:cut])
        caplog.clear()
        complete = max(number for number, end in enumerate(ends) if end <= cut)
        lacks_its_end_only = cut + 1 in ends[1:]
        if cut and not complete and not lacks_its_end_only:
            with pytest.raises(CorruptFile, match="line 1 "):
                list(read_lines(path, 1000, "log", json.loads))
            continue
        with caplog.at_level(logging.WARNING):
            found = [row for _, row in read_lines(path, 1000, "log", json.loads)]
        assert found == rows[: complete + lacks_its_end_only]
        assert bool(caplog.records) == (complete > 0 and cut not in ends and not lacks_its_end_only)
        assert all(f"cut off in line {complete + 1}" in record.getMessage() for record in caplog.records)


def test_a_damaged_line_before_the_last_is_an_error(tmp_path):
    (tmp_path / "log").write_text('{"a": 1}\n{"a": \n{"a": 3}\n')
    with pytest.raises(CorruptFile, match="line 2 "):
        list(read_lines(tmp_path / "log", 1000, "log", json.loads))
