"""Reading files of bounded size, writing them so that nothing is ever half written, and where those lie that travel with the package."""

from __future__ import annotations

import errno
import io
import logging
import math
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from marl_handover.errors import CannotWrite, CorruptFile, InvalidSetting, MissingFile

if TYPE_CHECKING:
    from numpy.typing import NDArray


LOG = logging.getLogger(__name__)
_PACKAGE = Path(__file__).resolve().parent
Parsed = TypeVar("Parsed")

MEGABYTE = 1_000_000
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}

_TEMPORARY = re.compile(r"(\.\d+(-[0-9a-f]{8})?|^checkpoint\.pt)\.tmp(\.\w+)?$")
"""Names that :func:`temporary_of` gives, and those that version 0.1 gave."""


def expanded(text: str | Path) -> Path:
    """A path that a user gave, a leading ``~`` or ``~name`` replaced by that home folder.

    Raises:
        InvalidSetting: no such home is known.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise InvalidSetting("path", str(text), "written out: no such home folder is known") from error


def cache_folder() -> Path:
    """Where this user's caches are kept: ``$XDG_CACHE_HOME/marl_handover``, ``~/.cache/marl_handover``, or among temporary files.

    The last is for accounts without a home folder; it is theirs alone, and where it is not, a new one is made for this process.
    """
    chosen = os.environ.get("XDG_CACHE_HOME")
    if not chosen:
        with suppress(RuntimeError):
            chosen = str(Path.home() / ".cache")
    if chosen:
        return Path(chosen, "marl_handover")
    folder = Path(tempfile.gettempdir(), f"marl_handover-{os.geteuid()}")
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
    about = os.lstat(folder)
    own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid() and not about.st_mode & 0o022
    return folder if own else Path(tempfile.mkdtemp(prefix="marl_handover-"))


@contextmanager
def open_bounded(path: Path, limit_bytes: int, what: str, own: bool = False) -> Iterator[BinaryIO]:
    """A file opened for reading, once it is known to be a regular file of at most ``limit_bytes``; nothing else is waited for or read.

    Args:
        path: of the file.
        limit_bytes: its largest size.
        what: what it should be, for errors: "policy file", say.
        own: it must belong to this process's user, and be no symbolic link: for folders that others may write to.

    Raises:
        MissingFile: there is no such file.
        CorruptFile: it is no regular file, too large, another user's, or cannot be opened.
    """
    # Without O_NONBLOCK, opening a FIFO waits for somebody who writes to it.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (os.O_NOFOLLOW if own else 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError as error:
        raise MissingFile(what, path) from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        link = own and path.is_symlink()
        raise CorruptFile(what, path, "it is a symbolic link" if link else getattr(error, "strerror", None) or str(error)) from error
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise CorruptFile(what, path, f"it is {KINDS.get(stat.S_IFMT(about.st_mode), 'something else')}, not a regular file")
        if own and about.st_uid != os.geteuid():
            raise CorruptFile(what, path, f"it belongs to another user ({about.st_uid})")
        if about.st_size > limit_bytes:
            raise _too_large(what, path, about.st_size, limit_bytes)
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            yield stream
    finally:
        os.close(descriptor)


def read_bounded(path: Path, limit_bytes: int, what: str, own: bool = False) -> bytes:
    """What a regular file of at most ``limit_bytes`` holds. Arguments and errors as of :func:`open_bounded`."""
    with open_bounded(path, limit_bytes, what, own) as stream:
        try:
            content = stream.read(limit_bytes + 1)
        except OSError as error:
            raise CorruptFile(what, path, error.strerror or str(error)) from error
    if len(content) > limit_bytes:  # it grew meanwhile, or is of those in /proc that say they are empty
        raise _too_large(what, path, len(content), limit_bytes)
    return content


def read_arrays(path: Path, limit_bytes: int, what: str) -> dict[str, NDArray[Any]]:
    """The arrays of a ``.npz`` file, whose checksums are compared; no pickled objects are read. Arguments as of :func:`open_bounded`.

    Raises:
        MissingFile, CorruptFile: as there; and it is damaged, none, or would take more than ``limit_bytes`` of memory.
    """
    import numpy as np  # here: a stop writes a file, and must not wait for numpy

    with open_bounded(path, limit_bytes, what) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                _require_small(archive, limit_bytes)
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as file:
                return {key: file[key] for key in file.files}
        except Exception as error:  # numpy and zip raise many kinds
            large = isinstance(error, OverflowError)
            raise CorruptFile(what, path, str(error) if large else "it is damaged, or holds no arrays") from error


def _require_small(archive: zipfile.ZipFile, limit_bytes: int) -> None:
    """Raise for an archive that is large when unpacked, or whose arrays say that they are larger than they are."""
    import numpy as np

    unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > limit_bytes:
        raise OverflowError(f"it unpacks to {unpacked} bytes, more than the {limit_bytes} that it may have")
    for member in archive.infolist():
        with archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, kind = read(stream)
        if math.prod(shape) * kind.itemsize > member.file_size:  # numpy would take that much memory before it reads
            raise ValueError(f"{member.filename} is cut off")


def _too_large(what: str, path: Path, size_bytes: int, limit_bytes: int) -> CorruptFile:
    return CorruptFile(what, path, f"it has {size_bytes} bytes, more than the {limit_bytes} that it may have")


class _RememberingFile(io.FileIO):
    """Remembers why it could not be written: libraries that write to it tell of a full disk in words of their own, or as another error."""

    error: OSError | None = None

    def write(self, content: Any) -> int:
        try:
            return super().write(content)
        except OSError as error:
            self.error = error
            raise


@contextmanager
def writing(path: Path, durable: bool = True) -> Iterator[BinaryIO]:
    """A stream for what is to be in ``path`` when the block has ended without an error; see :func:`replacing`."""
    with replacing(path, durable=durable) as temporary, _RememberingFile(temporary, "wb") as file:
        try:
            with io.BufferedWriter(file) as stream:
                yield stream
        except Exception as error:
            raise file.error or error from error


@contextmanager
def replacing(path: Path, suffix: str = "", durable: bool = True) -> Iterator[Path]:
    """A new empty file to write to, which is put in the place of ``path`` when the block ends without an error, and else is removed.

    A reader sees the old file or the new one, never half of it; of two writers, the later one's. A symbolic link stays one: what it leads
    to is replaced. What exists and is no regular file is written to instead: the standard output, a device such as ``/dev/null``, a FIFO.

    Args:
        path: its folder exists.
        suffix: of the new file's name, for libraries that look at it.
        durable: whether it has to outlive a loss of power.

    Raises:
        CannotWrite: for every :class:`OSError` of the block, and of what comes before and after.
    """
    temporary = None
    try:
        straight = _written_straight(path)
        target = Path(os.path.realpath(path))
        temporary = temporary_of(Path(tempfile.gettempdir(), target.name) if straight else target, suffix)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
        yield temporary
        if straight:
            _pour(temporary, path)
        else:
            if durable:
                _to_disk(temporary)
            temporary.replace(target)
    except (CannotWrite, BrokenPipeError):  # whoever read our output has left, which is no fault
        raise
    except OSError as error:
        raise CannotWrite(path, error) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def write_whole(path: Path, content: str | bytes, durable: bool = True) -> None:
    """Write a file as :func:`replacing` does. Raises :class:`CannotWrite`."""
    with writing(path, durable) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, if it is not there. Raises :class:`CannotWrite`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CannotWrite(path, error) from error


def write_together(contents: Mapping[Path, str]) -> None:
    """Write files that are wrong without each other: all have room before the first is replaced. Raises :class:`CannotWrite`."""
    with ExitStack() as stack:
        for path, text in contents.items():
            stack.enter_context(replacing(path)).write_text(text, encoding="utf-8")


def copy_whole(source: Path, path: Path) -> None:
    """Copy a file, with its times, as :func:`replacing` does. Raises :class:`CannotWrite`."""
    with replacing(path) as temporary:
        shutil.copy2(source, temporary)


def temporary_of(path: Path, suffix: str = "") -> Path:
    """A name for what is to become ``path``, which nobody else will use."""
    return path.with_name(f"{path.name[:50]}.{os.getpid()}-{secrets.token_hex(4)}.tmp{suffix}")


def remove_temporaries(folder: Path) -> None:
    """Remove what a process that was killed had begun to write in ``folder``. Only for who holds the folder's lock."""
    for path in folder.iterdir():
        if _TEMPORARY.search(path.name):
            path.unlink(missing_ok=True)


def _written_straight(path: Path) -> bool:
    """Whether ``path`` exists and is no regular file of its own; raises :class:`OSError` for what takes no bytes."""
    try:
        about = os.stat(path)
    except FileNotFoundError:
        return False
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if stat.S_ISBLK(about.st_mode) or stat.S_ISSOCK(about.st_mode):
        raise OSError(errno.ENXIO, "it is a socket or a disk")
    return not stat.S_ISREG(about.st_mode) or _standard_stream(about) is not None


def _standard_stream(about: os.stat_result) -> int | None:
    """1 or 2 if that is what ``about`` describes. A shell's ``>`` makes it a regular file, which must stay the one that is open."""
    for descriptor in (1, 2):
        with suppress(OSError):
            if os.path.samestat(about, os.fstat(descriptor)):
                return descriptor
    return None


def _pour(source: Path, path: Path) -> None:
    with source.open("rb") as content, os.fdopen(_open_straight(path), "wb") as stream:
        shutil.copyfileobj(content, stream)


def _open_straight(path: Path) -> int:
    """A descriptor that writes to what exists; a FIFO that nobody reads is not waited for."""
    standard = _standard_stream(os.stat(path))
    if standard is not None:
        (sys.stdout if standard == 1 else sys.stderr).flush()
        return os.dup(standard)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        raise OSError(error.errno, "nobody reads from it") if error.errno == errno.ENXIO else error from error
    os.set_blocking(descriptor, True)
    return descriptor


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class GrowingFile:
    """A file that grows by whole lines or records, each written out at once. What cannot be written whole is taken back.

    Args:
        path: of the file; what exists and is no regular file is written to, see :func:`replacing`.
        fresh: whether to begin with an empty file.

    Raises:
        CannotWrite: it cannot be opened.
    """

    def __init__(self, path: Path, fresh: bool = False) -> None:
        self.path = path
        try:
            self._regular = not _written_straight(path)
            if self._regular:
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | (os.O_TRUNC if fresh else 0)
                self._descriptor = os.open(path, flags, 0o666)
            else:
                self._descriptor = _open_straight(path)
        except OSError as error:
            raise CannotWrite(path, error) from error

    def write(self, content: str | bytes) -> None:
        """Append whole lines or a record. Raises :class:`CannotWrite`, and then the file ends as it did before."""
        left = memoryview(content.encode() if isinstance(content, str) else content)
        size = os.fstat(self._descriptor).st_size
        try:
            while left:
                left = left[os.write(self._descriptor, left) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            if self._regular:
                with suppress(OSError):
                    os.ftruncate(self._descriptor, size)
            raise CannotWrite(self.path, error) from error

    def to_disk(self) -> None:
        """See that what was written outlives a loss of power. Raises :class:`CannotWrite`."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise CannotWrite(self.path, error) from error

    def close(self) -> None:
        """Close the file; again is fine."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


def read_lines(path: Path, limit_bytes: int, what: str, parse: Callable[[bytes], Parsed]) -> Iterator[tuple[int, Parsed]]:
    """The lines of a file that grows, each with its number from 1; empty ones are left out.

    A last line without an end that ``parse`` cannot read was cut off, by a full disk or a killed process: it is left out, and a warning
    says so. Where it would be the only one, the file is none.

    ``parse`` makes something of a line, or raises :class:`ValueError`. The others are as of :func:`open_bounded`, and its errors.

    Raises:
        CorruptFile: ``parse`` cannot read another line.
    """
    some = False
    with open_bounded(path, limit_bytes, what) as stream:
        for number, line in enumerate(stream, start=1):
            if not line.strip():
                continue
            try:
                parsed = parse(line)
            except ValueError as error:
                if line.endswith(b"\n") or not some:
                    raise CorruptFile(what, path, f"line {number} {error}") from error
                if number > 1:  # else nothing is there at all, and whoever reads it says so
                    LOG.warning("%s %s was cut off in line %d; the %d lines before it are read", what, path, number, number - 1)
                return
            some = True
            yield number, parsed


def keep(path: Path) -> Path | None:
    """Copy a file that is about to be replaced, beside it and under a name that no other has; its path, None if there is no file."""
    if not path.exists():
        return None
    stamp = time.strftime("%Y%m%d-%H%M%S")
    names = [path.with_name(f"{path.name}.{stamp}{suffix}.bak") for suffix in ("", *(f".{n}" for n in range(1, 1000)))]
    kept = next(name for name in names if not name.exists())
    copy_whole(path, kept)
    return kept


def resource_path(relative: str) -> Path:
    """Path of a shipped file or folder, such as ``"configs"`` or ``"urdf/al5a.urdf"``.

    In a wheel the files lie in ``marl_handover/resources/``; in a checkout or an editable install, beside the package.
    Raises :class:`MissingFile` if it is in neither place.
    """
    for root in (_PACKAGE / "resources", _PACKAGE.parent):
        path = root / relative
        if path.exists():
            return path
    raise MissingFile("resource", relative, "reinstall the package")


def package_path(relative: str) -> Path:
    """Path of a file inside the package folder itself, such as ``"pretrained/b.npz"``. Raises :class:`MissingFile`."""
    path = _PACKAGE / relative
    if not path.exists():
        raise MissingFile("resource", relative, "reinstall the package")
    return path
