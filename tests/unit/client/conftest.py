"""Servers that misbehave on cue, as networks, stores and busy services do, and clients that do not wait long for them.

What the service does when all is well is tested on the service itself, in tests/contract/api/test_sdk.py.
"""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from l3ps_client import Client, Retry

AT_ONCE = Retry(first=0.0)


@contextmanager
def serving(answer) -> Iterator[ThreadingHTTPServer]:
    """A server on loopback; ``answer(handler)`` answers each request."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do(self):
            answer(self)

        do_GET = do_PUT = do_POST = do_DELETE = do_PATCH = do  # noqa: N815

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        http.daemon_threads = True
        thread = threading.Thread(target=http.serve_forever, args=(0.02,))
        thread.start()
        http.url = f"http://127.0.0.1:{http.server_port}"
        try:
            yield http
        finally:
            http.shutdown()
            thread.join()


def reply(handler, status=200, document=None, headers=(), body=None, declared=None) -> None:
    """Send an answer; one that declares more than it sends breaks off."""
    content = body if body is not None else b"" if document is None else json.dumps(document).encode()
    handler.send_response(status)
    for name, value in dict(headers).items():
        handler.send_header(name, value)
    handler.send_header("content-length", str(len(content) if declared is None else declared))
    handler.end_headers()
    handler.wfile.write(content)
    handler.close_connection = declared is not None


@pytest.fixture
def server():
    """A server that answers each request with the next step of its script: (status, headers, body, declared length)."""

    def answer(handler):
        taken = handler.rfile.read(int(handler.headers.get("content-length", 0)))
        seen.append(
            (handler.command, handler.path, taken, {name.lower(): value for name, value in handler.headers.items()})
        )
        status, headers, body, declared = script.pop(0)
        reply(handler, status, None, headers, body, declared)

    script, seen = [], []
    with serving(answer) as http:
        http.script, http.seen = script, seen
        yield http


@pytest.fixture
def client(server, tmp_path):
    """A client of ``server``, with its notes in a folder of its own."""
    with Client(server.url, "s3cret", retry=AT_ONCE, state=tmp_path / "notes") as client:
        yield client


class Service:
    """Uploads as the service takes them, kept in memory, with faults on demand.

    Attributes:
        uploads: by id: the announcement, ``state`` and ``parts`` by number.
        seen: (method, path) of every request.
        faults: called with (method, path) before a request is carried out; what one returns is the answer instead.
    """

    PART = 64 << 10

    def __init__(self) -> None:
        self.uploads: dict = {}
        self.keys: dict = {}
        self.seen: list = []
        self.faults: list = []
        self.signature = "1"
        self._lock = threading.Lock()

    def puts(self) -> list[int]:
        """Numbers of the parts that were sent, in the order in which they came."""
        return [int(path.split("/")[3].partition("?")[0]) for method, path in self.seen if method == "PUT"]

    def answer(self, handler) -> None:
        path = handler.path
        length = int(handler.headers.get("content-length", 0))
        body = b""
        while len(body) < length and (block := handler.rfile.read(min(16 << 10, length - len(body)))):
            body += block
        if len(body) < length:
            return  # the client died
        with self._lock:
            self.seen.append((handler.command, path))
            for fault in self.faults:
                if (instead := fault(handler.command, path)) is not None:
                    reply(handler, *instead)
                    return
            reply(handler, *self._done(handler, path, body))

    def _done(self, handler, path, body):
        method = handler.command
        if method == "PUT":
            _, _, upload, rest = path.split("/")
            number, _, signature = rest.partition("?")
            if signature != self.signature:
                return 403, {"detail": "The URL has expired."}
            if self.uploads[upload].get("joined"):
                return 404, None, {}, b"<Code>NoSuchUpload</Code>"
            self.uploads[upload]["parts"][int(number)] = body
            return 200, None, {"ETag": f'"{hashlib.md5(body).hexdigest()}"'}
        document = json.loads(body) if body else {}
        if (method, path) == ("POST", "/v1/uploads"):
            key = handler.headers["idempotency-key"]
            if key not in self.keys:
                self.keys[key] = id = f"upl_{len(self.uploads) + 1}"
                self.uploads[id] = {"announced": document, "state": "open", "parts": {}}
            id = self.keys[key]
            return 201, self._document(id) | {"parts": self._urls(id, self._numbers(id))}
        id, _, act = path.removeprefix("/v1/uploads/").partition("/")
        if id not in self.uploads:
            return 404, {"type": "urn:l3ps:problem:unknown-upload", "detail": f"There is no upload {id!r}."}
        if method == "DELETE":
            self.uploads[id]["state"] = "aborted"
            return (204,)
        if act == "parts":
            return 200, {"parts": self._urls(id, document["numbers"])}
        if act == "complete":
            self.uploads[id] |= {"state": "complete", "completion": document}
            return 200, {"id": "drv_1", "name": document.get("name", "log")}
        parts = self.uploads[id]["parts"].items()
        received = [{"number": n, "size": len(data), "etag": hashlib.md5(data).hexdigest()} for n, data in parts]
        joined = self.uploads[id].get("joined", False)
        return 200, self._document(id) | {"received": [] if joined else received, "joined": joined}

    def _document(self, id):
        upload = self.uploads[id]
        fixed = {"id": id, "state": upload["state"], "result_id": None, "part_size": self.PART}
        return fixed | {name: upload["announced"][name] for name in ("kind", "filename", "size")}

    def _numbers(self, id):
        return range(1, -(-self.uploads[id]["announced"]["size"] // self.PART) + 1)

    def _urls(self, id, numbers):
        return [{"number": number, "url": f"/part/{id}/{number}?{self.signature}"} for number in numbers]

    def whole(self, id) -> bytes:
        """The bytes of an upload."""
        return b"".join(self.uploads[id]["parts"][number] for number in self._numbers(id))


@pytest.fixture
def service():
    """A service that takes uploads."""
    service = Service()
    with serving(service.answer) as http:
        service.url = http.url
        yield service
