"""What a change with a condition holds, and how long."""

import asyncio

from l3ps_api.app import create_app
from l3ps_api.etags import ETags
from l3ps_api.keyring import Principal
from l3ps_api.operations import operations_of
from l3ps_api.replies import Reply
from l3ps_platform.settings import Settings


def test_who_takes_no_answer_keeps_no_other_change_waiting(tmp_path):
    """Its change is made, and its place given back, before the answer is sent."""

    async def play() -> None:
        done, sending, enough = [], asyncio.Event(), asyncio.Event()

        async def app(scope, receive, send) -> None:
            done.append(scope["method"])
            await Reply(200, [(b"content-type", b"application/json")], b"{}").send(send)

        async def ask(send) -> None:
            await etags(
                {
                    "type": "http", "method": "PUT", "path": "/v1/retention", "query_string": b"",
                    "headers": [(b"if-match", b"*")], "state": {"principal": Principal("prj", "write")},
                },
                receive, send,
            )  # fmt: skip

        async def receive() -> dict:
            return {"type": "http.request", "body": b""}

        async def never(_: dict) -> None:
            sending.set()
            await enough.wait()

        async def gladly(_: dict) -> None:
            return None

        operations = operations_of(create_app(Settings(data_dir=tmp_path)))
        etags = ETags(app, lambda: operations)
        async with asyncio.TaskGroup() as tasks:
            for _ in range(8):
                sending.clear()
                tasks.create_task(ask(never))
                await sending.wait()
            async with asyncio.timeout(30):
                await ask(gladly)
            enough.set()
        assert done.count("PUT") == 9

    asyncio.run(play())
