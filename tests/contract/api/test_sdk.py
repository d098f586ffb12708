"""The Python client against the real service: its documentation, and what must survive a death or a lost answer."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

import l3ps_client
from l3ps_cli.packing import pack_bundle, pack_log
from l3ps_client import Client, Conflict, InvalidRequest, NotFound, Unauthorized

DOCS = Path(__file__).parents[3] / "docs" / "sdk.md"
MiB = 1 << 20


@pytest.fixture
def client(service, tmp_path):
    with Client(service.url, service.token, state=tmp_path / "notes") as client:
        yield client


@pytest.fixture
def archive(tmp_path):
    """A tar of three parts that is no drive log, and differs each time."""
    content = tmp_path / "content"
    content.write_bytes(os.urandom(11 * MiB))
    path = tmp_path / "night.tar"
    with tarfile.open(path, "w") as tar:
        tar.add(content, "content")
    content.unlink()
    return path


@pytest.fixture(scope="module")
def job(service, drive_log, bundle, tmp_path_factory):
    """A job that succeeded."""
    folder = tmp_path_factory.mktemp("sdk")
    pack_log(drive_log, folder / "street.tar")
    pack_bundle(bundle, folder / "colours.zip")
    with Client(service.url, service.token, state=None) as client:
        client.models.upload(folder / "colours.zip", name="colours")
        drive = client.drives.upload(folder / "street.tar")
        job = client.jobs.create(drive_id=drive["id"], model="colours", preset="fast")
        return client.jobs.wait(job["id"], timeout=120)


@pytest.mark.once
def test_every_snippet_of_the_documentation_runs(service, job, drive_log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("L3PS_URL", service.url)
    monkeypatch.setenv("L3PS_TOKEN", service.token)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    pack_log(drive_log, tmp_path / "morning.tar")
    with (tmp_path / "morning.tar").open("ab") as file:
        file.write(bytes(10240))  # a drive of its own: other tests label the same log
    snippets = re.findall(r"^```python\n(.*?)^```$", DOCS.read_text(), re.M | re.S)
    assert len(snippets) >= 6
    names: dict = {"__name__": "sdk"}
    for snippet in snippets:
        exec(compile(snippet, str(DOCS), "exec"), names)
    assert len(names["files"]) > len(names["few"]) > 0
    assert all(file.is_file() for file in [*names["files"], *names["few"]])
    assert hashlib.sha256(names["data"]).hexdigest() == names["listing"]["files"][0]["sha256"]
    with tarfile.open(names["tar"]) as tar:
        assert len(tar.getnames()) >= len(names["files"])
    assert names["receive"](b"{}", {}, "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw") == 400
    names["client"].retention.set()
    names["client"].close()


def test_a_killed_upload_goes_on_in_the_next_process(service, client, archive, tmp_path):
    code = (
        "import sys, time, pathlib, l3ps_client\n"
        "url, token, file, state = sys.argv[1:]\n"
        "def told(done, total):\n"
        "    if done > 6 << 20:\n"
        "        print('half', flush=True)\n"
        "        time.sleep(600)\n"
        "with l3ps_client.Client(url, token, state=pathlib.Path(state)) as client:\n"
        "    client.drives.upload(file, parallel=1, progress=told)\n"
    )
    words = [sys.executable, "-c", code, service.url, service.token, archive, tmp_path / "notes"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"half\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()

    (facts,) = client.uploads.unfinished(archive)
    upload = client.uploads.get(facts["upload_id"])
    assert (upload["state"], [part["number"] for part in upload["received"]]) == ("open", [1])
    sent = []
    drive = client.drives.upload(archive, name="night", progress=lambda done, total: sent.append(done))
    assert drive["sha256"] == hashlib.sha256(archive.read_bytes()).hexdigest()
    assert drive["name"] == "night"
    assert sent[-1] == archive.stat().st_size
    done = client.uploads.get(facts["upload_id"])
    assert (done["state"], done["result_id"]) == ("complete", drive["id"])
    assert client.uploads.unfinished(archive) == []


def test_uploads_that_the_service_refuses_leave_nothing_open(client, tmp_path):
    (tmp_path / "log.tar").write_bytes(b"no archive at all" * 1000)
    with pytest.raises(InvalidRequest):
        client.drives.upload(tmp_path / "log.tar")
    assert list(client.uploads.list(state="open")) == []


def test_a_wait_hears_of_each_step_and_of_the_end(client, job):
    fresh = client.jobs.create(drive_id=job["drive"]["id"], model="colours", preset="fast", formats=["semantickitti"])
    told = []
    last = client.jobs.wait(fresh["id"], timeout=120, progress=lambda job: told.append(job["state"]))
    assert last["state"] == told[-1] == "succeeded"
    events = client.jobs.events(fresh["id"])
    assert next(events).data["state"] == "succeeded"


def test_events_of_a_job_come_with_their_documents(client, job):
    following = client.events.follow(kinds=["job.*"], after="0")
    assert any(event.kind == "job.succeeded" and event.data["data"]["id"] == job["id"] for event in following)


def test_the_same_key_makes_one_job(client, job):
    settings = {"drive_id": job["drive"]["id"], "model": "colours", "idempotency_key": f"once-{job['id']}"}
    first, second = (client.jobs.create(**settings, preset="fast") for _ in range(2))
    assert first["id"] == second["id"]
    with pytest.raises(InvalidRequest, match="key"):
        client.jobs.create(**settings, preset="best")
    client.jobs.wait(first["id"], timeout=120)


def test_a_download_goes_on_within_a_real_archive(client, job, tmp_path, service):
    """A part of it lies there with the ETag it came with: only the rest is asked for, and the whole is sound."""
    whole = client.labels.archive(job["id"], tmp_path / "whole.tar").read_bytes()
    assert len(whole) > 10_000
    etag = service.http.get(f"/v1/jobs/{job['id']}/labels.tar", headers={"Range": "bytes=0-0"}).headers["etag"]
    (tmp_path / "again.tar.part").write_bytes(whole[:5000])
    (tmp_path / "again.tar.part.etag").write_text(json.dumps({"etag": etag, "sha256": None}))
    told = []
    client.labels.archive(job["id"], tmp_path / "again.tar", progress=lambda done, _: told.append(done))
    assert told[0] == 5000
    assert (tmp_path / "again.tar").read_bytes() == whole


def test_labels_of_one_scan_come_without_the_rest(client, job, tmp_path):
    scans = sorted({file["scan"] for file in client.labels.list(job["id"])["files"] if file.get("scan")})
    assert len(scans) == 3
    files = client.labels.download(job["id"], tmp_path, scans=scans[:1], side="primal")
    assert files and all("primal" in file.parts for file in files)


def test_a_job_that_is_running_has_no_labels(client, job):
    with pytest.raises(NotFound):
        client.labels.list("job_none")
    with pytest.raises(Conflict):
        client.jobs.retry(job["id"])


def test_an_unknown_token_is_said_to_be(service):
    with Client(service.url, "l3ps_wrong") as stranger, pytest.raises(Unauthorized):
        stranger.me()


def test_projects_are_worlds_of_their_own(client, service, job):
    project = client.projects.create(f"sdk {job['id']}")
    with Client(service.url, service.token, project=project["id"]) as other:
        assert other.me()["project"]["id"] == project["id"]
        assert list(other.drives.list()) == []
        with pytest.raises(NotFound):
            other.jobs.get(job["id"])
        key = other.keys.create("ci", "read")
    with Client(service.url, key["secret"]) as reader:
        assert reader.me()["project"]["id"] == project["id"]
        with pytest.raises(l3ps_client.Forbidden):
            reader.keys.create("more", "admin")
    client.projects.delete(project["id"])


def test_webhooks_are_made_changed_and_deleted(client):
    webhook = client.webhooks.create("https://example.com/hook", events=["job.*"], description="nightly")
    assert webhook["secret"].startswith("whsec_")
    assert client.webhooks.update(webhook["id"], enabled=False)["enabled"] is False
    assert client.webhooks.rotate(webhook["id"], overlap_seconds=0)["secret"] != webhook["secret"]
    assert client.webhooks.replay(webhook["id"], since="2026-01-01T00:00:00Z") == 0
    assert list(client.webhooks.deliveries(webhook["id"])) == []
    assert webhook["id"] in [one["id"] for one in client.webhooks.list()]
    client.webhooks.delete(webhook["id"])
    with pytest.raises(NotFound):
        client.webhooks.get(webhook["id"])


def test_what_the_service_signs_the_client_verifies():
    from l3ps_platform.webhooks import signing

    secrets = [signing.new_secret(), signing.new_secret()]
    body = '{"type":"job.succeeded","timestamp":"2026-11-23T12:00:00Z","data":{"name":"Straße"}}'.encode()
    headers = signing.headers(secrets, "msg_1", 1_700_000_000, body)
    for secret in secrets:
        event = l3ps_client.webhooks.verify(body, headers, secret, tolerance=1e12)
        assert (event.id, event.kind, event.data) == ("msg_1", "job.succeeded", {"name": "Straße"})
    with pytest.raises(l3ps_client.webhooks.BadSignature):
        l3ps_client.webhooks.verify(body + b" ", headers, secrets[0], tolerance=1e12)
