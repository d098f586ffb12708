"""An answer that anybody may ask for is made once at a time, and for all who wait."""

import asyncio
import threading

import pytest

from l3ps_api.system.shared import Shared


def test_all_who_ask_while_one_is_made_get_the_next_one_together():
    """Each of them gets an answer that was begun after the question."""
    made, begun, go_on = [], threading.Event(), threading.Event()

    def make() -> int:
        made.append(len(made))
        begun.set()
        go_on.wait()
        return made[-1]

    async def ask() -> list[int]:
        shared = Shared(make)
        first = asyncio.create_task(shared.get())
        await asyncio.to_thread(begun.wait)
        others = [asyncio.create_task(shared.get()) for _ in range(50)]
        await asyncio.sleep(0)
        go_on.set()
        return [await first, *await asyncio.gather(*others), await shared.get()]

    assert asyncio.run(ask()) == [0] + [1] * 50 + [2]


def test_an_error_is_told_to_all_and_the_next_one_tries_again():
    answers = iter([ValueError("away"), 7])

    def make() -> int:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def ask() -> int:
        shared = Shared(make)
        for each in [asyncio.create_task(shared.get()) for _ in range(3)]:
            with pytest.raises(ValueError, match="away"):
                await each
        return await shared.get()

    assert asyncio.run(ask()) == 7


def test_one_who_does_not_wait_takes_nothing_from_the_others():
    go_on = threading.Event()

    async def ask() -> bool:
        shared = Shared(go_on.wait)
        gone, stays = (asyncio.create_task(shared.get()) for _ in range(2))
        await asyncio.sleep(0)
        gone.cancel()
        go_on.set()
        return await stays

    assert asyncio.run(ask())
