"""Downloads by presigned URL can be resumed at any byte, from either store."""

import httpx
import pytest

from l3ps_platform.objects import DirectoryStore

BODY = bytes(range(200))


@pytest.fixture
def url(service):
    service.store.put_bytes("test/numbers.bin", BODY)
    return service.store.presign_get("test/numbers.bin", 60)


@pytest.mark.parametrize(
    ("asked", "found"),
    [("10-19", (10, 20)), ("190-", (190, 200)), ("-5", (195, 200)), ("0-0", (0, 1)), ("150-9999", (150, 200))],
)
def test_a_range_is_answered_with_those_bytes(url, asked, found):
    answer = httpx.get(url, headers={"range": f"bytes={asked}"})
    assert (answer.status_code, answer.content) == (206, BODY[slice(*found)])
    assert answer.headers["content-range"] == f"bytes {found[0]}-{found[1] - 1}/200"


@pytest.mark.parametrize("asked", ["200-", "1000-2000"])
def test_a_range_beyond_the_end_is_refused(url, asked):
    assert httpx.get(url, headers={"range": f"bytes={asked}"}).status_code == 416


def test_a_resumed_download_is_of_the_same_bytes_or_refused(service, url):
    etag = httpx.get(url).headers["etag"]
    rest = {"range": "bytes=100-", "if-match": etag}
    answer = httpx.get(url, headers=rest)
    assert (answer.status_code, answer.content) == (206, BODY[100:])
    service.store.put_bytes("test/numbers.bin", BODY[::-1])
    assert httpx.get(url, headers=rest).status_code == 412
    if isinstance(service.store, DirectoryStore):  # MinIO does not know If-Range
        answer = httpx.get(url, headers={"range": "bytes=100-", "if-range": etag})
        assert (answer.status_code, answer.content) == (200, BODY[::-1]), "from the beginning"


def test_what_has_not_changed_is_not_sent_again(url):
    etag = httpx.get(url).headers["etag"]
    assert httpx.get(url, headers={"if-none-match": etag}).status_code == 304
