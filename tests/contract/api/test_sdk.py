"""The Python client against the real service: its documentation, and what must survive a death or a lost answer."""

import hashlib
import json
import os
import queue
import re
import signal
import subprocess
import sys
import tarfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
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
    (tmp_path / "no-archive.tar").write_bytes(b"no archive at all" * 1000)
    with pytest.raises(InvalidRequest):
        client.drives.upload(tmp_path / "no-archive.tar")
    assert "no-archive.tar" not in {upload["filename"] for upload in client.uploads.list(state="open")}


def test_a_wait_hears_of_each_step_and_of_the_end(client, job):
    fresh = client.jobs.create(drive_id=job["drive"]["id"], model="colours", preset="fast", formats=["semantickitti"])
    told = []
    last = client.jobs.wait(fresh["id"], timeout=120, progress=lambda job: told.append(job["state"]))
    assert last["state"] == told[-1] == "succeeded"
    assert [event.data["state"] for event in client.jobs.events(fresh["id"])] == ["succeeded"]


def test_events_of_a_job_come_with_their_documents(client, job):
    following = client.events.follow(kinds=["job.*"], after="0")
    assert any(event.kind == "job.succeeded" and event.data["data"]["id"] == job["id"] for event in following)


@pytest.mark.once
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


@pytest.mark.once
def test_an_unknown_token_is_said_to_be(service):
    with Client(service.url, "l3ps_wrong") as stranger, pytest.raises(Unauthorized):
        stranger.me()


@pytest.mark.once
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


@pytest.fixture
def receiver():
    """A receiver of webhooks on loopback: its URL, and what arrives as (headers, body)."""
    arrived: queue.Queue = queue.Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            arrived.put((dict(self.headers), self.rfile.read(int(self.headers["content-length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever, args=(0.02,))
        thread.start()
        yield f"http://127.0.0.1:{http.server_port}/hook", arrived
        http.shutdown()
        thread.join()


@pytest.mark.once
def test_what_the_service_delivers_the_client_verifies(client, receiver):
    url, arrived = receiver
    webhook = client.webhooks.create(url, events=["webhook.disabled"], description="nightly")
    delivery = client.webhooks.test(webhook["id"])
    headers, body = arrived.get(timeout=30)
    event = l3ps_client.webhooks.verify(body, headers, webhook["secret"])
    assert (event.id, event.kind) == (delivery["id"], "ping")

    rotated = client.webhooks.rotate(webhook["id"], overlap_seconds=600)
    assert client.webhooks.redeliver(webhook["id"], delivery["id"])["id"] == delivery["id"]
    headers, body = arrived.get(timeout=30)
    for secret in (webhook["secret"], rotated["secret"]):
        assert l3ps_client.webhooks.verify(body, headers, secret).id == delivery["id"]
    with pytest.raises(l3ps_client.webhooks.BadSignature):
        l3ps_client.webhooks.verify(body + b" ", headers, rotated["secret"])
    assert [one["id"] for one in client.webhooks.deliveries(webhook["id"])] == [delivery["id"]]
    client.webhooks.delete(webhook["id"])


@pytest.mark.once
def test_webhooks_are_changed_and_deleted(client, receiver):
    webhook = client.webhooks.create(receiver[0], events=["webhook.disabled"])
    assert client.webhooks.replay(webhook["id"], since="2026-01-01T00:00:00Z") == 0
    assert client.webhooks.update(webhook["id"], enabled=False)["enabled"] is False
    assert webhook["id"] in [one["id"] for one in client.webhooks.list()]
    client.webhooks.delete(webhook["id"])
    with pytest.raises(NotFound):
        client.webhooks.get(webhook["id"])


@pytest.mark.once
def test_commands_for_keys_webhooks_drives_and_models(command, job, receiver):
    def said(*words) -> dict:
        code, out, err = command(*words, "--json")
        assert code == 0, err
        return json.loads(out)

    assert said("whoami")["project"]["id"] == "prj_default"
    key = said("keys", "create", "nightly", "--scope", "write")
    assert key["secret"] and said("keys", "rotate", key["id"])["secret"] != key["secret"]
    assert key["id"] in command("keys", "list")[1]
    assert said("keys", "revoke", key["id"])["revoked"]
    webhook = said("webhooks", "create", receiver[0], "--event", "webhook.disabled")
    assert said("webhooks", "test", webhook["id"])["type"] == "ping"
    receiver[1].get(timeout=30)
    assert "ping" in command("webhooks", "deliveries", webhook["id"])[1]
    assert said("webhooks", "replay", webhook["id"], "--since", "2026-01-01T00:00:00Z")["count"] == 0
    assert webhook["id"] in command("webhooks", "list")[1]
    assert said("webhooks", "delete", webhook["id"])["deleted"]
    assert job["drive"]["id"] in command("drives", "list")[1]
    assert "3 scans" in command("drives", "show", job["drive"]["id"])[1]
    assert "colours" in command("models", "list")[1]
    assert command("uploads", "list", "--state", "complete")[0] == 0
    listed = said("jobs", "--drive", job["drive"]["id"], "--state", "succeeded")["items"]
    assert job["id"] in [one["id"] for one in listed]
    assert command("jobs", job["id"], "--follow")[0] == 0
    code, _, err = command("jobs", job["id"], "--retry")
    assert code == 2 and "succeeded" in err
    assert command("jobs", "--cancel")[0] == command("jobs", job["id"], "--cancel", "--retry")[0] == 2


@pytest.mark.once
def test_a_log_in_a_bucket_is_named_and_not_uploaded(command, client, job):
    """Whether the service may read the bucket is the service's to say; here it may not."""
    code, _, err = command("submit", "s3://nobodys/morning", "--model", "colours")
    assert (code, "nobodys" in err) == (2, True), err
    with pytest.raises(l3ps_client.Refused, match="nobodys"):
        client.rules.create("morning", bucket="nobodys", model="colours")
    assert list(client.rules.list()) == []


@pytest.mark.once
def test_download_takes_one_scan_or_one_archive(command, job, client, tmp_path):
    scan = next(file["scan"] for file in client.labels.list(job["id"])["files"] if file.get("scan"))
    code, out, err = command("download", job["id"], "--scan", scan, "--out", tmp_path / "one", "--json")
    assert code == 0, err
    assert all(Path(file).is_file() for file in json.loads(out)["files"])
    code, out, err = command("download", job["id"], "--archive", "--out", tmp_path / "all.tar")
    assert code == 0, err
    assert "1 jobs" not in out
    assert tarfile.is_tarfile(tmp_path / "all.tar")
    assert command("download", job["id"], "job_2", "--out", tmp_path)[0] == 2


@pytest.mark.once
def test_an_interrupted_upload_is_resumed_by_command(command, service, archive, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert command("uploads", "resume", archive)[0] == 2

    def stop(done, total):
        if done > 6 * MiB:
            raise InterruptedError

    with Client(service.url, service.token) as first, pytest.raises(InterruptedError):
        first.drives.upload(archive, name="night", parallel=1, progress=stop)
    code, out, err = command("uploads", "resume", archive, "--json")
    assert code == 0, err
    assert json.loads(out)["name"] == "night"
