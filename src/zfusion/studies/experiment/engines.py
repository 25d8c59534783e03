"""Where tasks are executed: here, in processes of this machine, or on a Dask cluster. Results come as they are done."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from zfusion.drivers.workers import DIED, workers
from zfusion.errors import InputError
from zfusion.studies.experiment.execute import Result, execute
from zfusion.studies.experiment.plan import Task

DASK_CONNECT_S = "10s"


Results = Generator[tuple[Task, Result], None, None]


class Engine(Protocol):
    """Executes tasks."""

    def __call__(self, tasks: Sequence[Task], /) -> Results:
        """Every task with its result, in the order in which they are done. Closing it ends what is under way."""


def one_by_one(tasks: Sequence[Task], recordings: str | None = None) -> Results:
    """In this process."""
    for task in tasks:
        yield task, execute(task, recordings)


def in_processes(tasks: Sequence[Task], jobs: int) -> Results:
    """In so many processes of this machine."""
    left, jobs = list(reversed(tasks)), min(jobs, len(tasks))
    while left:
        suspects: list[Task] = []
        with workers(jobs) as pool:
            yield from _through(pool, left, jobs, suspects)
        for task in suspects:  # one of them brought down the pool: each by itself shows which
            with workers(1) as pool:
                alone: list[Task] = []
                yield from _through(pool, [task], 1, alone)
                if alone:
                    yield task, {"error": DIED, "traceback": ""}


def _through(pool: ProcessPoolExecutor, left: list[Task], jobs: int, suspects: list[Task]) -> Results:
    """Execute those that are left, last first; if the pool breaks, those under way become suspects."""
    under_way: dict[Future[Result], Task] = {}
    while left or under_way:
        while left and len(under_way) < jobs and not suspects:
            task = left.pop()
            try:
                under_way[pool.submit(execute, task)] = task
            except BrokenProcessPool:
                suspects.append(task)
        done, _ = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            task = under_way.pop(future)
            try:
                result = future.result()
            except BrokenProcessPool:
                suspects.append(task)
            else:
                yield task, result
        if suspects and not under_way:
            return


def on_dask(tasks: Sequence[Task], scheduler: str, jobs: int) -> Results:
    """On the Dask cluster whose scheduler is at that address; "local": on one with `jobs` workers, made for this.

    InputError where there is no such scheduler, or Dask is not installed.
    """
    with _dask_client(scheduler, jobs) as (client, as_completed):
        futures = {client.submit(execute, task, key=f"zfusion-{task.hash}", pure=False): task for task in tasks}
        for future in as_completed(futures):
            error = future.exception() if future.status != "finished" else None
            yield futures[future], {"error": f"{DIED} ({error})", "traceback": ""} if error else future.result()
            future.release()


@contextmanager
def _dask_client(scheduler: str, jobs: int) -> Iterator[tuple[Any, Callable[..., Any]]]:
    try:
        from distributed import Client, LocalCluster, as_completed  # noqa: PLC0415
    except ImportError:
        raise InputError("--dask needs Dask: pip install 'zfusion[dask]'") from None
    workers = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None}
    cluster = LocalCluster(**workers) if scheduler == "local" else None  # type: ignore[no-untyped-call]
    try:
        try:
            client = Client(cluster or scheduler, timeout=DASK_CONNECT_S)  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise InputError(f"--dask {scheduler}: there is no scheduler that answers: {error}") from None
        with client:
            yield client, as_completed
    finally:
        if cluster is not None:
            cluster.close()


def engine_of(world: str, jobs: int, dask: str | None = None, recordings: Path | None = None) -> Engine:
    """What executes the tasks of an experiment in that world. Live swarms need the machine: one after the other."""
    if world != "simulated":
        if dask is not None:
            raise InputError(f"--dask: runs of the world {world!r} take place on this machine, one at a time")
        return partial(one_by_one, recordings=None if recordings is None else str(recordings))
    if dask is not None:
        return partial(on_dask, scheduler=dask, jobs=jobs)
    return partial(in_processes, jobs=jobs) if jobs > 1 else one_by_one
