"""Where webhooks may go, how they are signed and when they are tried again, without a network."""

import base64
import hashlib
import hmac
import json
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from ipaddress import ip_network
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps_client.webhooks import verify
from l3ps_platform.catalog.kinds import EventKind, select_kinds, wanted
from l3ps_platform.errors import TargetRefused
from l3ps_platform.settings import Settings
from l3ps_platform.webhooks import Guard, new_secret
from l3ps_platform.webhooks.schedule import JITTER, LONGEST, read_retry_after, wait_before
from l3ps_platform.webhooks.signing import headers, sign

VECTORS = json.loads((Path(__file__).parents[2] / "vectors" / "webhooks.json").read_text())
NOW = datetime(2026, 11, 23, 12, 0, tzinfo=UTC)


def guard(*addresses: str, allow: tuple[str, ...] = (), http: bool = False) -> Guard:
    """A guard for whose resolver every name means these addresses."""
    return Guard([ip_network(each) for each in allow], http=http, resolver=lambda host, port: addresses)


FORBIDDEN = [
    *("127.0.0.1", "127.0.0.2", "0.0.0.0", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1"),
    *("192.0.0.192", "192.0.2.1", "192.88.99.1", "198.18.0.1", "203.0.113.9", "224.0.0.1", "240.0.0.1"),
    "255.255.255.255",
    *("::", "::1", "fe80::1", "fe80::1%eth0", "fc00::1", "fd00:ec2::254", "fec0::1", "ff02::1", "2001:db8::1"),
    *("::ffff:127.0.0.1", "::ffff:10.0.0.1", "::127.0.0.1", "64:ff9b::7f00:1", "64:ff9b::a9fe:a9fe"),
    *("64:ff9b:1::808:808", "2002:7f00:1::", "2002:a00:1::1", "2001:0:808:808::1", "100::1", "4000::1"),
]


@pytest.mark.parametrize("address", FORBIDDEN)
def test_what_is_not_public_is_refused_also_beside_a_public_address(address) -> None:
    for addresses in ([address], ["8.8.8.8", address], [address, "2606:4700::1111"]):
        with pytest.raises(TargetRefused, match="is no public address and no name of one") as caught:
            guard(*addresses).admit("https://hooks.example/x")
        assert "L3PS_WEBHOOK_ALLOW" in caught.value.remedy
        assert address not in str(caught.value), "the network's addresses are nobody's business"


@pytest.mark.parametrize("address", ["8.8.8.8", "2606:4700::1111", "2002:808:808::1", "64:ff9b::808:808"])
def test_what_is_public_is_admitted(address) -> None:
    assert [str(found) for found in guard(address).admit("https://hooks.example/x").addresses] == [address]


def test_the_target_is_the_address_that_was_looked_at_under_the_name_that_was_given() -> None:
    target = guard("8.8.8.8", "8.8.4.4", "8.8.8.8").admit("https://hooks.example:8443/a?b=c#d")
    assert [str(target.at(address)) for address in target.addresses] == [
        "https://8.8.8.8:8443/a?b=c",
        "https://8.8.4.4:8443/a?b=c",
    ]
    assert target.url.netloc == b"hooks.example:8443"


def test_the_settings_allow_networks_and_nothing_beside_them() -> None:
    allowing = {"allow": ("127.0.0.1/32", "fd00::/8"), "http": True}
    assert guard("127.0.0.1", **allowing).admit("http://x:81/")
    assert guard("::ffff:127.0.0.1", **allowing).admit("http://x/")
    assert guard("fd00::5", **allowing).admit("http://x/")
    for address in ("127.0.0.2", "0.0.0.0", "::1", "10.0.0.1"):
        with pytest.raises(TargetRefused):
            guard("127.0.0.1", address, **allowing).admit("http://x/")


@pytest.mark.parametrize(
    "host",
    *[["127.0.0.2", "0.0.0.0", "[::1]", "[::ffff:7f00:2]", "2130706434", "0x7f000002", "0177.0.0.2", "127.2", "0"]],
)
def test_no_spelling_of_an_address_is_a_way_in(host) -> None:
    """With the system's own resolver, which reads them all; only 127.0.0.1 is allowed."""
    with pytest.raises(TargetRefused):
        Guard([ip_network("127.0.0.1/32")], http=True).admit(f"http://{host}:9999/")


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST", "localhost."])
def test_names_of_this_machine_are_refused(host) -> None:
    with pytest.raises(TargetRefused):
        Guard(http=True).admit(f"http://{host}/")


@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("http://hooks.example/", "not encrypted"),
        ("ftp://hooks.example/", "not a web address"),
        ("file:///etc/passwd", "not a web address"),
        ("gopher://hooks.example:70/", "not a web address"),
        ("hooks.example", "not a web address"),
        ("//hooks.example/x", "not a web address"),
        ("", "not a web address"),
        ("https://", "not a web address"),
        ("https://a\nb/", "not a URL"),
        ("https://xn--/", "not a URL"),
        ("https://xn--a/", "not a URL"),
        ("https://hooks.example:99999/", "port 99999"),
        ("https://hooks.example:0/", "port 0"),
        ("https://user:secret@hooks.example/", "holds credentials"),
        ("https://hooks.example/" + "a" * 2000, "2022 characters"),
        ("https://hooks.example:25/", "port 25"),
        ("https://hooks.example:22/", "port 22"),
    ],
)
def test_bad_urls_are_refused_with_a_reason_and_a_remedy(url, what) -> None:
    with pytest.raises(TargetRefused, match=what) as caught:
        guard("8.8.8.8").admit(url)
    assert caught.value.remedy.endswith(".")


def test_a_refusal_does_not_tell_whether_there_is_such_a_name() -> None:
    """Else whoever may make webhooks could ask for the names inside of the service's network."""

    def fails(host: str, port: int) -> list[str]:
        raise OSError("no such name")

    heard = set()
    too_many = [f"8.8.8.{n}" for n in range(40)]
    for resolver in (fails, lambda host, port: [], lambda host, port: ["10.0.0.1"], lambda host, port: too_many):
        with pytest.raises(TargetRefused) as caught:
            Guard(resolver=resolver).admit("https://hooks.example:81/")
        heard.add((caught.value.what, caught.value.remedy))
    assert len(heard) == 1


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_signatures_are_those_of_the_published_vectors(vector) -> None:
    made = headers(vector["secrets"], vector["id"], vector["timestamp"], vector["body"].encode())
    assert made == vector["headers"]
    for secret in vector["secrets"]:
        genuine = verify(vector["body"].encode(), made, secret, tolerance=float("inf"))
        assert genuine.id == vector["id"], "the client's own check agrees"


@given(st.text(min_size=1), st.integers(0, 2**40), st.binary(), st.binary(min_size=24, max_size=64))
def test_a_signature_is_the_hmac_of_id_time_and_body(id, timestamp, body, key) -> None:
    secret = base64.b64encode(key).decode()
    expected = hmac.new(key, b"%s.%d.%s" % (id.encode(), timestamp, body), hashlib.sha256).digest()
    assert sign(f"whsec_{secret}", id, timestamp, body) == "v1," + base64.b64encode(expected).decode()
    assert sign(secret, id, timestamp, body) == sign(f"whsec_{secret}", id, timestamp, body)


@given(st.binary(max_size=50), st.binary(max_size=50), st.integers(1, 2**33), st.integers(1, 2**33))
def test_what_differs_has_another_signature(one, other, early, late) -> None:
    secret = new_secret()
    signatures = {(body, time): sign(secret, "msg_1", time, body) for body in (one, other) for time in (early, late)}
    assert len(set(signatures.values())) == len(signatures)
    assert sign(new_secret(), "msg_1", early, one) not in signatures.values()


def test_a_secret_is_random_and_long_enough() -> None:
    secrets = {new_secret() for _ in range(50)}
    assert len(secrets) == 50
    assert all(24 <= len(base64.b64decode(each.removeprefix("whsec_"))) <= 64 for each in secrets)


def test_the_waits_are_the_specification_s_with_jitter() -> None:
    waits = Settings.model_fields["webhook_retry_seconds"].default
    assert waits == (0, 5, 300, 1800, 7200, 18000, 36000, 50400, 72000, 86400)
    for attempts in range(1, len(waits)):
        spread = {wait_before(waits, attempts) for _ in range(20)}
        assert len(spread) > 1
        assert all(waits[attempts] <= wait.total_seconds() <= waits[attempts] * (1 + JITTER) for wait in spread)
    assert wait_before(waits, len(waits)) is None


@given(st.lists(st.floats(0, 1e5), min_size=2), st.integers(1, 20), st.timedeltas(timedelta(), timedelta(days=400)))
def test_a_receiver_can_prolong_a_wait_and_not_shorten_or_stretch_it_for_ever(waits, attempts, asked) -> None:
    wait = wait_before(waits, attempts, asked)
    if attempts >= len(waits):
        assert wait is None
        return
    assert wait >= timedelta(seconds=waits[attempts])
    assert wait >= min(asked, LONGEST)
    assert wait <= max(LONGEST, timedelta(seconds=waits[attempts] * (1 + JITTER) + 1))


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, None),
        ("120", timedelta(seconds=120)),
        (" 7 ", timedelta(seconds=7)),
        ("9" * 400, LONGEST),
        ("-3", None),
        ("soon", None),
        ("", None),
        ("²", None),
        (format_datetime(NOW + timedelta(minutes=5), usegmt=True), timedelta(minutes=5)),
        (format_datetime(NOW - timedelta(minutes=5), usegmt=True), timedelta()),
    ],
)
def test_retry_after_is_seconds_or_a_date(value, expected) -> None:
    assert read_retry_after(value, NOW) == expected


def test_settings_take_lists_as_people_write_them(monkeypatch) -> None:
    monkeypatch.setenv("L3PS_WEBHOOK_RETRY_SECONDS", "0, 0.2,1")
    monkeypatch.setenv("L3PS_WEBHOOK_ALLOW", "127.0.0.1/32, fd00::/8")
    settings = Settings()
    assert settings.webhook_retry_seconds == (0, 0.2, 1)
    assert [str(network) for network in settings.webhook_allow] == ["127.0.0.1/32", "fd00::/8"]
    monkeypatch.setenv("L3PS_WEBHOOK_ALLOW", "localhost")
    with pytest.raises(ValueError, match="webhook_allow"):
        Settings()


def test_kinds_are_chosen_by_name_and_by_group() -> None:
    assert select_kinds([]) == select_kinds(["*"]) == frozenset(EventKind)
    assert select_kinds(["scene.*", "job.failed"]) == {
        EventKind.SCENE_DONE,
        EventKind.SCENE_FAILED,
        EventKind.JOB_FAILED,
    }
    for bad in ("job", "job.", "jobs.*", "job.done", "*.failed", ""):
        with pytest.raises(ValueError, match="no kind of event"):
            select_kinds([bad])


@given(st.lists(st.sampled_from([*EventKind, "job.*", "scene.*", "*"])), st.sampled_from(EventKind))
def test_a_webhook_is_told_exactly_what_its_patterns_mean(patterns, kind) -> None:
    assert wanted(patterns, kind) == (kind in select_kinds(patterns))
