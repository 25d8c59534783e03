"""Work on the cores of this machine: processes for it, and the same work on many items with the results in order."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from threading import Thread
from typing import TypeVar

from zfusion.errors import RunError

Item = TypeVar("Item")
Done = TypeVar("Done")

DIED = "its process died: killed, or out of memory"

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""A node's matrices are small: threads of a BLAS only get into each other's way, and the other nodes'."""


def in_order(work: Callable[[Item], Done], items: Sequence[Item], jobs: int) -> Iterator[Done]:
    """What `work` makes of each item, in the order of the items; with `jobs` > 1 in so many processes of their own.

    RunError where one of these dies.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1:
        yield from map(work, items)
        return
    with workers(jobs) as pool:
        try:
            yield from pool.map(work, items)
        except BrokenProcessPool:
            raise RunError(f"a part of the work was not done: {DIED}") from None


@contextmanager
def workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that are gone afterwards, even if they are in the middle of something."""
    before = set(multiprocessing.active_children())
    kept = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update({name: value for name, value in ONE_THREAD.items() if kept[name] is None})
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.kill()
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)


def _begin() -> None:
    """Ctrl-C is for the parent to handle; a parent that is killed can handle nothing."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has one"
    wait([parent.sentinel])
    os._exit(1)
