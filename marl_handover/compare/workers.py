"""What happens inside a worker, and joblib's loky workers made to survive each other."""

from __future__ import annotations

import os
import threading
import time
import traceback
import warnings
from collections.abc import Generator, Mapping
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle
from joblib import Parallel, delayed
from joblib.parallel import LokyBackend, ParallelBackendBase

WATCH_S = 1.0
"""How often a worker looks whether the process that started it is still there."""


@dataclass(frozen=True)
class Outcome:
    """How one item ended: with a pickled result in ``payload``, or without one and an ``error``."""

    index: int
    payload: bytes | None
    error: str = ""
    traceback: str = ""
    worker_died: bool = False


def attempt(index: int, parcel: bytes) -> Outcome:
    """Unpack a function and its argument, call it, pack the result. Whatever goes wrong in any of it is this item's outcome."""
    try:
        function, item = cloudpickle.loads(parcel)
        return Outcome(index, cloudpickle.dumps(function(item)))
    except (Exception, SystemExit) as error:
        return Outcome(index, None, summary(error), "".join(traceback.format_exception(error)))


def summary(error: BaseException) -> str:
    """Type, message and place of an exception in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno}, in {frames[-1].name})" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())


def run_parallel(backend: ParallelBackendBase, parcels: Mapping[int, bytes], workers: int, at_once: int) -> Generator[Outcome, None, None]:
    """One joblib call: the outcome of each parcel as it is done, ``at_once`` of them at the same time."""
    parallel = Parallel(n_jobs=workers, backend=backend, batch_size=1, pre_dispatch=at_once, return_as="generator_unordered")
    with warnings.catch_warnings():
        # A call that is closed early warns of the work it throws away; that is what closing is for.
        warnings.filterwarnings("ignore", message=".*still being processed by the workers.*")
        warnings.filterwarnings("ignore", message=".*successfully executed +but not used.*")
        with closing(parallel(delayed(attempt)(index, parcel) for index, parcel in list(parcels.items()))) as outcomes:
            yield from outcomes


def died(index: int, attempts: int, reason: str = "") -> Outcome:
    """The outcome of an item that no worker survived."""
    tried = "its worker died" if attempts == 1 else f"its worker died {attempts} times"
    return Outcome(index, None, f"{tried}{f' ({reason})' if reason else ''}: killed, out of memory or crashed", worker_died=True)


class LokyWorkers(LokyBackend):
    """joblib's loky backend that keeps account of what was started and finished, and leaves no process behind.

    A backend is used for one call.

    Attributes:
        finished: outcomes that have reached this process, by item, in the order in which they came.
    """

    def __init__(self) -> None:
        super().__init__(inner_max_num_threads=1, initializer=_watch, initargs=(os.getpid(),))
        self._started: list[int] = []
        self.finished: dict[int, Outcome] = {}

    def interrupted(self) -> list[int]:
        """Items that were started and have no outcome."""
        return [index for index in self._started if index not in self.finished]

    def submit(self, func: Any, callback: Any = None) -> Future[list[Outcome]]:
        """As the base class."""
        _, (index, _), _ = func.items[0]
        self._started.append(index)
        return super().submit(func, callback)

    def retrieve_result_callback(self, future: Future[list[Outcome]]) -> list[Outcome]:
        """As the base class."""
        outcomes: list[Outcome] = super().retrieve_result_callback(future)
        self.finished.update({outcome.index: outcome for outcome in outcomes})
        return outcomes

    def terminate(self) -> None:
        """End the workers, which the base class would keep for a later call. All is done: a call that is aborted has killed them before."""
        if self._workers is not None:
            self._workers.terminate()
        super().terminate()


def _watch(parent: int) -> None:
    """End this worker when the process that started it is gone: nobody else would, and a second call may do the same item again."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
