"""Many items of work over the cores of this machine or of a Ray cluster, through joblib.

What an item does may fail, and so may the process that does it. An exception becomes a :class:`Failure` in the place of that item's
result; a worker that dies takes only unfinished items with it, and those are started again, from nothing: a function that can continue
half-way (a training run from its checkpoint) has to see to that by itself.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from typing import Any, TypeVar

import cloudpickle
from joblib import cpu_count

from marl_handover.compare.workers import LokyWorkers, Outcome, died, run_parallel
from marl_handover.config import require_at_least, require_choice
from marl_handover.progress import Bar

LAUNCHERS = ("loky", "ray")
LOG = logging.getLogger(__name__)

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
    parcels = [cloudpickle.dumps((function, item)) for item in items]
    names = [label(item) for item in items]
    if launcher == "ray":
        from marl_handover.compare.ray_workers import through_ray

        outcomes = through_ray(dict(enumerate(parcels)), names, address, jobs, attempts, ready)
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
    parcels: list[bytes], names: list[str], workers: int, attempts: int, ready: Callable[[], None]
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


def _round(backend: LokyWorkers, parcels: Mapping[int, bytes], workers: int, alone: bool) -> Generator[Outcome, None, None]:
    """Outcomes until all are there or a worker dies."""
    delivered = set()
    try:
        for outcome in run_parallel(backend, parcels, max(2, workers) if alone else workers, at_once=1 if alone else workers):
            delivered.add(outcome.index)
            yield outcome
    except BrokenProcessPool:
        # What was done before the death, but not yet handed over, joblib drops.
        yield from (outcome for index, outcome in backend.finished.items() if index not in delivered)
