"""The gate between clients and the routes: who waits for whom."""

import threading

import anyio
import anyio.lowlevel
import pytest
from fastapi import FastAPI

from l3ps_api.auth import Gate
from l3ps_api.keyring import Principal
from l3ps_api.operations import Operations
from l3ps_api.problems import ApiProblem
from l3ps_platform.settings import Settings

GUESSES = 50


class SlowKeyring:
    """Knows one secret, and looks wrong ones up for as long as it is told to."""

    def __init__(self) -> None:
        self.go_on = threading.Event()
        self.asked = 0

    def recall(self, secret: bytes | None, project: str) -> None:
        return None

    def verify(self, secret: bytes | None, project: str) -> Principal | None:
        if secret == b"right":
            return Principal("prj_default", "admin", None)
        self.asked += 1
        assert self.go_on.wait(30)
        return None


def request(secret: str, address: str) -> dict:
    headers = [(b"authorization", f"Bearer {secret}".encode())]
    return {
        "type": "http", "method": "GET", "path": "/v1/jobs", "query_string": b"", "headers": headers,
        "client": (address, 1),
    }  # fmt: skip


def test_a_flood_of_wrong_credentials_is_looked_up_in_a_line_of_its_own() -> None:
    anyio.run(flood)


async def flood() -> None:
    keyring = SlowKeyring()
    let_in = anyio.Event()

    async def app(scope, receive, send) -> None:
        let_in.set()

    settings = Settings(failures_per_second=0.001, failures_burst=1)
    gate = Gate(app, settings, keyring, lambda: Operations(FastAPI()))  # type: ignore[arg-type]

    async def guess() -> None:
        with pytest.raises(ApiProblem):
            await gate(request("wrong", "198.51.100.1"), None, None)  # type: ignore[arg-type]

    async with anyio.create_task_group() as tasks:
        keyring.go_on.set()
        await guess()  # the address has used up what it may get wrong
        keyring.go_on.clear()
        for _ in range(GUESSES):
            tasks.start_soon(guess)
        with anyio.fail_after(30):
            while keyring.asked < 2:
                await anyio.lowlevel.checkpoint()
            tasks.start_soon(gate, request("right", "198.51.100.2"), None, None)
            try:
                await let_in.wait()
            finally:
                keyring.go_on.set()
    assert keyring.asked == 1 + GUESSES
