"""A joblib backend whose workers are tasks on a Ray cluster.

joblib's own Ray backend (``ray.util.joblib``) cannot be used here. It refuses to hand over results as they come; it deals the items out to
actors that nobody replaces, so that every item dealt to one that died fails, started or not; and the first of these failures ends the call
and drops what the others had done. A Ray task has no such ties: Ray finds a core for it, and when its process or machine dies only this
task fails, and is given to Ray again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import Any

from joblib.parallel import ParallelBackendBase

from marl_handover.cluster import ClusterUnavailable, connected, require_ray
from marl_handover.compare.workers import Outcome, died, run_parallel, summary

LOG = logging.getLogger(__name__)


def through_ray(
    parcels: Mapping[int, bytes], names: list[str], address: str, jobs: int, attempts: int, ready: Callable[[], None]
) -> Generator[Outcome, None, None]:
    """The outcome of each parcel as it is done, on the cluster at ``address``; see :func:`marl_handover.compare.launch.fan_out`."""
    if not parcels:
        return
    with connected(require_ray("launcher=ray"), address, jobs) as ray:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not cores:
            raise ClusterUnavailable(address, "it has no cores")
        ready()
        backend = RayTasks(ray, names, attempts)
        at_once = jobs or cores
        # With a single worker joblib would do the work in this process.
        with closing(run_parallel(backend, parcels, max(2, at_once), at_once)) as outcomes:
            yield from outcomes


class RayTasks(ParallelBackendBase):
    """Every submitted call becomes a Ray task on one core. A thread for each of them waits for it, and gives it to Ray again if it dies.

    Args:
        ray: the module, connected to a cluster.
        names: of the items, for messages.
        attempts: how often an item is started at most.
    """

    supports_retrieve_callback = True

    def __init__(self, ray: Any, names: list[str], attempts: int) -> None:
        super().__init__(nesting_level=0)
        self._ray, self._names, self._attempts = ray, names, attempts
        one_thread = {name: "1" for name in self.MAX_NUM_THREADS_VARS}
        # Ray's own retries stay off: it repeats a task that runs out of memory without end.
        self._task = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": one_thread})(_call)
        self._running: set[Any] = set()
        self._threads: ThreadPoolExecutor | None = None
        self._aborted = False

    def effective_n_jobs(self, n_jobs: int) -> int:
        """As asked: the caller knows the cluster."""
        return n_jobs

    def configure(self, n_jobs: int = 1, parallel: Any = None, **_: Any) -> int:
        """As the base class."""
        self.parallel, self._threads = parallel, ThreadPoolExecutor(n_jobs, thread_name_prefix="ray-task")
        return n_jobs

    def submit(self, func: Any, callback: Any = None) -> Future[list[Outcome]]:
        """As the base class."""
        assert self._threads is not None
        future = self._threads.submit(self._until_done, func)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future[list[Outcome]]) -> list[Outcome]:
        """As the base class."""
        return out.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """Kill the tasks that run; the backend is of no use after that."""
        self._aborted = True
        for reference in list(self._running):
            self._ray.cancel(reference, force=True)

    def terminate(self) -> None:
        """As the base class."""
        if self._threads is not None:
            self._threads.shutdown(wait=self._aborted, cancel_futures=True)

    def _until_done(self, batch: Any) -> list[Outcome]:
        _, (index, _), _ = batch.items[0]
        error: Exception | None = None
        for number in range(1, self._attempts + 1):
            if error is not None:
                reason = type(error).__name__
                LOG.warning("%s: a worker died (%s); starting it again (%d of %d)", self._names[index], reason, number, self._attempts)
            reference = self._task.remote(batch)
            self._running.add(reference)
            try:
                outcomes: list[Outcome] = self._ray.get(reference)
                return outcomes
            except self._ray.exceptions.RayTaskError as unusable:
                return [Outcome(index, None, summary(unusable.cause or unusable), str(unusable))]
            except self._ray.exceptions.RayError as death:
                error = death
                if self._aborted:
                    break
            finally:
                self._running.discard(reference)
        return [died(index, self._attempts, type(error).__name__)]


def _call(batch: Any) -> list[Outcome]:
    """What a task does."""
    outcomes: list[Outcome] = batch()
    return outcomes
