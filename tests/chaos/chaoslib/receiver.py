"""A webhook receiver that answers as told and remembers what came."""

import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

Answer = Callable[[int], tuple[int, dict[str, str]]]
"""The status and headers of the how-manieth answer, from 1."""


def taken(_: int) -> tuple[int, dict[str, str]]:
    return 200, {}


def slowly(seconds: float) -> Answer:
    """Takes what comes after a while, so that there always is something under way."""

    def answer(_: int) -> tuple[int, dict[str, str]]:
        time.sleep(seconds)
        return 200, {}

    return answer


class Receiver:
    """Listens on a loopback address; ``received`` holds the id and body of every message."""

    def __init__(self, host: str, answer: Answer = taken) -> None:
        received: list[tuple[str | None, bytes]] = []
        self.received = received

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                received.append((self.headers.get("webhook-id"), body))
                status, headers = answer(len(received))
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = _Server((host, 0), Handler)
        self.url = f"http://{host}:{self._server.server_address[1]}/hook"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def ids(self) -> set[str | None]:
        """Of the messages that came."""
        return {id for id, _ in self.received}

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: object) -> None:
        """A sender that was killed in the middle is what this is for."""
