"""Manifests are read once, and a listing or an archive of many files costs what it shows."""

import hashlib
import io
import json
import tarfile
from collections import Counter
from datetime import UTC, datetime
from types import SimpleNamespace

import pytest

from l3ps_api.labels import archive, service
from l3ps_api.labels.manifests import Manifests
from l3ps_api.labels.published import Published
from l3ps_api.problems import ApiProblem
from l3ps_platform.objects import DirectoryStore


class Counting(DirectoryStore):
    """A store that counts what is read of it."""

    def __init__(self, root) -> None:
        super().__init__(root, "http://here")
        self.read: Counter[str] = Counter()

    def open(self, key, offset=0):
        self.read[key] += 1
        return super().open(key, offset)


def published(store, job: str, files: int) -> None:
    entries = [
        {"path": f"refined/{n}.bin", "size": 3, "sha256": "0" * 64, "key": f"{job}/{n}", "format": "nuscenes"}
        for n in range(files)
    ]
    store.put_bytes(f"{job}/manifest.json", json.dumps({"job_id": job, "files": entries}).encode())


@pytest.fixture
def services(tmp_path, monkeypatch):
    """Services over a store in which any job is published whose manifest is there."""

    def found(services, job_id, label_format):
        return Published(job_id, f"{job_id}/manifest.json", "nuscenes", datetime(2026, 1, 1, tzinfo=UTC))

    for module in (archive, service):
        monkeypatch.setattr(module, "published", found)
    settings = SimpleNamespace(url_ttl_seconds=60)
    return SimpleNamespace(store=Counting(tmp_path / "objects"), settings=settings, manifests=Manifests())


def test_many_questions_about_a_job_read_its_manifest_once(services) -> None:
    published(services.store, "job", 300)
    for n in range(300):
        assert service.url(services, "job", f"refined/{n}.bin")
        assert len(service.files(services, "job", None, limit=10, cursor=str(n)).files) == min(10, 300 - n)
    assert services.store.read == {"job/manifest.json": 1}


def test_what_is_kept_of_manifests_is_bounded_and_the_latest_is_among_it(services) -> None:
    services.manifests = Manifests(kept_bytes=100_000)
    for job in ("a", "b", "c"):
        published(services.store, job, 100)
    for job in ("a", "b", "c", "c", "b", "a"):
        service.url(services, job, "refined/0.bin")
    assert services.store.read == {"a/manifest.json": 2, "b/manifest.json": 2, "c/manifest.json": 1}


def test_more_files_than_can_be_listed_at_once_are_not_cut_off_but_refused(services, monkeypatch) -> None:
    monkeypatch.setattr(service, "ALL_AT_ONCE", 5)
    published(services.store, "job", 6)
    with pytest.raises(ApiProblem) as caught:
        service.files(services, "job", None)
    assert caught.value.status == 422 and "limit=1000" in caught.value.errors[0].remedy
    published(services.store, "small", 5)
    assert len(service.files(services, "small", None).files) == 5


def test_an_archive_is_taken_up_without_looking_at_what_lies_before(services, monkeypatch) -> None:
    published(services.store, "job", 400)
    for n in range(400):
        services.store.put_bytes(f"job/{n}", b"%03d" % n)
    tar = archive.LabelArchive(services, ["job"], None)
    whole = b"".join(tar.read(0, tar.size))
    with tarfile.open(fileobj=io.BytesIO(whole)) as opened:
        assert [member.name for member in opened][-2:] == ["refined/399.bin", "manifest.json"]
        assert opened.extractfile("refined/399.bin").read() == b"399"
    made, header = [], archive.header
    monkeypatch.setattr(archive, "header", lambda *given: made.append(given) or header(*given))
    services.store.read.clear()
    for begin in (0, 511, 512, 1024 * 200 + 513, 1024 * 399, 1024 * 400 - 1, 1024 * 400, tar.size - 1024):
        piece = b"".join(tar.read(begin, begin + 600))
        assert hashlib.sha256(piece).digest() == hashlib.sha256(whole[begin : begin + 600]).digest(), begin
    assert len(made) <= 2 * 8
    again = archive.LabelArchive(services, ["job"], None)
    assert (again.size, again.etag) == (tar.size, tar.etag)
