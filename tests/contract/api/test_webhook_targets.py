"""Where deliveries do not go, whatever a URL or a receiver says."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tests.contract.api.receivers import status

from l3ps_platform.catalog import webhooks


@contextmanager
def nobody_comes(address: str) -> Iterator[int]:
    """A port at which nobody may have knocked in the end."""
    with socket.socket() as listener:
        listener.bind((address, 0))
        listener.listen()
        yield listener.getsockname()[1]
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.accept()


def test_a_redirect_into_a_forbidden_network_is_not_followed(receiver, hooked, ping, delivered):
    with nobody_comes("127.0.0.2") as port:
        receiver.answer(*[status(code, Location=f"http://127.0.0.2:{port}/") for code in (302, 307, 308)])
        hook = hooked(receiver.url)
        row = delivered(hook, ping(hook))
        assert row["state"] == "failed"
        assert [attempt["status"] for attempt in row["log"]] == [302, 307, 308]


@pytest.mark.parametrize(
    "host", ["127.0.0.2", "2130706434", "0x7f000002", "0177.0.0.2", "127.2", "[::ffff:127.0.0.2]", "0.0.0.0", "[::1]"]
)
def test_a_forbidden_address_is_refused_however_it_is_written(service, host):
    with nobody_comes("127.0.0.2") as port:
        answer = service.http.post("/v1/webhooks", json={"url": f"http://{host}:{port}/hook"})
        (error,) = service.refused(answer, 422, "url-refused")["errors"]
        assert error["where"] == "url" and error["remedy"]


@pytest.mark.once
def test_an_address_that_has_become_forbidden_is_refused_at_the_delivery(service, receiver, hooked, ping, delivered):
    """As when a name comes to mean another address; here the row is changed behind the API's back."""
    hook = hooked(receiver.url)
    with nobody_comes("127.0.0.2") as port:
        with service.catalog.transaction() as tx:
            webhooks.lock(tx.session, hook["id"]).url = f"http://127.0.0.2:{port}/hook"
        row = delivered(hook, ping(hook))
    assert row["state"] == "failed"
    assert {attempt["error"] for attempt in row["log"]} == {
        "not sent: '127.0.0.2' is no public address and no name of one"
    }
    assert receiver.got.empty()
