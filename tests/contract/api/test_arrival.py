"""Jobs by reference, rules, and notifications of new objects, up to a real bucket that tells of them."""

import json
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote_plus

import httpx
import pytest
from minio import Minio
from minio.notificationconfig import NotificationConfig, PrefixFilterRule, QueueConfig
from sqlalchemy import select
from tests.conftest import free_port, healthy, running
from tests.contract.api.conftest import Service

from l3ps_api.notifications.service import MAX_ARRIVALS
from l3ps_api.rules.service import MAX_RULES
from l3ps_platform import workflow
from l3ps_platform.catalog import DEFAULT_PROJECT, Catalog, DriveRow, JobRow, ModelState, bundles

TOKEN = "operators-token"
SECRET = "bucket-secret"
AWS = {"eventVersion": "2.1", "eventSource": "aws:s3", "awsRegion": "us-east-1", "eventTime": "2026-11-22T10:00:00Z"}


@dataclass
class Arrival:
    """An API without a worker, which may read ``fleet/logs``; jobs stay queued."""

    http: httpx.Client
    catalog: Catalog
    s3_port: int

    def rule(self, **fields: object) -> httpx.Response:
        name = f"rule-{secrets.token_hex(4)}"
        return self.http.post("/v1/rules", json={"name": name, "bucket": "fleet", "model": "m", **fields})

    def tell(self, *records: dict) -> dict:
        answer = self.http.post("/v1/notifications/s3", json={"Records": records})
        assert answer.status_code == 202, answer.text
        return answer.json()

    def sources(self) -> list[str]:
        """What all jobs so far are on."""
        with self.catalog.reading() as session:
            found = session.scalars(select(DriveRow.source).join(JobRow, JobRow.drive_id == DriveRow.id))
            return sorted(str(source) for source in found)

    def forget_rules(self) -> None:
        for rule in self.http.get("/v1/rules").json()["items"]:
            assert self.http.delete(f"/v1/rules/{rule['id']}").status_code == 204


def record(key: str, *, event: str = "ObjectCreated:Put", etag: str = "e1", sequencer: str = "1") -> dict:
    """An event as AWS words it."""
    thing = {"key": quote_plus(key), "size": 5, "eTag": etag, "sequencer": sequencer}
    return AWS | {"eventName": event, "s3": {"s3SchemaVersion": "1.0", "bucket": {"name": "fleet"}, "object": thing}}


@pytest.fixture(scope="module")
def _api(api_process: Callable, redis_server: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arrival]:
    data, port = tmp_path_factory.mktemp("arrival"), free_port()
    places = [f"s3://minio:{SECRET}@127.0.0.1:{port}/fleet/logs?secure=0"]
    places.append(f"s3://minio:{SECRET}@127.0.0.1:{port}/private?secure=0&project=prj_somebody")
    redis_url = redis_server.removesuffix("/0") + "/5"
    url = api_process(
        data_dir=str(data), token=TOKEN, sources=json.dumps(places), redis_url=redis_url, reconcile_seconds="1"
    )
    catalog = Catalog(f"sqlite:///{data / 'catalog.db'}").scoped(DEFAULT_PROJECT)
    with catalog.transaction() as tx:
        workflow.accept_model(tx, name="m", filename="m.zip", size=1, object_key="uploads/m/m.zip")
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60) as http:
        yield Arrival(http, catalog, port)
    catalog.dispose()


@pytest.fixture
def api(_api: Arrival) -> Arrival:
    """Without rules."""
    _api.forget_rules()
    return _api


def test_a_job_names_a_source_instead_of_a_drive(api):
    answer = api.http.post("/v1/jobs", json={"source": "s3://fleet/logs/named/", "model": "m"})
    assert answer.status_code == 202, answer.text
    drive = api.http.get(f"/v1/drives/{answer.json()['drive']['id']}").json()
    assert (drive["source"], drive["name"], drive["state"]) == ("s3://fleet/logs/named", "named", "uploaded")


@pytest.mark.parametrize(
    ("fields", "status", "code"),
    [
        ({"source": "s3://fleet/logs-secret/a"}, 403, "source-not-allowed"),
        ({"source": "s3://fleet"}, 403, "source-not-allowed"),
        ({"source": "s3://private/a"}, 403, "source-not-allowed"),
        ({"source": "s3://elsewhere/logs"}, 403, "source-not-allowed"),
        ({"source": "s3://fleet/logs/../../private"}, 422, "bad-source"),
        ({"source": f"s3://minio:{SECRET}@fleet/logs"}, 422, "bad-source"),
        ({"source": "file:///etc"}, 422, "bad-source"),
        ({}, 422, "invalid-request"),
        ({"source": "s3://fleet/logs/a", "drive_id": "drv_1"}, 422, "invalid-request"),
    ],
)
def test_what_may_not_be_read_is_refused_without_telling_what_may(api, fields, status, code):
    before = api.sources()
    document = Service.refused(api.http.post("/v1/jobs", json={"model": "m", **fields}), status, code)
    assert document["errors"]
    assert "9000" not in str(document) and str(api.s3_port) not in str(document) and SECRET not in str(document)
    assert api.sources() == before


def test_rules_are_made_listed_and_deleted(api):
    made = api.rule(name="morning", prefix="logs/", suffix="_SUCCESS", preset="fast", skip_bad_scans=True)
    assert made.status_code == 201, made.text
    rule = made.json()
    assert made.headers["location"] == f"/v1/rules/{rule['id']}"
    assert (rule["prefix"], rule["suffix"], rule["preset"], rule["arrivals"]) == ("logs", "_SUCCESS", "fast", 0)
    assert api.http.get(f"/v1/rules/{rule['id']}").json() == rule
    assert api.http.get("/v1/rules").json()["items"] == [rule]
    Service.refused(api.rule(name="morning", prefix="logs"), 409, "name-taken")
    Service.refused(api.rule(prefix="other"), 403, "source-not-allowed")
    Service.refused(api.rule(prefix="logs", model="none"), 404, "unknown-model")
    Service.refused(api.rule(prefix="logs", preset="none"), 422, "invalid-request")
    assert api.http.delete(f"/v1/rules/{rule['id']}").status_code == 204
    Service.refused(api.http.get(f"/v1/rules/{rule['id']}"), 404, "unknown-rule")


def test_an_object_becomes_one_job_however_often_and_however_parallel_it_is_told_of(api):
    rule = api.rule(prefix="logs/once", preset="fast").json()
    before = api.sources()
    told = [record("logs/once/Ein Log+ü.tar.zst"), record("logs/once/b.zip"), record("logs/once/notes.txt")]
    with ThreadPoolExecutor(8) as hands:
        answers = list(hands.map(lambda _: api.tell(*told), range(8)))
    assert sum(answer["accepted"] for answer in answers) == 2
    assert all(answer["accepted"] + answer["known"] == 2 and answer["ignored"] == 1 for answer in answers)
    _until(lambda: api.http.get(f"/v1/rules/{rule['id']}").json()["latest"].get("job_id"))
    new = api.sources()
    for source in before:
        new.remove(source)
    assert new == ["s3://fleet/logs/once/Ein Log+ü.tar.zst", "s3://fleet/logs/once/b.zip"]

    assert api.tell(record("logs/once/b.zip", sequencer="2"))["accepted"] == 1, "written anew"
    seen = api.http.get(f"/v1/rules/{rule['id']}").json()
    assert (seen["arrivals"], seen["latest"]["key"]) == (3, "logs/once/b.zip")
    job = api.http.get(f"/v1/jobs/{seen['latest']['job_id']}").json()
    assert job["preset"] == "fast" and job["model"]["name"] == "m"


def test_a_marker_says_that_its_folder_is_the_log(api):
    api.rule(prefix="logs/folders", suffix="_SUCCESS")
    before = api.sources()
    assert api.tell(record("logs/folders/a/1.bin"), record("logs/folders/a/_SUCCESS"))["accepted"] == 1
    assert set(api.sources()) - set(before) == {"s3://fleet/logs/folders/a"}


@pytest.mark.parametrize(
    "told",
    [
        record("logs/x.zip", event="ObjectRemoved:Delete"),
        record("logs/x.zip", event="s3:ObjectAccessed:Get"),
        record("logs/x.zip/"),
        record("logs-secret/x.zip"),
        record("logs/../private/x.zip"),
        record("logs/a\nb.zip"),
        record("other/x.zip"),
        record("logs/x.exe"),
    ],
)
def test_what_meets_no_rule_is_passed_over(api, told):
    api.rule(prefix="logs")
    before = api.sources()
    assert api.tell(told) == {"accepted": 0, "known": 0, "ignored": 1}
    assert api.sources() == before


def test_a_rule_may_be_for_one_kind_of_archive(api):
    api.rule(prefix="logs/kinds", suffix=".tar")
    told = [record(f"logs/kinds/a{suffix}") for suffix in (".tar", ".zip", ".tar.gz")]
    assert api.tell(*told) == {"accepted": 1, "known": 0, "ignored": 2}


def test_notifications_that_are_none(api):
    test = {"Service": "Amazon S3", "Event": "s3:TestEvent", "Bucket": "fleet", "RequestId": "1", "HostId": "2"}
    answer = api.http.post("/v1/notifications/s3", json=test)
    assert (answer.status_code, answer.json()["accepted"]) == (202, 0)
    for wrong in ({"Records": [{}]}, {"Records": "x"}, [], {"Records": [record("a")] * 1001}):
        Service.refused(api.http.post("/v1/notifications/s3", json=wrong), 422, "invalid-request")
    answer = httpx.post(f"{api.http.base_url}/v1/notifications/s3", json={"Records": []})
    Service.refused(answer, 401, "unauthorized")


def test_a_large_batch_is_answered_at_once_and_all_of_it_becomes_jobs(api):
    api.rule(prefix="logs/many")
    told = [record(f"logs/many/{number}.zip", sequencer=str(number)) for number in range(200)]
    assert api.tell(*told)["accepted"] == 200
    assert api.tell(*told) == {"accepted": 0, "known": 200, "ignored": 0}

    wanted = sorted(f"s3://fleet/logs/many/{number}.zip" for number in range(200))
    _until(lambda: [source for source in api.sources() if "/many/" in source] == wanted)


def test_rules_and_what_meets_them_at_once_are_bounded(api):
    for _ in range(MAX_RULES):
        assert api.rule(prefix="logs/bounded").status_code == 201
    Service.refused(api.rule(prefix="logs/bounded"), 409, "too-many-rules")
    before = api.sources()
    batch = {"Records": [record(f"logs/bounded/{n}.zip") for n in range(MAX_ARRIVALS // MAX_RULES + 1)]}
    document = Service.refused(api.http.post("/v1/notifications/s3", json=batch), 413, "too-large")
    assert document["errors"][0]["where"] == "Records"
    assert api.sources() == before, "and none of them became a job"


def test_an_arrival_that_can_be_no_job_says_why(api):
    rule = api.rule(prefix="logs/unfit", segment="balanced").json()
    with api.catalog.transaction() as tx:
        model = bundles.by_name(tx.session, "m")
        model.state, model.info = ModelState.READY, {"passes": []}
    try:
        api.tell(record("logs/unfit/a.zip"))
        latest = api.http.get(f"/v1/rules/{rule['id']}").json()["latest"]
        assert "balanced" in latest["message"] and latest["errors"] and latest.get("job_id") is None
    finally:
        with api.catalog.transaction() as tx:
            model = bundles.by_name(tx.session, "m")
            model.state, model.info = ModelState.UPLOADED, None


@pytest.fixture
def telling_minio(api: Arrival, minio_binary: Path, tmp_path: Path) -> Iterator[Minio]:
    """A real MinIO whose webhook target is the API, on the port that the API's sources name."""
    environment = dict(
        os.environ,
        MINIO_ROOT_USER="minio",
        MINIO_ROOT_PASSWORD=SECRET,
        MINIO_BROWSER="off",
        MINIO_NOTIFY_WEBHOOK_ENABLE_l3ps="on",
        MINIO_NOTIFY_WEBHOOK_ENDPOINT_l3ps=f"{str(api.http.base_url).rstrip('/')}/v1/notifications/s3",
        MINIO_NOTIFY_WEBHOOK_AUTH_TOKEN_l3ps=TOKEN,
        MINIO_NOTIFY_WEBHOOK_QUEUE_DIR_l3ps=str(tmp_path / "events"),
    )
    command = [minio_binary, "server", "--quiet", "--address", f"127.0.0.1:{api.s3_port}", tmp_path / "data"]
    with running(command, tmp_path / "log", lambda: healthy(api.s3_port), env=environment):
        yield Minio(f"127.0.0.1:{api.s3_port}", "minio", SECRET, secure=False)
    shutil.rmtree(tmp_path / "data", ignore_errors=True)


def test_a_bucket_of_a_real_server_tells_and_each_log_becomes_one_job(api, telling_minio, tmp_path):
    api.rule(prefix="logs/real")
    api.rule(prefix="logs/real", suffix="_SUCCESS")
    before = api.sources()
    telling_minio.make_bucket("fleet")
    target = QueueConfig(
        queue="arn:minio:sqs::l3ps:webhook",
        events=["s3:ObjectCreated:*"],
        prefix_filter_rule=PrefixFilterRule("logs/"),
    )
    telling_minio.set_bucket_notification("fleet", NotificationConfig(queue_config_list=[target]))
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_bytes(b"x")
    large.write_bytes(bytes(12 << 20))
    telling_minio.fput_object("fleet", "logs/real/Größe 1+2.zip", str(small))
    telling_minio.fput_object("fleet", "logs/real/in parts.tar.zst", str(large), part_size=5 << 20)
    for name in ("scene.json", "_SUCCESS"):
        telling_minio.fput_object("fleet", f"logs/real/street/{name}", str(small))
    expected = {"Größe 1+2.zip", "in parts.tar.zst", "street"}
    new = {f"s3://fleet/logs/real/{name}" for name in expected}
    _until(lambda: new <= set(api.sources()))
    found = api.sources()
    for source in before:
        found.remove(source)
    assert found == sorted(new)


def _until(ready: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.1)
