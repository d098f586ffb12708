"""The presigned URLs of the directory store, which the API answers itself, as S3 would."""

import httpx
import pytest
from tests.conftest import wait_until

from l3ps_platform.objects import DirectoryStore

MiB = 1 << 20


@pytest.fixture
def store(service) -> DirectoryStore:
    if not isinstance(service.store, DirectoryStore):
        pytest.skip("this service's presigned URLs lead to its S3 server")
    return service.store


def test_an_object_comes_as_a_download_that_no_browser_renders(store):
    store.put_bytes("test/page.html", b"<script>alert(1)</script>")
    answer = httpx.get(store.presign_get("test/page.html", 60, "labels of a.html"))
    assert answer.content == b"<script>alert(1)</script>"
    assert answer.headers["content-disposition"].startswith("attachment")
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_an_expired_url_is_refused(service, store):
    store.put_bytes("test/old.bin", b"old")
    document = service.refused(httpx.get(store.presign_get("test/old.bin", -1)), 403, "invalid-signature")
    assert "expired" in document["detail"]


def test_a_url_permits_one_object_one_way(service, store):
    store.put_bytes("test/mine.bin", b"mine")
    store.put_bytes("test/yours.bin", b"yours")
    url = store.presign_get("test/mine.bin", 60)
    service.refused(httpx.get(url.replace("mine", "yours")), 403, "invalid-signature")
    service.refused(httpx.put(url, content=b"other"), 403, "invalid-signature")
    service.refused(httpx.get(url.partition("?")[0]), 403, "invalid-signature")
    assert store.get_bytes("test/mine.bin") == b"mine"


@pytest.mark.parametrize("key", ["../secret", "%2e%2e/secret", "a/..%2f..%2f/secret", "%2fetc/passwd", "a%00b"])
def test_no_path_leads_out_of_the_store(service, store, key):
    with httpx.Client() as client:
        url = httpx.URL(service.url, raw_path=f"/v1/objects/{key}?expires=9999999999&signature=00".encode())
        answer = client.get(url)
    assert answer.status_code in (401, 403, 404)
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_missing_object_is_a_404(service, store):
    service.refused(httpx.get(store.presign_get("test/none.bin", 60)), 404, "unknown-object")


def unfinished(store):
    """Parts of uploads and files being written."""
    return {path for folder in ("multipart", "tmp") for path in (store.root / folder).rglob("*") if path.is_file()}


def leaves_nothing(store, before):
    """Once the server has noticed the end of the connection; a worker's own half-written files come and go."""
    wait_until(lambda: unfinished(store) - before, lambda left: not left)


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "chunked"])
def test_a_part_over_the_limit_leaves_nothing(service, store, declared):
    upload = service.announce(4 * MiB)
    before = unfinished(store)
    body = bytes(8 * MiB)

    def chunks():
        for start in range(0, len(body), MiB):
            yield body[start : start + MiB]

    try:
        answer = httpx.put(upload["parts"][0]["url"], content=body if declared else chunks())
    except httpx.TransportError:
        pass  # the server may close the connection before the client has sent everything
    else:
        service.refused(answer, 413, "too-large")
    leaves_nothing(store, before)


def test_a_body_that_breaks_off_leaves_nothing(service, store):
    upload = service.announce(4 * MiB)
    before = unfinished(store)

    def broken():
        yield bytes(MiB)
        raise ConnectionAbortedError

    with pytest.raises(ConnectionAbortedError):
        httpx.put(upload["parts"][0]["url"], content=broken(), headers={"content-length": str(4 * MiB)})
    leaves_nothing(store, before)
