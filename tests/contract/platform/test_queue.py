"""What is on the wire, read from a real Redis."""

import base64
import json
from dataclasses import replace

import redis

from l3ps_platform import queue as queue_module
from l3ps_platform.catalog import QueueName, StageMessage, StageName
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
