"""What belongs to one project does not exist for another, on every operation of the API, those to come included."""

import re
import secrets
from datetime import UTC, datetime

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import GenerationMode

from l3ps_platform.catalog import (
    AnnotationsRow,
    DeliveryRow,
    DeliveryState,
    DriveRow,
    DriveState,
    JobRow,
    JobState,
    ModelRow,
    ModelState,
    RuleRow,
    StageName,
    StageRow,
    StageState,
    TrainingRow,
    WebhookRow,
)
from l3ps_platform.ids import new_id

JOB_SETTINGS = {"preset": "best", "segment": "fast", "formats": ["nuscenes"], "protocol": None, "skip_bad_scans": False}
NOT_OF_A_PROJECT = {"project_id", "key"}
"""Path parameters that name nothing of a project's: the operator's own, and presigned objects."""


@pytest.fixture(scope="module")
def projects(service) -> dict[str, httpx.Client]:
    """Two projects, each as the holder of its admin key sees it."""
    clients = {}
    for owner in ("ours", "theirs"):
        project = service.http.post("/v1/projects", json={"name": f"{owner} {secrets.token_hex(4)}"}).json()["id"]
        there = {"L3PS-Project": project}
        key = service.http.post("/v1/keys", json={"name": owner, "scope": "admin"}, headers=there).json()
        credentials = {"Authorization": f"Bearer {key['secret']}"}
        clients[owner] = httpx.Client(base_url=service.url, headers=credentials, timeout=30)
        clients[owner].project = project
    yield clients
    for client in clients.values():
        client.close()


@pytest.fixture(scope="module")
def belongings(service, projects) -> dict[str, str]:
    """One of everything in our project, by the path parameter that names it."""
    ours = projects["ours"]
    found = {"upload_id": ours.post("/v1/uploads", json={"kind": "drive", "filename": "a.tar", "size": 9}).json()["id"]}
    found |= _rows(service, ours.project)
    found["key_id"] = ours.get("/v1/keys").json()["items"][0]["id"]
    document = service.http.get("/openapi.json").json()
    wanted = {name for path in document["paths"] for name in re.findall(r"{(\w+)}", path)}
    assert wanted - {"key", "project_id", "path"} <= found.keys(), "have this fixture make what is new here"
    return found


def _rows(service, project: str) -> dict[str, str]:
    """Finished work, put straight into the catalog: no worker has anything to do with it."""
    now = datetime.now(UTC)
    file = {"filename": "f.zip", "size": 9, "object_key": "uploads/x/f.zip", "created_at": now}
    over = {"state": JobState.SUCCEEDED, "cancel_requested": False, "created_at": now, "finished_at": now}
    drive = DriveRow(id=new_id("drv"), name="d", state=DriveState.READY, **file)
    model = ModelRow(id=new_id("mdl"), name="m", state=ModelState.READY, **file)
    annotations = AnnotationsRow(id=new_id("ann"), name="a", **file)
    job = JobRow(id=new_id("job"), drive_id=drive.id, model_id=model.id, settings=JOB_SETTINGS, **over)
    training = TrainingRow(id=new_id("trn"), name="t", annotations_id=annotations.id, settings={}, **over)
    stage = StageRow(
        id=new_id("stg"), training_id=training.id, name=StageName.TRAIN, queue="train", state=StageState.DONE
    )  # fmt: skip
    hook = {"url": "https://example.com/hook", "events": [], "secret": "whsec_x", "enabled": True}
    webhook = WebhookRow(id=new_id("whk"), created_at=now, **hook)
    sent = {
        "kind": "ping",
        "body": "{}",
        "state": DeliveryState.DELIVERED,
        "next_at": now,
        "log": [],
        "created_at": now,
    }
    delivery = DeliveryRow(id=new_id("msg"), webhook_id=webhook.id, **sent)
    wanted = JOB_SETTINGS | {"model": "m"}
    rule = RuleRow(id=new_id("rul"), name="r", bucket="b", prefix="", settings=wanted, created_at=now)
    with service.catalog.scoped(project).transaction() as tx:
        for row in (drive, model, annotations, job, training, stage, webhook, delivery, rule):
            tx.session.add(row)
            tx.session.flush()
    names = {"drive_id": drive, "model": model, "annotations_id": annotations, "job_id": job, "training_id": training}
    names |= {"model_id": model, "webhook_id": webhook, "delivery_id": delivery, "rule_id": rule}
    return {name: row.id for name, row in names.items()}


def _documents(client: httpx.Client, belongings: dict[str, str], paths: dict) -> dict[str, tuple]:
    """What a client sees of everything that can be read at a path of its own."""
    seen = {}
    for path, operations in paths.items():
        names = re.findall(r"{(\w+)}", path)
        if "get" in operations and names and set(names) <= belongings.keys() and path.startswith("/v1/"):
            address = path.format(**belongings)
            with client.stream("GET", address) as answer:
                document = "json" in answer.headers.get("content-type", "")
                seen[address] = answer.status_code, answer.read() if document else b""
    return seen


def test_what_one_project_has_does_not_exist_for_another(service, projects, belongings, subtests):
    document = service.http.get("/openapi.json").json()
    ours, theirs = projects["ours"], projects["theirs"]
    before = _documents(ours, belongings, document["paths"])
    assert sum(status == 200 for status, _ in before.values()) >= len(belongings) - 2, before
    schema = schemathesis.openapi.from_dict(document)
    tried = 0
    for path, operations in document["paths"].items():
        names = re.findall(r"{(\w+)}", path)
        if not names or NOT_OF_A_PROJECT & set(names) or not path.startswith("/v1/"):
            continue
        with subtests.test(path=path):
            ids = {name: belongings.get(name, "nothing") for name in names}
            for method in operations:
                operation = schema[path][method.upper()]
                statuses = set()
                for body in _bodies(operation):
                    statuses.add(theirs.request(method, path.format(**ids), json=body).status_code)
                # Some bodies of the right form are refused for what is in them before anything is looked up.
                assert 404 in statuses and statuses <= {404, 422}, f"{method} {path}: {statuses}"
                tried += 1
    assert tried >= 18
    assert _documents(ours, belongings, document["paths"]) == before, "and nothing was done to it"


def _bodies(operation) -> list:
    """Bodies that the operation takes; None where it takes none."""
    if "requestBody" not in operation.definition.raw:
        return [None]
    found = [{}]

    @settings(
        max_examples=4, deadline=None, database=None, derandomize=True, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(operation.as_strategy(generation_mode=GenerationMode.POSITIVE))
    def collect(case):
        found.append(case.body if isinstance(case.body, dict) else None)

    collect()
    return found


def test_lists_and_filters_show_nothing_of_another_project(service, projects, belongings):
    document = service.http.get("/openapi.json").json()
    theirs, listed = projects["theirs"], 0
    for path, operations in document["paths"].items():
        described = operations.get("get")
        if described is None or "{" in path or not path.startswith("/v1/") or "event-stream" in str(described):
            continue
        queries = [{}]
        for parameter in described.get("parameters", ()):
            name = parameter.get("name", "")
            owned = belongings.get(name) or belongings.get(f"{name}_id")
            if parameter.get("in") == "query" and owned is not None:
                queries.append({name: owned})
        for query in queries:
            answer = theirs.get(path, params=query)
            listed += 1
            if query:
                assert answer.status_code == 404 or answer.json()["items"] == [], f"{path} {query}"
            else:
                assert not [id for id in belongings.values() if id in answer.text], path
    assert listed >= 7


@pytest.mark.parametrize(
    ("path", "body", "names"),
    [
        ("/v1/jobs", {"drive_id": "drive_id", "model": "model"}, {"drive_id", "model"}),
        ("/v1/models/train", {"annotations": "annotations_id", "name": "x", "backbone": "scratch"}, {"annotations"}),
        ("/v1/models/train", {"annotations": "upload_id", "name": "x", "backbone": "scratch"}, {"annotations"}),
    ],
)
def test_nothing_of_another_project_can_be_used(service, projects, belongings, path, body, names):
    request = body | {name: belongings[body[name]] for name in names}
    answer = projects["theirs"].post(path, json=request)
    assert answer.status_code == 404, answer.text
    own = projects["theirs"].post(path, json=request | dict.fromkeys(names, "nothing"))
    assert own.status_code == 404, "it is told as what is not there at all"


def test_two_projects_may_use_the_same_names_and_keys_for_repetition(projects):
    upload = {"kind": "model", "filename": "m.zip", "size": 9}
    headers = {"Idempotency-Key": "the same"}
    made = {owner: client.post("/v1/uploads", json=upload, headers=headers) for owner, client in projects.items()}
    assert made["ours"].json()["id"] != made["theirs"].json()["id"]
    assert "idempotent-replay" not in made["theirs"].headers
