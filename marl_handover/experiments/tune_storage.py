"""Where a study is kept: a journal file, or a database by URL, whose password is never shown."""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from marl_handover.errors import CorruptFile, HandoverError
from marl_handover.files import GrowingFile, expanded, make_folder
from marl_handover.locks import held

LOG = logging.getLogger(__name__)
BEAT_S = 60.0
"""A trial that runs says so this often ..."""
SILENT_S = 600.0
"""... and one on another machine that has been silent for so long is taken for dead."""
TRIES = 3
"""So often a trial is started whose process dies."""
SQLITE_WAIT_S = 60.0
ENDED = (ValueError, RuntimeError)
"""What Optuna raises when something is told of a trial that was ended before."""
DRIVERS = {"psycopg": "'psycopg[binary]'", "psycopg2": "psycopg2-binary", "MySQLdb": "mysqlclient"}
"""Packages that are not called as their modules are."""


class StorageUnavailable(HandoverError):
    """A study's storage cannot be opened."""

    def __init__(self, storage: str, reason: str) -> None:
        super().__init__(f"storage={hidden(storage)}: {' '.join(hidden(reason).split())}")


_BEGIN = b'{"op_code":'
"""How every record of Optuna's journals begins, and so every journal."""


class Journal(JournalFileBackend):
    """Optuna's journal file, in which a line that was cut off, by a full disk or a killed process, is no end of the study.

    It is taken away before the next one is appended, which Optuna would put behind it on the same line. A warning says so.

    Raises:
        CorruptFile: there is something else than a regular file, or than a journal.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._own = path, JournalFileSymlinkLock(str(path))
        if path.exists() and not path.is_file():
            raise CorruptFile("journal", path, "it is no regular file")
        if path.exists():
            with path.open("rb") as stream:
                first = stream.read(len(_BEGIN))
            if not _BEGIN.startswith(first):  # nothing of it is touched
                raise CorruptFile("journal", path, "no study wrote it")
        super().__init__(str(path), self._own)
        if not self._whole():
            with self._locked():
                pass

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """As the base class; what there is no room for is taken back."""
        with self._locked(), closing(GrowingFile(self.path)) as file:
            file.write("".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs))
            file.to_disk()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Be the only writer, of a file that ends with a whole line."""
        self._own.acquire()
        try:
            if not self._whole():
                content = self.path.read_bytes()
                LOG.warning("journal %s was cut off in its last line, which is taken away", self.path)
                os.truncate(self.path, content.rfind(b"\n") + 1)
            yield
        finally:
            self._own.release()

    def _whole(self) -> bool:
        with self.path.open("rb") as stream:
            if stream.seek(0, os.SEEK_END) == 0:
                return True
            stream.seek(-1, os.SEEK_END)
            return stream.read(1) == b"\n"


def hidden(text: str) -> str:
    """``text`` with every password of a URL in it replaced by stars."""
    text = re.sub(r":(?!//)\S*@", ":***@", text)
    return re.sub(r"(password=)[^&\s]+", r"\1***", text)


def located(storage: str, folder: Path) -> str:
    """``storage`` as workers need it, who may stand in another folder; a journal file in ``folder`` if it is empty.

    Raises :class:`StorageUnavailable` for a URL without its slashes, which would pass for a path, and for a database in memory, which
    every worker would have one of its own of, and which would end with the call.
    """
    scheme, slashes, rest = storage.partition("://")
    if slashes and scheme.partition("+")[0] == "sqlite" and rest[:1] in ("", "/"):
        name, mark, options = rest.removeprefix("/").partition("?")
        if not name or ":memory:" in rest or "mode=memory" in options:
            raise StorageUnavailable(storage, "is a database in memory, which no other process sees; sqlite:///file keeps the study")
        return storage if name.startswith("file:") else f"{scheme}:///{expanded(name).absolute()}{mark}{options}"
    if slashes:
        return storage
    if re.match(r"\w+:", storage):
        raise StorageUnavailable(storage, "is neither a URL, such as postgresql://user:password@host/name, nor the path of a journal file")
    path = expanded(storage or folder / "study.journal").absolute()
    if path.exists() and not path.is_file():
        raise StorageUnavailable(storage, "is no regular file, which a journal is")
    return str(path)


def open_storage(storage: str) -> BaseStorage:
    """The storage that a URL (``postgresql://user:password@host/name``, ``sqlite:///file``) or the path of a journal file means.

    Raises:
        StorageUnavailable: for one line about whatever is wrong with it.
        CorruptFile, CannotWrite: a file is no journal, or there is no room for it.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        if "://" not in storage:
            make_folder(Path(storage).parent)
            journal = Journal(Path(storage))
            try:
                return JournalStorage(journal)
            except (KeyError, TypeError, AttributeError, IndexError) as error:
                raise CorruptFile("journal", Path(storage), "not every line is a record of a study") from error
        wait: dict[str, Any] = {"connect_args": {"timeout": SQLITE_WAIT_S}} if storage.startswith("sqlite") else {"pool_pre_ping": True}
        return RDBStorage(storage, engine_kwargs=wait)
    except HandoverError:
        raise
    except ImportError as error:
        missing = getattr(error.__cause__ or error, "name", None) or "its driver"
        raise StorageUnavailable(storage, f"needs the package {missing}; run: pip install {DRIVERS.get(missing, missing)}") from None
    except (SQLAlchemyError, optuna.exceptions.OptunaError, OSError, ValueError, RuntimeError) as error:
        # The chain would show the URL, password and all, in a traceback.
        raise StorageUnavailable(storage, f"cannot be opened: {(str(error).splitlines() or [type(error).__name__])[0]}") from None


def open_study(storage: str, name: str, pruner: optuna.pruners.BasePruner | None = None) -> Study:
    """The study of that name, made if it is not there; the higher the value, the better."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.create_study(
            study_name=name,
            storage=open_storage(storage),
            pruner=pruner or optuna.pruners.NopPruner(),
            direction="maximize",
            load_if_exists=True,
        )


def asked(study: Study, storage: str, folder: Path) -> Trial:
    """The next trial. SQLite locks no rows: without the lock beside ``folder`` two processes may be given the same queued one.

    Raises:
        StorageUnavailable: others kept the lock for too long.
    """
    if not storage.startswith("sqlite"):
        return study.ask()
    with held(folder / "ask", wait_s=SQLITE_WAIT_S) as mine:
        if not mine:
            raise StorageUnavailable(storage, f"is asked by another process for more than {SQLITE_WAIT_S:g} s")
        return study.ask()


def counted(study: Study) -> int:
    """How many trials are done, or under way, or failed; one that was given back counts through its successor."""
    trials = study.get_trials(deepcopy=False)
    replaced = {trial.user_attrs.get("again_of") for trial in trials}
    return sum(trial.state != TrialState.WAITING and trial.number not in replaced for trial in trials)


@contextmanager
def claimed(trial: Trial, slot: str) -> Iterator[None]:
    """Say whose the trial is, and that it is alive, for as long as the block runs."""
    trial.set_user_attr("slot", slot)
    trial.set_user_attr("worker", _me())
    over = threading.Event()

    def beat() -> None:
        # A trial that somebody ended takes no more attributes; its process finds out when it tells the result.
        with suppress(*ENDED):
            while not over.wait(BEAT_S):
                trial.set_user_attr("beat", time.time())

    trial.set_user_attr("beat", time.time())
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def abandoned(trial: FrozenTrial, told: bool = False) -> bool:
    """Whether a running trial's process is gone.

    On this machine the process itself is looked for. Of another machine's, silence tells, or ``told``: who started it says that it died.
    """
    worker, beat = trial.user_attrs.get("worker"), trial.user_attrs.get("beat", 0.0)
    if worker is not None and worker["host"] == socket.gethostname():
        return bool(_started(worker["pid"]) != worker["started"])
    begun = trial.datetime_start.timestamp() if trial.datetime_start is not None else 0.0
    return told or time.time() - max(beat, begun) > SILENT_S


def give_back(study: Study, trial: FrozenTrial, again: bool = True) -> None:
    """Fail a trial whose process died, and queue its settings once more, unless they were tried too often."""
    try:
        study.tell(trial.number, state=TrialState.FAIL)
    except ENDED:
        return  # somebody else was faster
    tries = int(trial.user_attrs.get("tries", 1))
    if again and tries < TRIES:
        about = {"again_of": trial.number, "origin": trial.user_attrs.get("origin", trial.number), "tries": tries + 1}
        study.enqueue_trial(trial.params, user_attrs=about)


def ended(study: Study, trial: Trial, value: float | None = None, state: TrialState | None = None, error: str = "") -> FrozenTrial | None:
    """Tell how a trial went; None if it counts for nothing, as somebody ended it before."""
    try:
        if error:
            trial.set_user_attr("error", error)
        return study.tell(trial, value, state=state)
    except ENDED:
        return None


def place_of(study: Study, number: int) -> int:
    """How many trials come before one, those that were given back left out: no two calls at one study get the same."""
    trials = study.get_trials(deepcopy=False)
    replaced = {trial.user_attrs.get("again_of") for trial in trials}
    return sum(trial.number < number and trial.number not in replaced for trial in trials)


def running(study: Study) -> list[FrozenTrial]:
    """Trials that were started and not ended."""
    return study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))


def _me() -> dict[str, Any]:
    return {"host": socket.gethostname(), "pid": os.getpid(), "started": _started(os.getpid())}


def _started(pid: int) -> str | None:
    """When the process of that number was started, in ticks since boot: numbers are given out again, these pairs are not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None
