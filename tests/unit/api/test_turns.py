"""Who is worked for next when there is more to do than can be done at once."""

import asyncio
from contextlib import AsyncExitStack

import pytest

from l3ps_api.places import Turns
from l3ps_api.problems import ApiProblem


class Play:
    """Requests that have their turn until they are told to end."""

    def __init__(self, turns: Turns) -> None:
        self.turns, self.working, self.ends, self.tasks = turns, [], {}, {}

    async def ask(self, *names: str) -> None:
        """So many requests, named after their projects and numbers."""

        async def work(name: str) -> None:
            async with self.turns.turn(name[0]):
                self.working.append(name)
                try:
                    await self.ends[name].wait()
                finally:
                    self.working.remove(name)

        for name in names:
            self.ends[name] = asyncio.Event()
            self.tasks[name] = asyncio.create_task(work(name))
        await self.settle()

    async def end(self, *names: str) -> None:
        for name in names:
            self.ends[name].set()
        await self.settle()

    async def give_up(self, name: str) -> None:
        self.tasks[name].cancel()
        await asyncio.wait([self.tasks[name]])
        await self.settle()

    async def settle(self) -> None:
        for _ in range(10):
            await asyncio.sleep(0)


def played(scenario) -> None:
    asyncio.run(scenario(Play(Turns(limit=4, waiting=5, waiting_bytes=100))))


def test_one_project_waits_for_itself_and_others_are_served_at_once() -> None:
    async def scenario(play: Play) -> None:
        await play.ask("a1", "a2", "a3", "a4", "a5")
        assert play.working == ["a1", "a2"]
        await play.ask("b1", "b2")
        assert play.working == ["a1", "a2", "b1"]
        await play.end("a1")
        assert play.working == ["a2", "b1", "a3"], "each in the order in which it came"
        await play.end("a2", "a3", "a4", "a5", "b1", "b2")
        assert play.working == []

    played(scenario)


def test_a_turn_is_handed_on_whatever_became_of_those_who_had_or_awaited_it() -> None:
    async def scenario(play: Play) -> None:
        await play.ask("a1", "a2", "a3", "a4", "a5")
        await play.give_up("a3")
        await play.give_up("a1")
        assert play.working == ["a2", "a4"]
        play.ends["a2"].set()
        play.tasks["a5"].cancel()  # in the moment in which it is called
        await play.settle()
        await play.end("a4")
        async with AsyncExitStack() as stack:
            for _ in range(2):
                await asyncio.wait_for(stack.enter_async_context(play.turns.turn("a")), 5)

    played(scenario)


def test_a_line_has_an_end() -> None:
    async def scenario(play: Play) -> None:
        await play.ask(*(f"a{n}" for n in range(7)))
        with pytest.raises(ApiProblem) as caught:
            async with play.turns.turn("a"):
                raise AssertionError
        assert caught.value.status == 429 and caught.value.headers["Retry-After"] == "1"
        async with play.turns.turn("b"):
            pass

    played(scenario)


def test_large_bodies_make_a_short_line() -> None:
    async def scenario(play: Play) -> None:
        await play.ask("a1", "a2")
        async with asyncio.TaskGroup() as tasks:

            async def wait() -> None:
                async with play.turns.turn("a", 60):
                    pass

            tasks.create_task(wait())
            await play.settle()
            with pytest.raises(ApiProblem) as caught:
                async with asyncio.timeout(5), play.turns.turn("a", 60):
                    raise AssertionError
            assert caught.value.status == 429
            await play.end("a1", "a2")
        await asyncio.wait_for(wait(), 5)

    played(scenario)
