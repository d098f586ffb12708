"""What the S3 store makes of connections that break off: a real MinIO behind a wire that is cut."""

import hashlib
import os
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from l3ps_platform.errors import StoreUnavailable
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.settings import MiB, Settings


class Wire:
    """A TCP connection to a server that is cut after so many bytes of its answers, as often as ``cuts`` says."""

    def __init__(self, host: str) -> None:
        self.server = tuple(host.rsplit(":", 1))
        self.cuts: list[int] = []
        self.requests: list[bytes] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection((self.server[0], int(self.server[1])))
                threading.Thread(target=self._upward, args=(client, server), daemon=True).start()
                threading.Thread(target=self._downward, args=(server, client), daemon=True).start()

    def _upward(self, client: socket.socket, server: socket.socket) -> None:
        with suppress(OSError):
            while data := client.recv(65536):
                if data.startswith(b"GET"):
                    self.requests.append(data)
                server.sendall(data)

    def _downward(self, server: socket.socket, client: socket.socket) -> None:
        left = None
        with suppress(OSError):
            while data := server.recv(65536):
                if left is None and self.cuts:
                    left = self.cuts.pop(0)
                if left is not None and len(data) >= left:
                    client.sendall(data[:left])
                    break
                client.sendall(data)
                left = None if left is None else left - len(data)
        for end in (client, server):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


@pytest.fixture
def wire(minio_server: str) -> Iterator[Wire]:
    made = Wire(minio_server.rpartition("@")[2])
    yield made
    made.close()


@pytest.fixture
def cut(s3_url: str, wire: Wire) -> ObjectStore:
    """A store behind the wire, with one object of 8 MiB."""
    sound = open_store(Settings(objects_url=s3_url))
    sound.ensure()
    sound.put_bytes("big", BODY)
    credentials, bucket = s3_url.removeprefix("s3://").split("@")[0], s3_url.rpartition("/")[2]
    return open_store(Settings(objects_url=f"s3://{credentials}@{wire.address}/{bucket}"))


BODY = os.urandom(8 * MiB)


def test_a_read_that_breaks_off_goes_on_where_it_stopped(cut: ObjectStore, wire: Wire, tmp_path: Path) -> None:
    wire.cuts = [3 * MiB, 2 * MiB]
    cut.get_file("big", tmp_path / "big")
    assert hashlib.sha256((tmp_path / "big").read_bytes()).digest() == hashlib.sha256(BODY).digest()
    assert len(wire.requests) == 3
    ranges = [re.search(rb"Range: bytes=(\d+)-", request) for request in wire.requests[1:]]
    assert [int(found[1]) for found in ranges if found] == [2 * MiB, 3 * MiB], "on from the last whole block"


@pytest.mark.parametrize("read", ["get_bytes", "get_file"])
def test_a_body_that_stays_truncated_is_never_taken_for_the_whole(cut, wire, tmp_path: Path, read: str) -> None:
    wire.cuts = [MiB] + [2000] * 40
    with pytest.raises(StoreUnavailable, match=r"broke off|does not answer"):
        if read == "get_file":
            cut.get_file("big", tmp_path / "big")
        else:
            cut.get_bytes("big")
    assert list(tmp_path.glob("big*")) == []


def test_an_object_that_is_replaced_while_it_is_read_is_not_mixed_with_the_new_one(cut, wire, s3_url: str) -> None:
    wire.cuts = [3 * MiB]
    with pytest.raises(StoreUnavailable), cut.open("big") as stream:
        stream.read(1000)
        open_store(Settings(objects_url=s3_url)).put_bytes("big", bytes(8 * MiB))
        stream.read()


def test_a_stream_can_begin_anywhere(store: ObjectStore) -> None:
    store.put_bytes("a", b"0123456789")
    for offset in (0, 4, 9, 10, 11):
        with store.open("a", offset) as stream:
            assert stream.read() == b"0123456789"[offset:]
