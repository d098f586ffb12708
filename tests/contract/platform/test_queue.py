"""What is on the wire, read from a real Redis."""

import base64
import json
import socket
from dataclasses import replace

import pytest
import redis

from l3ps_platform import queue as queue_module
from l3ps_platform.catalog import QueueName, StageMessage, StageName
from l3ps_platform.errors import QueueUnavailable
from l3ps_platform.queue import Queue, make_app
from l3ps_platform.settings import Settings

MESSAGE = StageMessage("stg_1", 2, StageName.REFINE, QueueName.REFINE)


def test_a_message_carries_a_stage_s_id_and_attempt_and_nothing_else(redis_url: str) -> None:
    Queue(Settings(redis_url=redis_url)).send([MESSAGE])
    with redis.Redis.from_url(redis_url) as client:
        (raw,) = client.lrange("refine", 0, -1)
    message = json.loads(raw)
    args, kwargs, _ = json.loads(base64.b64decode(message["body"]))
    assert (args, kwargs) == (["stg_1", 2], {})
    assert message["headers"]["task"] == "l3ps.refine"


def test_depth_and_pending(redis_url: str) -> None:
    queue = Queue(Settings(redis_url=redis_url))
    queue.send([MESSAGE, StageMessage("stg_2", 1, StageName.SEGMENT, QueueName.SEGMENT)])
    assert queue.depth() == {QueueName.SEGMENT: 1, QueueName.REFINE: 1, QueueName.TRAIN: 0}
    assert queue.pending(QueueName.REFINE) == {("stg_1", 2)}


def test_pending_passes_over_foreign_messages(redis_url: str) -> None:
    queue = Queue(Settings(redis_url=redis_url))
    queue.send([MESSAGE])
    with redis.Redis.from_url(redis_url) as client:
        client.rpush("refine", b"not json", b"[]", b'{"headers": {"id": "of-someone-else"}}')
    assert queue.pending(QueueName.REFINE) == {("stg_1", 2)}


def test_pending_passes_over_none_of_a_long_queue_that_grows_meanwhile(redis_url: str, monkeypatch) -> None:
    monkeypatch.setattr(queue_module, "_READ", 3)
    queue = Queue(Settings(redis_url=redis_url))
    there = [StageMessage(f"stg_{n}", 1, StageName.REFINE, QueueName.REFINE) for n in range(10)]
    queue.send(there)
    lrange, later = queue._redis.lrange, [replace(MESSAGE, attempt=n) for n in range(100, 104)]

    def meanwhile(*args: int) -> list[bytes]:
        found = lrange(*args)
        if later:
            queue.send([later.pop()])
        return found

    monkeypatch.setattr(queue._redis, "lrange", meanwhile)
    assert {(message.stage_id, 1) for message in there} <= queue.pending(QueueName.REFINE)


def test_a_redis_that_takes_connections_and_never_answers_is_not_waited_for(monkeypatch) -> None:
    """As one that is stopped, or behind a network that drops what it carries."""
    monkeypatch.setattr(queue_module, "SENDER_WAITS", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        queue = Queue(Settings(redis_url=f"redis://127.0.0.1:{server.getsockname()[1]}/0"))
        with pytest.raises(QueueUnavailable, match="does not answer"):
            queue.send([MESSAGE] * 100)


def test_workers_wait_longer_for_an_answer_than_redis_waits_for_a_message() -> None:
    app = make_app(Settings())
    with app.connection_for_read() as connection:
        assert app.conf.broker_transport_options["socket_timeout"] > 2 * connection.transport.brpop_timeout


def test_the_visibility_timeout_is_the_same_in_all_three_places() -> None:
    """The shortest wins, and a stage that outlives it would be started a second time."""
    conf = make_app(Settings()).conf
    timeouts = {
        conf.visibility_timeout,
        conf.broker_transport_options["visibility_timeout"],
        conf.result_backend_transport_options["visibility_timeout"],
    }
    assert len(timeouts) == 1
    assert timeouts.pop() > Settings().stage_seconds
