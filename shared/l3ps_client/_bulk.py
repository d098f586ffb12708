"""Large bodies as the standard library reads them: a megabyte at a time, straight into a buffer.

httpx takes 64 KB from the socket at a time, by way of a parser that copies them: 1.2 s of processor time a gigabyte,
where this takes 0.5 s (two cores, loopback). So a file of gigabytes comes this way, everything else by httpx.
"""

from __future__ import annotations

import http.client
import ssl
from collections.abc import Iterator
from contextlib import contextmanager

import httpx

BULK = 8 << 20
"""Bytes from which on a connection of its own is worth it."""
_BLOCK = 1 << 20


class BulkTransport(httpx.BaseTransport):
    """One connection for each request, without a body, and the answer in large blocks. It knows no proxy.

    Args:
        context: the certificates to trust.
    """

    def __init__(self, context: ssl.SSLContext) -> None:
        self._context = context

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request; its failures are httpx's."""
        limits = request.extensions.get("timeout", {})
        connection = self._connection(request.url, limits.get("connect"))
        try:
            with _as_of_httpx(httpx.ConnectError):
                connection.connect()
            with _as_of_httpx(httpx.ReadError):
                connection.sock.settimeout(limits.get("read"))
                target = request.url.raw_path.decode("ascii")
                connection.putrequest(request.method, target, skip_host=True, skip_accept_encoding=True)
                for name, value in request.headers.multi_items():
                    connection.putheader(name, value)
                connection.endheaders()
                answer = connection.getresponse()
        except BaseException:
            connection.close()
            raise
        return httpx.Response(answer.status, headers=answer.getheaders(), stream=_Body(connection, answer))

    def _connection(self, url: httpx.URL, timeout: float | None) -> http.client.HTTPConnection:
        if url.scheme == "https":
            return http.client.HTTPSConnection(url.host, url.port, timeout=timeout, context=self._context)
        return http.client.HTTPConnection(url.host, url.port, timeout=timeout)


class _Body(httpx.SyncByteStream):
    def __init__(self, connection: http.client.HTTPConnection, answer: http.client.HTTPResponse) -> None:
        self._connection, self._answer = connection, answer

    def __iter__(self) -> Iterator[bytes]:
        buffer = memoryview(bytearray(_BLOCK))
        while True:
            with _as_of_httpx(httpx.ReadError):
                count = self._answer.readinto(buffer)
            if not count:
                break
            yield bytes(buffer[:count])
        if self._answer.length:
            raise httpx.RemoteProtocolError(f"the connection ended {self._answer.length} bytes before the body did")

    def close(self) -> None:
        self._answer.close()
        self._connection.close()


@contextmanager
def _as_of_httpx(kind: type[httpx.NetworkError]) -> Iterator[None]:
    try:
        yield
    except TimeoutError as error:
        late = httpx.ConnectTimeout if kind is httpx.ConnectError else httpx.ReadTimeout
        raise late(str(error)) from error
    except OSError as error:
        raise kind(str(error)) from error
    except http.client.HTTPException as error:
        raise httpx.RemoteProtocolError(f"{type(error).__name__}: {error}") from error
