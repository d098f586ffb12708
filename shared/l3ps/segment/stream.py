"""Work on a sequence in several threads at a time, its results in order, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def in_order(
    work: Callable[[T], R],
    items: Iterable[T],
    *,
    lanes: int,
    ahead: int,
    stop: Callable[[], None] = lambda: None,
) -> Generator[R]:
    """``map(work, items)`` by several threads.

    What ``work`` raises for an item is raised in that item's turn. When the generator ends, by that, at its end or by
    ``close()``, no thread of it is left: what has not begun is dropped, what runs is waited for.

    Args:
        work: called with one item; releases the interpreter lock where it takes long.
        items: taken one by one as results are asked for.
        lanes: items in work at a time.
        ahead: items taken whose result has not been asked for; bounds the memory.
        stop: called before the wait for what still runs, to cut it short.
    """
    pool = ThreadPoolExecutor(lanes, thread_name_prefix="l3ps-lane")
    waiting: deque[Future[R]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        stop()
        pool.shutdown(cancel_futures=True)
