"""The queue: Celery on Redis, used as a doorbell.

A message is ``(stage id, attempt)``. It says "look at this row"; whether there is something to do, and for whom, the
catalog decides. So the queue may lose, delay and repeat messages, and no result is kept in it.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from typing import Any, cast

import redis
from celery import Celery
from celery.exceptions import OperationalError as CeleryOperationalError
from kombu.entity import Exchange
from kombu.entity import Queue as KombuQueue
from kombu.exceptions import OperationalError as KombuOperationalError

from l3ps_platform.catalog.session import StageMessage
from l3ps_platform.catalog.states import QueueName, StageName
from l3ps_platform.errors import QueueUnavailable
from l3ps_platform.settings import Settings

TASK_NAMES = {name: f"l3ps.{name.value}" for name in StageName}
"""Which Celery task does which stage."""

_UNACKED, _UNACKED_INDEX = "unacked", "unacked_index"
"""Where kombu keeps the messages that were delivered and not acknowledged."""
_READ = 1000
"""Messages read at a time, a kB each: 100,000 at once would be 100 MB in the API and hold Redis up for all others."""


WORKER_WAITS = 10.0
"""Seconds within which Redis must answer a worker. Those of a worker that asks for messages are answered after one
second at the latest (kombu's ``brpop_timeout``), message or not."""
SENDER_WAITS = 2.0
"""The same for a sender. A request is waiting for it, and what is not sent the reconciler sends later."""


def make_app(settings: Settings, redis_waits: float = WORKER_WAITS) -> Celery:
    """The Celery application of workers and clients alike.

    Args:
        settings: where the queue is, and how long stages take.
        redis_waits: seconds within which Redis must answer. Without a limit a Redis that hangs, or a connection that
            was cut in silence, is waited for until the kernel gives it up, after hours.
    """
    app = Celery("l3ps", broker=settings.broker_url)
    transport = {
        # The shortest of the three places wins, so all three get the same.
        "visibility_timeout": settings.visibility_seconds,
        # At kombu's defaults the unacknowledged messages of a killed worker were looked at after 100 s.
        "unacked_restore_interval": 1,
        "unacked_restore_throttle": 1,
        "socket_connect_timeout": 2,
        "socket_timeout": redis_waits,
        "socket_keepalive": True,
        "health_check_interval": 25,
    }
    app.conf.update(
        broker_transport_options=transport,
        result_backend=None,
        result_backend_transport_options={"visibility_timeout": settings.visibility_seconds},
        visibility_timeout=settings.visibility_seconds,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,  # a worker waits for Redis however long it takes
        task_queues=[KombuQueue(name.value, Exchange(name.value), routing_key=name.value) for name in QueueName],  # type: ignore[no-untyped-call]
        task_default_queue=QueueName.REFINE.value,
        task_create_missing_queues=False,
        task_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        task_store_errors_even_if_ignored=False,
        # A message is acknowledged when its stage's row is written. If the process dies before that, acks_late alone
        # acknowledges it as failed, and that is wanted: the lease runs out, the reconciler counts the attempt and
        # sends a new message. Requeueing here instead (reject_on_worker_lost) loops for ever on a stage that is
        # killed for memory.
        task_acks_late=True,
        task_reject_on_worker_lost=False,
        task_acks_on_failure_or_timeout=True,
        # One stage in hand, none in reserve: a reserved one would wait behind a long one while other workers idle,
        # and the prefetch counter drifts with acks_late.
        worker_prefetch_multiplier=1,
        worker_disable_prefetch=True,
        # For so long a result of a child that died is waited for, while its slot takes nothing; ours are rows.
        worker_lost_wait=1.0,
        worker_cancel_long_running_tasks_on_connection_loss=False,  # the lease, not the connection, is ownership
        task_time_limit=settings.stage_seconds,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        worker_send_task_events=False,
        worker_enable_remote_control=True,
        task_publish_retry_policy={"max_retries": 1, "interval_start": 0, "interval_step": 0.2, "interval_max": 0.2},
    )
    return app


class Queue:
    """Sending side and gauges of the queue."""

    def __init__(self, settings: Settings) -> None:
        self._app = make_app(settings, SENDER_WAITS)
        self._redis: redis.Redis = redis.Redis.from_url(
            settings.redis_url, socket_connect_timeout=2, socket_timeout=5, health_check_interval=25
        )

    def send(self, messages: Sequence[StageMessage]) -> None:
        """Send messages. QueueUnavailable when Redis does not take them."""
        try:
            with self._app.producer_pool.acquire(block=True, timeout=5) as producer:
                for message in messages:
                    self._app.send_task(
                        TASK_NAMES[message.name],
                        args=(message.stage_id, message.attempt),
                        queue=message.queue.value,
                        task_id=f"{message.stage_id}:{message.attempt}",
                        producer=producer,
                        ignore_result=True,
                    )
        except (CeleryOperationalError, KombuOperationalError, redis.RedisError, OSError) as error:
            raise QueueUnavailable(f"the queue does not answer: {error}") from error

    def depth(self) -> dict[QueueName, int]:
        """Messages waiting in each queue."""
        with _RedisErrors():
            return {name: self._redis.llen(name.value) for name in QueueName}

    def pending(self, queue: QueueName) -> set[tuple[str, int]]:
        """The (stage id, attempt) of every message that waits in a queue from the beginning of the call to its end."""
        found: set[tuple[str, int]] = set()
        first = 0
        with _RedisErrors():
            # New messages come in before the first and move the others on, so that some are read twice and none is
            # passed over; what is taken leaves at the end.
            while raw := cast("list[bytes]", self._redis.lrange(queue.value, first, first + _READ - 1)):
                found.update(pair for message in raw if (pair := _identity(message)) is not None)
                first += len(raw)
        return found

    def delivered(self) -> dict[str, tuple[str, int]]:
        """The (stage id, attempt) of every message that a worker took and has not acknowledged, by its tag.

        Those of a worker that was killed stay until they are delivered again.
        """
        with _RedisErrors():
            raw = cast("dict[bytes, bytes]", self._redis.hgetall(_UNACKED))
        found = {tag.decode(): _identity(entry) for tag, entry in raw.items()}
        return {tag: pair for tag, pair in found.items() if pair is not None}

    def drop(self, tags: Collection[str]) -> None:
        """Forget messages of :meth:`delivered`; a worker that acknowledges one later does no harm."""
        with _RedisErrors(), self._redis.pipeline() as pipe:
            pipe.zrem(_UNACKED_INDEX, *tags)
            pipe.hdel(_UNACKED, *tags)
            pipe.execute()

    def ping(self) -> None:
        """Raise QueueUnavailable unless Redis answers."""
        with _RedisErrors():
            self._redis.ping()

    def close(self) -> None:
        """Close the connections."""
        self._app.close()
        self._redis.close()


class _RedisErrors:
    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, redis.RedisError | OSError):
            raise QueueUnavailable(f"the queue does not answer: {error}") from error


def _identity(message: bytes) -> tuple[str, int] | None:
    """Of a message as it lies in a queue, or with where it came from among the delivered ones."""
    try:
        found = json.loads(message)
        content = found[0] if isinstance(found, list) else found
        stage_id, _, attempt = content["headers"]["id"].rpartition(":")
        return stage_id, int(attempt)
    except (ValueError, LookupError, TypeError, AttributeError):
        return None  # not one of ours
