"""Many items of work over the cores of this machine, through joblib, or of a Ray cluster.

What an item does may fail, and so may the process that does it. An exception becomes a :class:`Failure` in the place of that item's
result; a worker that dies takes only unfinished items with it, and those are started again, from nothing: a function that can continue
half-way (a training run from its checkpoint) has to see to that by itself.

joblib's Ray backend (``ray.util.joblib``) is of no use for that: it hands over no results as they come, deals the items out to actors that
nobody replaces, and ends the call at the first one that dies. Here an item is a Ray task, which fails alone and is given to Ray again.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle
from joblib import Parallel, cpu_count, delayed
from joblib.parallel import LokyBackend, ParallelBackendBase

from marl_handover.cluster import ClusterUnavailable, connected, require_ray
from marl_handover.config import require_at_least, require_choice
from marl_handover.plugins import Parcel
from marl_handover.progress import Bar

LOG = logging.getLogger(__name__)

WATCH_S = 1.0
"""How often a worker looks whether the process that started it is still there."""

CANCEL_S = 10.0
"""So long it is waited for tasks on a cluster that were cancelled to end."""


@dataclass(frozen=True)
class Outcome:
    """How one item ended: with a pickled result in ``payload``, or without one and an ``error``."""

    index: int
    payload: bytes | None
    error: str = ""
    traceback: str = ""
    worker_died: bool = False


def attempt(index: int, parcel: Parcel) -> Outcome:
    """Do what is in a parcel and pack the result. Whatever goes wrong in any of it is this item's outcome."""
    try:
        return Outcome(index, cloudpickle.dumps(parcel()))
    except (Exception, SystemExit) as error:
        return Outcome(index, None, summary(error), "".join(traceback.format_exception(error)))


def summary(error: BaseException) -> str:
    """Type, message and place of an exception in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno}, in {frames[-1].name})" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())


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


def _through_ray(
    parcels: list[Parcel], names: list[str], address: str, jobs: int, attempts: int, ready: Callable[[], None]
) -> Generator[Outcome, None, None]:
    """The outcome of each parcel as it is done, on the cluster at ``address``: a task on one core, given to Ray again if it dies."""
    if not parcels:
        return
    with connected(require_ray("launcher=ray"), address, jobs) as ray:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not cores:
            raise ClusterUnavailable(address, "it has no cores")
        ready()
        one_thread = {name: "1" for name in ParallelBackendBase.MAX_NUM_THREADS_VARS}
        # Ray's own retries stay off: it repeats a task that runs out of memory without end.
        task = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": one_thread})(attempt)
        running: dict[Any, int] = {}
        waiting, tried = deque(range(len(parcels))), Counter[int]()

        def start() -> None:
            """Keep Ray supplied; unless ``jobs`` are asked for, it knows best how many run at once."""
            while waiting and len(running) < (jobs or len(parcels)):
                index = waiting.popleft()
                tried[index] += 1
                running[task.remote(index, parcels[index])] = index

        try:
            start()
            while running:
                (done,), _ = ray.wait(list(running), num_returns=1)
                outcome = _outcome(ray, done, running.pop(done))
                if outcome.worker_died and tried[outcome.index] < attempts:
                    again = f"starting it again ({tried[outcome.index] + 1} of {attempts})"
                    LOG.warning("%s: a worker died (%s); %s", names[outcome.index], outcome.error, again)
                    waiting.appendleft(outcome.index)
                    start()
                    continue
                start()
                yield died(outcome.index, attempts, outcome.error) if outcome.worker_died else outcome
        finally:
            for reference in running:
                ray.cancel(reference, force=True)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=CANCEL_S)


def _outcome(ray: Any, reference: Any, index: int) -> Outcome:
    """What a task that has ended brought; of one that died, the kind of death is the error."""
    try:
        outcome: Outcome = ray.get(reference)
        return outcome
    except ray.exceptions.RayTaskError as unusable:
        return Outcome(index, None, summary(unusable.cause or unusable), str(unusable))
    except ray.exceptions.RayError as death:
        return Outcome(index, None, type(death).__name__, worker_died=True)


LAUNCHERS = ("loky", "ray")

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Failure:
    """What stands for the result of an item that has none.

    Attributes:
        item: the item.
        error: type and message of the exception and the line that raised it, as one line.
        traceback: the whole traceback; empty if the worker died.
        worker_died: whether there was no exception, but every process that tried died.
    """

    item: Any
    error: str
    traceback: str = ""
    worker_died: bool = False


def fan_out(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    launcher: str = "loky",
    address: str = "",
    jobs: int = 0,
    attempts: int = 3,
    label: Callable[[Item], str] = str,
    progress: bool = True,
    ready: Callable[[], None] = lambda: None,
) -> Generator[tuple[Item, Result | Failure], None, None]:
    """Pairs of item and result in the order in which they are done; each item has exactly one.

    An item whose result has reached the caller is never run again. One whose worker died before may have done its work, or part of it.
    Workers keep to one numerical thread. Closing the iterator, an exception in the caller's loop and Ctrl-C end every worker.

    Args:
        function: called with one item in a process of its own; it and the items must be picklable (functions of ``__main__`` are).
            With ``loky`` and one job it is called in this process.
        items: what to do; each is an argument of ``function``.
        launcher: ``loky``, processes of this machine, or ``ray``, tasks on a cluster whose machines have this package installed.
        address: of the Ray cluster: ``auto`` (or empty) for the one this machine belongs to, ``host:port``, ``ray://host:port``, or
            ``local`` for one that is started here and ends with the call.
        jobs: items at the same time; 0 = one for each core of the machine or cluster.
        attempts: how often an item is started at most when workers die.
        label: an item's name in messages.
        progress: show a bar.
        ready: called once, when workers can be had and before any item is given to one.

    Raises:
        UnknownChoice, InvalidSetting: for arguments out of their limits.
        MissingExtra: ``launcher=ray`` without the package ray.
        ClusterUnavailable: no Ray cluster answers at ``address``.
    """
    require_choice("launcher", launcher, LAUNCHERS)
    require_at_least("jobs", jobs, 0)
    require_at_least("attempts", attempts, 1)
    items = list(items)
    parcels = [Parcel(partial(function, item)) for item in items]
    names = [label(item) for item in items]
    if launcher == "ray":
        outcomes = _through_ray(parcels, names, address, jobs, attempts, ready)
    else:
        outcomes = _through_loky(parcels, names, jobs or cpu_count(), attempts, ready)
    return _delivered(items, names, outcomes, progress)


def _delivered(
    items: list[Item], names: list[str], outcomes: Generator[Outcome, None, None], progress: bool
) -> Generator[tuple[Item, Any], None, None]:
    """Each outcome unpacked, with a bar."""
    bar = Bar(total=len(items), unit="item", shown=progress)
    with bar, closing(outcomes):
        for outcome in outcomes:
            item = items[outcome.index]
            bar.set_postfix_str(names[outcome.index], refresh=False)
            bar.update()
            if outcome.payload is None:
                yield item, Failure(item, outcome.error, outcome.traceback, outcome.worker_died)
            else:
                yield item, cloudpickle.loads(outcome.payload)


def _through_loky(
    parcels: list[Parcel], names: list[str], workers: int, attempts: int, ready: Callable[[], None]
) -> Generator[Outcome, None, None]:
    """Rounds of joblib's loky workers. When one of them dies, all do, and what is unfinished goes into the next round.

    Which of the items that ran at that time is to blame cannot be told, so before one of them is given up it runs alone.
    """
    ready()
    waiting = dict(enumerate(parcels))
    deaths: Counter[int] = Counter()
    while waiting:
        suspects = {index: parcel for index, parcel in waiting.items() if deaths[index] and deaths[index] == attempts - 1}
        backend = LokyWorkers()
        for outcome in _round(backend, suspects or waiting, workers, alone=bool(suspects)):
            del waiting[outcome.index]
            yield outcome
        for index in backend.interrupted():
            deaths[index] += 1
            if deaths[index] == attempts:
                del waiting[index]
                yield died(index, attempts)
            else:
                LOG.warning("%s: a worker died; starting it again (%d of %d)", names[index], deaths[index] + 1, attempts)


def _round(backend: LokyWorkers, parcels: Mapping[int, Parcel], workers: int, alone: bool) -> Generator[Outcome, None, None]:
    """Outcomes until all are there or a worker dies. With a single worker joblib would do the work in this process."""
    jobs, at_once = (max(2, workers), 1) if alone else (workers, workers)
    parallel = Parallel(n_jobs=jobs, backend=backend, batch_size=1, pre_dispatch=at_once, return_as="generator_unordered")
    delivered = set()
    with warnings.catch_warnings():
        # A call that is closed early warns of the work it throws away; that is what closing is for.
        warnings.filterwarnings("ignore", message=".*still being processed by the workers.*")
        warnings.filterwarnings("ignore", message=".*successfully executed +but not used.*")
        try:
            with closing(parallel(delayed(attempt)(index, parcel) for index, parcel in list(parcels.items()))) as outcomes:
                for outcome in outcomes:
                    delivered.add(outcome.index)
                    yield outcome
        except BrokenProcessPool:
            # What was done before the death, but not yet handed over, joblib drops.
            yield from (outcome for index, outcome in backend.finished.items() if index not in delivered)
