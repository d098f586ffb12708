"""Waiting for a job: told by events, taken up where the stream broke, asking where there are none, and with an end."""

from contextlib import contextmanager

import pytest

from l3ps_client import Client, Event, Forbidden, TimedOut, Unreachable
from l3ps_client._sse import events

from .conftest import AT_ONCE, reply, serving


class Jobs:
    """One job and its stream of events.

    Attributes:
        states: of the job, the next one at each event; the last one stays.
        streams: what each coming connection to the stream is sent: text, or a status to refuse it with.
        seen: ``Last-Event-ID`` of each connection.
    """

    def __init__(self, states, streams):
        self.states, self.streams, self.seen, self.looks = states, streams, [], 0

    def answer(self, handler):
        if "/events" not in handler.path:
            self.looks += 1
            etag = f'"{self.states[0]}"'
            if handler.headers.get("if-none-match") == etag:
                reply(handler, 304, None, {"ETag": etag})
            else:
                reply(handler, 200, {"id": "job_1", "state": self.states[0]}, {"ETag": etag})
            return
        self.seen.append(handler.headers.get("last-event-id"))
        stream = self.streams.pop(0)
        if len(self.states) > 1 and stream != 503:
            self.states.pop(0)
        if isinstance(stream, int):
            reply(handler, stream, None if stream == 204 else {"detail": "No."})
            return
        handler.send_response(200)
        handler.send_header("content-type", "text/event-stream")
        handler.send_header("connection", "close")
        handler.end_headers()
        handler.wfile.write(stream.encode())
        handler.close_connection = True


@contextmanager
def jobs(states, streams):
    stand_in = Jobs(states, streams)
    with serving(stand_in.answer) as http, Client(http.url, retry=AT_ONCE) as stand_in.client:
        yield stand_in


def event(id, kind="job.running"):
    return f'id: {id}\nevent: {kind}\ndata: {{"id": "job_1"}}\n\n'


def test_a_wait_ends_with_the_job_and_tells_each_change_once():
    with jobs(["queued", "running", "succeeded"], [event(1), event(2)]) as service:
        told = []
        job = service.client.jobs.wait("job_1", progress=lambda job: told.append(job["state"]))
        assert job["state"] == "succeeded"
        assert told == ["queued", "running", "succeeded"]


def test_a_job_that_is_over_is_not_listened_for():
    with jobs(["failed"], []) as service:
        assert service.client.jobs.wait("job_1")["state"] == "failed"
        assert (service.looks, service.seen) == (1, [])


def test_a_broken_stream_is_taken_up_after_its_last_event():
    with jobs(["queued", "running", "running", "succeeded"], [event(7), 503, event(8), event(9)]) as service:
        service.client.jobs.wait("job_1")
        assert service.seen == [None, "7", "7", "8"]


@pytest.mark.parametrize("status", [404, 406])
def test_a_service_without_events_is_asked_instead(status):
    with jobs(["queued", "succeeded"], [status]) as service:
        assert service.client.jobs.wait("job_1")["state"] == "succeeded"
        assert service.seen == [None]


def test_a_stream_that_is_forbidden_is_a_refusal():
    with jobs(["queued"], [403]) as service, pytest.raises(Forbidden):
        service.client.jobs.wait("job_1")


def test_a_wait_has_an_end():
    with jobs(["running"], []) as service, pytest.raises(TimedOut, match="goes on"):
        service.client.jobs.wait("job_1", timeout=0.05, poll=0.01)


def test_what_has_not_changed_is_told_once():
    told = []
    with jobs(["running"], []) as service:
        with pytest.raises(TimedOut):
            service.client.jobs.wait("job_1", timeout=0.2, poll=0.01, progress=told.append)
        assert service.looks > 1
    assert told == [{"id": "job_1", "state": "running"}]


def test_events_are_followed_over_broken_connections():
    with jobs(["running"], [event(0, "open") + event(1) + event(2), 503, event(3), 403]) as service:
        followed = service.client.events.follow(kinds=["job.running"])
        got = [next(followed).id for _ in range(3)]
        assert got == ["1", "2", "3"]
        with pytest.raises(Forbidden):
            next(followed)
        assert service.seen == [None, "2", "2", "3"]


def test_the_events_of_a_job_end_when_there_will_be_no_more():
    with jobs(["running"], [event(1), "", event(2), 204]) as service:
        assert [event.id for event in service.client.jobs.events("job_1")] == ["1", "2"]
        assert service.seen == [None, "1", "1", "2"]


def test_a_stream_that_never_comes_back_is_reported():
    with jobs(["running"], [503] * 20) as service, pytest.raises(Unreachable):
        next(service.client.jobs.events("job_1"))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_events_are_read_as_the_specification_says(end):
    first = [": hello", "retry: 10", "id: 1", "event: a", 'data: {"x":', "data:1}", ""]
    text = end.join([*first, "data: \u2028text", "", "data: cut off"])
    for size in (1, 3, 1000):
        blocks = [text.encode()[start : start + size] for start in range(0, len(text.encode()), size)]
        got = [event for event in events(blocks) if event is not None]
        assert got == [Event("1", "a", {"x": 1}), Event("1", "message", "\u2028text")]


def test_a_comment_is_a_sign_of_life():
    assert list(events([b":\n\n"])) == [None]
