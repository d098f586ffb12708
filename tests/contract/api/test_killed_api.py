"""An API that is killed outright between an effect's commit and its answer: the repetition finds the effect."""

import os
import signal
import sys
import threading

import httpx
import psycopg
import pytest
from tests.conftest import wait_until

from l3ps_cli.processes import Processes
from l3ps_cli.stack import free_port
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.settings import Settings

GATE = 42
HOLD_THE_ANSWER = f"""
CREATE FUNCTION hold() RETURNS trigger LANGUAGE plpgsql AS
  $$ BEGIN PERFORM pg_advisory_xact_lock({GATE}); RETURN NEW; END $$;
CREATE TRIGGER hold BEFORE UPDATE OF status ON requests FOR EACH ROW EXECUTE FUNCTION hold();
"""
"""The effect is committed first and its answer kept after that: the database makes the second wait for the test."""
UPLOAD = {"kind": "drive", "filename": "log.tar", "size": 9}
KEY = {"Idempotency-Key": "once"}


@pytest.fixture
def api(tmp_path, postgres_url, redis_server):
    """Starts an API on one PostgreSQL database, again and again; each on a port of its own."""
    upgrade(Settings(database_url=postgres_url).catalog_url)
    env = os.environ | {
        "L3PS_DATA_DIR": str(tmp_path),
        "L3PS_DATABASE_URL": postgres_url,
        "L3PS_REDIS_URL": redis_server.removesuffix("/0") + "/5",
        "L3PS_IDEMPOTENCY_LEASE_SECONDS": "1",
    }
    with Processes(tmp_path / "logs") as processes:

        def start() -> tuple[str, int]:
            port = free_port()
            child = processes.start(f"api-{port}", [sys.executable, "-m", "l3ps_api"], env | {"L3PS_PORT": str(port)})
            url = f"http://127.0.0.1:{port}"
            wait_until(lambda: alive(url))
            return url, child.pid

        yield start


def alive(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").is_success
    except httpx.TransportError:
        return False


@pytest.mark.services
def test_what_was_made_before_the_kill_answers_the_repetition(api, postgres_url):
    url, pid = api()
    with psycopg.connect(postgres_url, autocommit=True) as database:

        def ask(query: str):
            return database.execute(query).fetchall()

        database.execute(HOLD_THE_ANSWER)
        ask(f"SELECT pg_advisory_lock({GATE})")
        answers = []
        first = threading.Thread(target=lambda: answers.append(post(url)))
        first.start()
        wait_until(lambda: ask("SELECT 1 FROM pg_locks WHERE locktype = 'advisory' AND NOT granted"))
        os.kill(pid, signal.SIGKILL)
        first.join()
        assert answers == [None], "the client was left without an answer"
        ask(f"SELECT pg_advisory_unlock({GATE})")
        ((made,),) = ask("SELECT id FROM uploads")
        assert ask("SELECT result_kind, result_id, status FROM requests") == [("uploads", made, None)]

        url, _ = api()
        again = []
        wait_until(lambda: again.append(post(url)) or again[-1].status_code != 409)
        assert again[-1].status_code == 201, again[-1].text
        assert again[-1].json()["id"] == made
        assert ask("SELECT id FROM uploads") == [(made,)], "and it was made once"
        assert post(url).headers["idempotent-replay"] == "true"


def post(url: str) -> httpx.Response | None:
    try:
        return httpx.post(f"{url}/v1/uploads", json=UPLOAD, headers=KEY, timeout=30)
    except httpx.TransportError:
        return None
