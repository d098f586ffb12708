"""Names: ids that sort, keys that stay inside, URLs that permit one thing."""

import threading
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps_platform.errors import InvalidKey, InvalidSignature
from l3ps_platform.ids import is_id, lowest_id, new_id
from l3ps_platform.objects import Grant, Signer, check_key, content_type, segment


def test_ids_sort_in_the_order_they_were_made() -> None:
    ids = [new_id("job") for _ in range(5000)]
    assert ids == sorted(set(ids))


def test_an_id_lies_between_the_bounds_of_its_moment() -> None:
    before = datetime.now(UTC)
    made = new_id("job")
    later = before + timedelta(hours=1)
    assert lowest_id("job", before) <= made < lowest_id("job", later)
    assert is_id(lowest_id("job", later), "job")
    for moment in (datetime.min, datetime.max):
        assert is_id(lowest_id("job", moment.replace(tzinfo=UTC)), "job")


def test_ids_from_many_threads_are_unique() -> None:
    made: list[str] = []
    threads = [threading.Thread(target=lambda: made.extend([new_id("stg") for _ in range(500)])) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(made)) == 4000


def test_ids_survive_a_clock_that_is_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = new_id("job")
    monkeypatch.setattr("l3ps_platform.ids.time.time", lambda: 1_000_000.0)
    assert new_id("job") > before


@pytest.mark.parametrize(
    "text", ["", "job_", "job_x", "../job", "drv_" + "0" * 25, "job_" + "u" * 25, "job_" + "0" * 26]
)
def test_what_is_no_job_id(text: str) -> None:
    assert is_id(new_id("job"), "job")
    assert not is_id(text, "job")


@given(st.text(max_size=40))
def test_any_name_becomes_a_valid_key_segment(name: str) -> None:
    check_key(f"labels/{segment(name)}")
    assert "/" not in segment(name)


@given(st.text(max_size=20), st.text(max_size=20), st.sampled_from(["", "long" * 60]))
def test_different_names_give_different_segments(a: str, b: str, before: str) -> None:
    assert (segment(before + a) == segment(before + b)) == (a == b)


def test_plain_names_stay_readable() -> None:
    assert segment("4d036dc46ddce_panoptic.npz") == "4d036dc46ddce_panoptic.npz"


@pytest.mark.parametrize(
    "key", ["a\n", "a/b\n", "a/\nb", "a\x00", "a/./b", "a/..", "..", "C:/x", "a%2fb", "a?b", "a#b"]
)
def test_keys_that_mean_something_else_somewhere(key: str) -> None:
    with pytest.raises(InvalidKey):
        check_key(key)


def test_content_types_follow_the_suffix() -> None:
    assert content_type("a/b/manifest.json") == "application/json"
    assert content_type("a.b/c") == "application/octet-stream"
    assert content_type("x_panoptic.npz") == "application/x-npz"


class TestSigner:
    signer = Signer(b"secret", "http://api")

    def query(self, url: str) -> dict[str, str]:
        from urllib.parse import parse_qsl, urlsplit

        return dict(parse_qsl(urlsplit(url).query))

    def test_a_grant_comes_back(self) -> None:
        grant = Grant("PUT", "a/b", upload_id="u", part=3, size=7)
        url = self.signer.url(grant, 60, now=1000)
        assert url.startswith("http://api/v1/objects/a/b?")
        assert self.signer.verify("PUT", "a/b", self.query(url), now=1059) == grant

    def test_a_download_may_be_looked_at_first(self) -> None:
        url = self.signer.url(Grant("GET", "a"), 60, now=1000)
        assert self.signer.verify("HEAD", "a", self.query(url), now=1000).method == "GET"

    def test_out_of_date(self) -> None:
        url = self.signer.url(Grant("GET", "a"), 60, now=1000)
        with pytest.raises(InvalidSignature, match="expired"):
            self.signer.verify("GET", "a", self.query(url), now=1061)

    @pytest.mark.parametrize(
        "changed",
        [
            {"expires": "9999"},
            {"upload": "v"},
            {"part": "4"},
            {"size": "8"},
            {"size": None},
            {"size": "x"},
            {"filename": "x"},
            {"signature": "0" * 64},
            {"signature": "ä"},
            {"part": "x"},
            {"signature": None},
            {"expires": None},
        ],
    )
    def test_altered(self, changed: dict[str, str | None]) -> None:
        query = self.query(self.signer.url(Grant("PUT", "a", "u", part=3, size=7), 60, now=1000)) | changed
        with pytest.raises(InvalidSignature):
            self.signer.verify("PUT", "a", {k: v for k, v in query.items() if v is not None}, now=1000)

    @pytest.mark.parametrize("method", ["GET", "DELETE", "POST", "put"])
    def test_other_methods(self, method: str) -> None:
        query = self.query(self.signer.url(Grant("PUT", "a"), 60, now=1000))
        with pytest.raises(InvalidSignature):
            self.signer.verify(method, "a", query, now=1000)

    def test_another_secret(self) -> None:
        query = self.query(Signer(b"other", "").url(Grant("GET", "a"), 60, now=1000))
        with pytest.raises(InvalidSignature):
            self.signer.verify("GET", "a", query, now=1000)

    def test_fields_cannot_flow_into_each_other(self) -> None:
        """``a`` + part ``1`` with upload ``2`` must not share a signature with ``a`` + part ``12``."""
        first = self.query(self.signer.url(Grant("PUT", "a", upload_id="2", part=1), 60, now=1000))
        second = self.query(self.signer.url(Grant("PUT", "a", upload_id="21", part=1), 60, now=1000))
        assert first["signature"] != second["signature"]
