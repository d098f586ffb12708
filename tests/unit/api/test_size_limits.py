"""Bodies that do not come."""

import asyncio

import httpx
import pytest

from l3ps_api import middleware
from l3ps_api.app import create_app
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.settings import Settings


@pytest.fixture
def app(tmp_path, monkeypatch):
    """The API on files below a folder; a body has a moment."""
    monkeypatch.setattr(middleware, "BODY_SECONDS", 0.05)
    settings = Settings(data_dir=tmp_path, redis_url="redis://127.0.0.1:1/0")
    upgrade(settings.catalog_url)
    return create_app(settings)


@pytest.mark.parametrize("key", [{}, {"idempotency-key": "k"}, {"if-match": '"x"'}])
def test_a_body_that_stays_away_is_not_waited_for(app, key) -> None:
    sent = asyncio.run(post(app, key))
    assert sent.status_code == 408
    assert sent.headers["content-type"] == "application/problem+json"
    assert sent.json()["errors"][0]["where"] == "body"
    assert "within" in sent.json()["detail"]


async def post(app, headers: dict) -> httpx.Response:
    async def body():
        yield b"{"
        await asyncio.Event().wait()

    method, path = ("PUT", "/v1/retention") if "if-match" in headers else ("POST", "/v1/jobs")
    transport = httpx.ASGITransport(app)
    async with asyncio.timeout(30), httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
        return await http.request(method, path, content=body(), headers=headers)
