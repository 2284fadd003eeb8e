"""Sweeps on many machines: blocks as tasks of a Dask cluster.

A task is one block. It looks into the ledger, does the block if it is not done, writes its chunks
and then its row of the ledger, and returns a small dictionary. So it may run twice, on any worker:
when a worker dies, its block is done again elsewhere, with the same bits. The client holds the lock
of the store and numbers the categories when all blocks are done.

`distributed` is imported here only, and where it is used.
"""

import functools
import pickle
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from ..checks import require_value
from ..interrupts import heard_interrupts
from ..numerics.widths import is_cpu
from .question import Question
from .store import Store
from .work import Advance, counts, do_runs

#: How often a block is repeated whose task raised, for example because a disk was full.
RETRIES = 2
#: How often a block is submitted again that Dask gave up, because several workers died with it.
RESUBMISSIONS = 3
#: Seconds between two looks for blocks that are done, and for interrupts.
LOOK = 0.02
#: Name of a Dask resource; where any worker has it, blocks go only to workers that have it.
GPU = "GPU"


def check_executor(executor: Any) -> None:
    """Raises a `ValueError` unless `executor` is a client that is not asynchronous."""
    methods = ("submit", "scheduler_info", "cancel", "asynchronous")
    fits = all(hasattr(executor, name) for name in methods) and not executor.asynchronous
    require_value(fits, "executor", "a dask.distributed.Client (not asynchronous)", executor)


def do_on_cluster(client: Any, question: Question, store: Store, advance: Advance) -> None:
    """Does the blocks that the store lacks on the workers of a cluster.

    advance is called with the numbers of newly done runs by status. Workers may come and go.
    """
    import cloudpickle
    from distributed import KilledWorker, as_completed

    packed = cloudpickle.dumps((question.arguments(), store.hash))
    place, name, resources = str(store.path.resolve()), uuid.uuid4().hex, _resources(client)
    submitted: Counter[int] = Counter()

    def submit(block: int) -> Any:
        submitted[block] += 1
        key = f"jaxbelt-block-{block}-{name}-{submitted[block]}"
        options = dict(key=key, retries=RETRIES, resources=resources, pure=False)
        return client.submit(do_block, packed, place, block, **options)

    futures = {submit(block): block for block in store.to_do}
    done = as_completed(futures)
    try:
        with heard_interrupts(at_once=True) as raise_interrupt:
            for future in _in_turn(done, raise_interrupt):
                block = futures.pop(future)
                try:
                    outcome = future.result()
                except KilledWorker:
                    if submitted[block] > RESUBMISSIONS:
                        raise
                    again = submit(block)
                    futures[again] = block
                    done.add(again)
                    continue
                store.read_rows(block)
                if not store.is_done(block):
                    raise OSError(f"store {store.path} must be in a folder that all workers share")
                advance(outcome["statuses"])
    finally:
        client.cancel(list(futures))
        store.read_rows(*store.to_do)


def _in_turn(done: Any, raise_interrupt: Callable[[], None]) -> Iterator[Any]:
    """Futures as they complete; an interrupt that was only noted is raised in between."""
    while not done.is_empty():
        raise_interrupt()
        if done.has_ready():
            yield next(done)
        else:
            time.sleep(LOOK)


def _resources(client: Any) -> dict[str, float] | None:
    """Resources that a block needs. All blocks run on one kind of device, as others round
    differently."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    return {GPU: 1.0} if any(worker["resources"].get(GPU, 0) for worker in workers) else None


def do_block(packed: bytes, place: str, block: int) -> dict[str, Any]:
    """Does a block of a store unless it is done; the task of a worker.

    packed: the arguments of the sweep and the hash of the question, pickled; place: the store's
    folder. Returns the block and the numbers of its runs by status.
    """
    stopped = _stopped()

    def watch() -> None:
        if stopped():
            raise RuntimeError("the sweep was interrupted")

    # x64 for this thread of the worker only.
    with jax.enable_x64(True):
        question, store = _opened(packed, place)
        store.read_rows(block)
        if not store.is_done(block):
            store.began = time.monotonic()
            threads = 1 if is_cpu() else None
            do_runs(question, store, [block], lambda _: None, threads=threads, watch=watch)
        return {"block": block, "statuses": counts(store.statuses(block))}


@functools.lru_cache(maxsize=4)
def _opened(packed: bytes, place: str) -> tuple[Question, Store]:
    """The question and its store, cached in each worker, so that the kernel is compiled once for
    them."""
    arguments, known = pickle.loads(packed)
    question = Question.of(*arguments)
    return question, Store(Path(place), question, known=known)


def _stopped() -> Callable[[], bool]:
    """Returns a function that says whether the present task is cancelled."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # called without Dask
        return lambda: False
    key, tasks = worker.get_current_task(), worker.state.tasks
    return lambda: key not in tasks or tasks[key].state == "cancelled"
