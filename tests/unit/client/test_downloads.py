"""Files on their way down: there only when whole, checked, gone on with at the byte where they broke off."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from l3ps_client import Client, Damaged, Refused, Retry, Unreachable

from .conftest import AT_ONCE, reply, serving

LARGE = os.urandom(3 << 20)
ETAG = f'"{hashlib.md5(LARGE).hexdigest()}"'


class Store:
    """Serves label files of one job: whole or by range, breaking off where it is told to.

    Attributes:
        files: bytes by path.
        breaks: for each coming GET of a file after how many bytes it breaks off, None for not.
        ranges: what was asked for, None for whole files.
    """

    def __init__(self, **files: bytes) -> None:
        self.files, self.breaks, self.ranges = files, [], []
        self.honours_if_range, self.signature, self.listed, self.etags = True, "1", 0, True

    def answer(self, handler):
        path, _, query = handler.path.partition("?")
        if path == "/v1/jobs/job_1/labels":
            self.listed += 1
            reply(handler, 200, {"job_id": "job_1", "format": "nuscenes", "files": self.listing()})
        elif not path.startswith(("/file/", "/v1/jobs/job_1/labels.tar")):
            reply(handler, 404, {"detail": "Nothing."})
        elif path.startswith("/file/") and query != self.signature:
            reply(handler, 403, {"detail": "Expired."})
        else:
            self.send(handler, self.files[path.rpartition("/")[2]])

    def send(self, handler, data):
        asked = handler.headers.get("range")
        self.ranges.append(asked)
        etag = f'"{hashlib.md5(data).hexdigest()}"'
        status, headers, start = 200, {"ETag": etag} if self.etags else {}, 0
        if asked and (not self.honours_if_range or handler.headers.get("if-range") == etag):
            start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1])
            if start >= len(data):
                reply(handler, 416, None, {"Content-Range": f"bytes */{len(data)}"})
                return
            status, headers["Content-Range"] = 206, f"bytes {start}-{len(data) - 1}/{len(data)}"
        body = data[start:]
        after = self.breaks.pop(0) if self.breaks else None
        reply(handler, status, None, headers, body[:after], None if after is None else len(body))

    def listing(self):
        return [
            {"path": path, "size": len(data), "sha256": hashlib.sha256(data).hexdigest(), "url": self.url(path)}
            for path, data in self.files.items()
        ]

    def url(self, path):
        return f"/file/{path}?{self.signature}"


@contextmanager
def store_of(**files):
    store = Store(**files)
    with serving(store.answer) as http, Client(http.url, retry=AT_ONCE) as store.client:
        store.address = http.url
        yield store


def names(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_files_come_once_and_are_counted(tmp_path):
    with store_of(a=b"0123", b=b"", c=LARGE) as store:
        told = []
        files = store.client.labels.download("job_1", tmp_path, progress=lambda *bytes: told.append(bytes))
        assert [file.read_bytes() for file in files] == [b"0123", b"", LARGE]
        assert told[-1] == (4 + len(LARGE),) * 2
        assert names(tmp_path) == ["a", "b", "c"]
        store.ranges.clear()
        (tmp_path / "a").write_bytes(b"4567")
        store.client.labels.download("job_1", tmp_path)
        assert store.ranges == [None] and (tmp_path / "a").read_bytes() == b"0123"


def test_a_file_that_breaks_off_goes_on_at_the_byte_where_it_stopped(tmp_path):
    with store_of(c=LARGE) as store:
        store.breaks = [2 << 20, 100]
        told = []
        store.client.labels.download("job_1", tmp_path, progress=lambda done, _: told.append(done))
        assert (tmp_path / "c").read_bytes() == LARGE
        assert store.ranges == [None, f"bytes={2 << 20}-", f"bytes={(2 << 20) + 100}-"]
        assert told[-1] == max(told) == len(LARGE)


def test_a_file_that_never_arrives_leaves_what_can_be_gone_on_with_and_no_file_of_its_name(tmp_path):
    with store_of(c=LARGE, s=b"small") as store:
        store.breaks = [2 << 20] + [0] * 20
        with pytest.raises(Unreachable):
            store.client.labels.download("job_1", tmp_path, parallel=1)
        assert names(tmp_path) == ["c.part", "c.part.etag"]
        store.breaks, store.ranges = [], []
        with Client(store.address, retry=AT_ONCE) as other:
            other.labels.download("job_1", tmp_path, parallel=1)
        assert store.ranges == [f"bytes={2 << 20}-", None]
        assert names(tmp_path) == ["c", "s"] and (tmp_path / "c").read_bytes() == LARGE


@pytest.mark.parametrize("honours_if_range", [True, False])
def test_a_file_that_is_another_one_by_now_starts_over(tmp_path, honours_if_range):
    """S3 servers ignore If-Range and send a range of the new bytes: these must not be joined to the old ones."""
    with store_of(**{"labels.tar": LARGE}) as store:
        store.breaks = [2 << 20] + [0] * 20
        with pytest.raises(Unreachable):
            store.client.labels.archive("job_1", tmp_path / "all.tar")
        store.files["labels.tar"] = fresh = bytes(reversed(LARGE))
        store.breaks, store.honours_if_range = [], honours_if_range
        store.client.labels.archive("job_1", tmp_path / "all.tar")
        assert (tmp_path / "all.tar").read_bytes() == fresh


def test_an_archive_is_shorter_by_now(tmp_path):
    with store_of(**{"labels.tar": LARGE}) as store:
        store.breaks = [2 << 20] + [0] * 20
        with pytest.raises(Unreachable):
            store.client.labels.archive("job_1", tmp_path / "all.tar")
        store.files["labels.tar"], store.breaks, store.honours_if_range = b"short", [], False
        store.client.labels.archive("job_1", tmp_path / "all.tar")
        assert names(tmp_path) == ["all.tar"] and (tmp_path / "all.tar").read_bytes() == b"short"


def test_an_archive_tells_its_size_as_it_comes(tmp_path):
    with store_of(**{"labels.tar": LARGE}) as store:
        told = []
        store.client.labels.archive("job_1", tmp_path / "all.tar", progress=lambda *bytes: told.append(bytes))
        assert told[-1] == (len(LARGE),) * 2


def test_a_damaged_file_is_fetched_again_and_then_refused(tmp_path):
    with store_of(a=b"0123") as store:
        listing = store.listing()
        store.listing = lambda: listing
        store.files["a"] = b"4567"
        with pytest.raises(Damaged, match="arrived damaged"):
            store.client.labels.download("job_1", tmp_path)
        assert store.ranges == [None, None]
        assert names(tmp_path) == []


def test_a_part_that_was_tampered_with_is_noticed(tmp_path):
    with store_of(c=LARGE) as store:
        store.breaks = [2 << 20] + [0] * 20
        with pytest.raises(Unreachable):
            store.client.labels.download("job_1", tmp_path)
        store.breaks = []
        with (tmp_path / "c.part").open("r+b") as file:
            file.write(b"tampered")
        store.client.labels.download("job_1", tmp_path)
        assert (tmp_path / "c").read_bytes() == LARGE


def test_expired_urls_are_asked_for_again(tmp_path):
    with store_of(a=b"0123", b=b"4567") as store:
        real, first = store.listing, store.listing()
        store.listing = lambda: first if store.listed == 1 else real()
        store.signature = "2"
        store.client.labels.download("job_1", tmp_path)
        assert names(tmp_path) == ["a", "b"]
        assert store.listed == 2


def test_an_url_that_never_works_is_a_refusal(tmp_path):
    with store_of(a=b"0123") as store:
        listing = store.listing()
        store.listing = lambda: listing
        store.signature = "2"
        with pytest.raises(Refused, match="Expired"):
            store.client.labels.download("job_1", tmp_path)


@pytest.mark.parametrize("path", ["../x", "/etc/passwd", "a/../../x", "", "a\\..\\x", "C:x"])
def test_no_listing_makes_a_download_write_elsewhere(tmp_path, path):
    with store_of(good=b"0123") as store:
        store.files[path] = b"evil"
        folder = tmp_path / "labels"
        with pytest.raises(Damaged, match="outside"):
            store.client.labels.download("job_1", folder)
        assert names(tmp_path) == []


def test_a_killed_download_goes_on_in_the_next_process(tmp_path):
    code = "import sys, l3ps_client; l3ps_client.Client(sys.argv[1]).labels.archive('job_1', sys.argv[2])"
    arrived, gone = threading.Event(), threading.Event()
    with store_of(**{"labels.tar": LARGE}) as store:
        whole = store.send

        def half(handler, data):
            store.send = whole
            handler.send_response(200)
            handler.send_header("ETag", ETAG)
            handler.send_header("content-length", str(len(data)))
            handler.end_headers()
            handler.wfile.write(data[: 2 << 20])
            arrived.set()
            gone.wait(30)
            handler.close_connection = True

        store.send = half
        process = subprocess.Popen([sys.executable, "-c", code, store.address, str(tmp_path / "all.tar")])
        assert arrived.wait(30)
        part = tmp_path / "all.tar.part"
        while not part.exists() or part.stat().st_size < 1 << 20 or not names(tmp_path)[1:]:
            assert process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait(30)
        gone.set()
        have = part.stat().st_size
        store.client.labels.archive("job_1", tmp_path / "all.tar")
        assert store.ranges == [f"bytes={have}-"]
        assert (tmp_path / "all.tar").read_bytes() == LARGE


def test_one_label_file_without_the_rest(server, client):
    server.script += [(307, {"Location": "/elsewhere?signed"}, b"", None), (200, {}, b"labels", None)]
    assert client.labels.read("job_1", "refined/lidarseg/a b.bin") == b"labels"
    (_, path, _, first), (_, where, _, second) = server.seen
    assert (path, where) == ("/v1/jobs/job_1/labels/refined/lidarseg/a%20b.bin", "/elsewhere?signed")
    assert "authorization" in first and "authorization" not in second


def test_filters_and_jobs_go_into_the_query(server, client, tmp_path):
    server.script += [(200, {}, b'{"files": []}', None)] * 2 + [(200, {}, b"tar", None)]
    client.labels.download("job_1", tmp_path, scenes=["a", "b"], side="refined")
    client.labels.archive(["job_1", "job_2"], tmp_path / "all.tar", format="nuscenes")
    assert [path.partition("?")[2] for _, path, *_ in server.seen] == [
        "scene=a&side=refined&limit=1000",
        "scene=b&side=refined&limit=1000",
        "format=nuscenes&job=job_1&job=job_2",
    ]


def test_a_listing_is_fetched_page_by_page(server, client):
    pages = [{"files": ["a", "b"], "next": "2"}, {"files": ["c"], "next": "3"}, {"files": ["d"]}]
    server.script += [(200, {}, json.dumps(page).encode(), None) for page in pages]
    assert client.labels.list("job_1", scene="x")["files"] == ["a", "b", "c", "d"]
    asked = [path.partition("?")[2] for _, path, *_ in server.seen]
    assert asked == ["scene=x&limit=1000", "scene=x&limit=1000&cursor=2", "scene=x&limit=1000&cursor=3"]


def test_how_often_is_bounded(tmp_path):
    with store_of(c=LARGE) as store, Client(store.address, retry=Retry(tries=1, first=0.0)) as client:
        store.breaks = [0] * 20
        with pytest.raises(Unreachable):
            client.labels.download("job_1", tmp_path)
        assert len(store.ranges) == 3


def test_a_file_without_a_name_for_its_bytes_starts_over(tmp_path):
    with store_of(c=LARGE) as store:
        store.breaks, store.etags = [2 << 20], False
        store.client.labels.download("job_1", tmp_path)
        assert store.ranges == [None, None] and (tmp_path / "c").read_bytes() == LARGE


def test_a_file_larger_than_announced_does_not_fill_the_disk(tmp_path):
    with store_of(a=b"0123") as store:
        listing = store.listing()
        store.listing = lambda: listing
        store.files["a"] = LARGE
        with pytest.raises(Damaged, match="larger"):
            store.client.labels.download("job_1", tmp_path)
        assert names(tmp_path) == []
