"""Deliveries are believed when a signature fits, and only then."""

import base64
import hashlib
import hmac
import time

import pytest

from l3ps_client import webhooks

SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()
BODY = b'{"type":"job.succeeded","timestamp":"2026-11-23T12:00:00Z","data":{"id":"job_1","name":"Stra\xc3\x9fe"}}'


def signed(body=BODY, secret=SECRET, id="msg_1", at=None) -> dict[str, str]:
    at = int(time.time()) if at is None else at
    key = base64.b64decode(secret.removeprefix("whsec_"))
    digest = hmac.new(key, f"{id}.{at}.".encode() + body, hashlib.sha256).digest()
    signature = "v1," + base64.b64encode(digest).decode()
    return {"webhook-id": id, "webhook-timestamp": str(at), "webhook-signature": signature}


def test_the_vector_of_the_reference_libraries(monkeypatch):
    """The example that the Standard Webhooks libraries carry in their own tests."""
    monkeypatch.setattr(time, "time", lambda: 1614265330.0)
    headers = {
        "webhook-id": "msg_p5jXN8AQM9LWM0D4loKWxJek",
        "webhook-timestamp": "1614265330",
        "webhook-signature": "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=",
    }
    event = webhooks.verify(b'{"test": 2432232314}', headers, "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")
    assert event.document == {"test": 2432232314}
    webhooks.verify(b'{"test": 2432232314}', headers, "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")


def test_a_genuine_delivery_becomes_an_event():
    at = int(time.time()) - 10
    event = webhooks.verify(BODY, signed(at=at), SECRET)
    assert (event.id, event.kind, event.data) == ("msg_1", "job.succeeded", {"id": "job_1", "name": "Straße"})
    assert event.timestamp.timestamp() == at


def test_header_names_come_in_any_case():
    webhooks.verify(BODY, {name.title(): value for name, value in signed().items()}, SECRET)


def test_one_fitting_signature_among_several_will_do():
    """While a secret is rotated both sign; other schemes stand beside them."""
    headers = signed()
    other = signed(secret="whsec_" + base64.b64encode(b"x" * 24).decode())["webhook-signature"]
    headers["webhook-signature"] = f"v1a,abc {other} v1,%% {headers['webhook-signature']}"
    webhooks.verify(BODY, headers, SECRET)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda headers: headers | {"webhook-id": "msg_2"},
        lambda headers: headers | {"webhook-timestamp": str(int(headers["webhook-timestamp"]) - 1)},
        lambda headers: headers | {"webhook-signature": headers["webhook-signature"].replace("v1,", "v2,")},
        lambda headers: headers | {"webhook-signature": headers["webhook-signature"].removeprefix("v1,")},
        lambda headers: headers | {"webhook-signature": "v1,"},
        lambda headers: headers | {"webhook-signature": ""},
        lambda headers: headers | {"webhook-timestamp": "soon"},
        lambda headers: headers | {"webhook-timestamp": "9" * 400},
        lambda headers: {name: value for name, value in headers.items() if name != "webhook-id"},
        lambda headers: signed(b"other"),
        lambda headers: signed(secret="whsec_" + base64.b64encode(b"x" * 24).decode()),
    ],
)
def test_what_was_altered_is_not_believed(spoil):
    with pytest.raises(webhooks.BadSignature):
        webhooks.verify(BODY, spoil(signed()), SECRET)


@pytest.mark.parametrize("age", [301, -301])
def test_an_old_delivery_sent_again_is_not_believed(monkeypatch, age):
    now = 1_700_000_000
    monkeypatch.setattr(time, "time", lambda: float(now))
    with pytest.raises(webhooks.BadSignature, match="tolerated"):
        webhooks.verify(BODY, signed(at=now - age), SECRET)
    webhooks.verify(BODY, signed(at=now - age), SECRET, tolerance=400)


def test_a_body_that_is_no_json_is_not_believed():
    with pytest.raises(webhooks.BadSignature, match="JSON"):
        webhooks.verify(b"<html>", signed(b"<html>"), SECRET)


def test_a_secret_that_is_none_is_the_callers_mistake():
    with pytest.raises(ValueError, match="whsec_"):
        webhooks.verify(BODY, signed(), "not base64!")
