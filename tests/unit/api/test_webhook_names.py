"""Names of webhooks' hosts are looked up where they hold nobody else up."""

import asyncio
import socket
import threading
from types import SimpleNamespace

import pytest

from l3ps_api.problems import ApiProblem
from l3ps_api.webhooks import service

SETTINGS = SimpleNamespace(settings=SimpleNamespace(webhook_allow=(), webhook_http=False))


def test_names_that_nobody_answers_for_are_refused_in_time_and_take_few_threads(monkeypatch) -> None:
    release, asked = threading.Event(), []

    def tarpit(host: str, *_: object, **__: object) -> list:
        asked.append(host)
        release.wait(30)
        raise socket.gaierror

    async def admitted(number: int) -> ApiProblem:
        with pytest.raises(ApiProblem) as caught:
            await service.admit(SETTINGS, f"https://host-{number}.example/")
        return caught.value

    async def play() -> list[ApiProblem]:
        return await asyncio.gather(*map(admitted, range(20)))

    monkeypatch.setattr(socket, "getaddrinfo", tarpit)
    monkeypatch.setattr(service, "RESOLVE_SECONDS", 0.05)
    try:
        problems = asyncio.run(play())
    finally:
        release.set()
    assert {(problem.status, problem.code, problem.errors[0].where) for problem in problems} == {
        (422, "url-refused", "url")
    }
    assert len(asked) <= 4
