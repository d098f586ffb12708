"""Models trained by the service, with the real trainer, over the real API."""

import hashlib
import json
import shutil
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from l3ps_cli.packing import pack_log

ROAD, TREES, CAR = 11, 16, 4
QUICK = {"backbone": "scratch", "size": [64, 96], "epochs": 2, "images": 4}


@pytest.fixture(scope="session")
def annotated(tmp_path_factory) -> Path:
    """Six annotated pictures: trees over a road, a bright car somewhere on it."""
    folder = tmp_path_factory.mktemp("annotated") / "six"
    rng = np.random.default_rng(4)
    for number in range(6):
        semantic = np.full((64, 96), TREES, np.uint8)
        semantic[32:] = ROAD
        row, column = rng.integers(28, 44), rng.integers(4, 70)
        semantic[row : row + 12, column : column + 20] = CAR
        colours = np.zeros((256, 3), np.uint8)
        colours[[TREES, ROAD, CAR]] = (20, 120, 20), (90, 90, 90), (240, 240, 250)
        noise = rng.integers(-12, 13, (64, 96, 3))
        for name, image in (
            ("images", (colours[semantic] + noise).clip(0, 255).astype(np.uint8)),
            ("semantic", semantic),
        ):
            (folder / name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(folder / name / f"{number}.png")
    return folder


@pytest.fixture(scope="session")
def uploaded(service, annotated, tmp_path_factory) -> dict:
    """Their archive in the service."""
    archive = tmp_path_factory.mktemp("archive") / "six.tar"
    pack_log(annotated, archive)
    data = archive.read_bytes()
    answer = service.upload(data, "six.tar", "annotations", sha256=hashlib.sha256(data).hexdigest())
    assert answer.status_code == 202, answer.text
    document = answer.json()
    assert answer.headers["location"] == f"/v1/annotations/{document['id']}"
    assert service.http.get(answer.headers["location"]).json() == document
    return document


@pytest.fixture(scope="session")
def trained(command, annotated, uploaded) -> dict:
    """A training that ``l3ps submit-training --wait`` saw through."""
    options = ("--backbone", "scratch", "--size", "64x96", "--epochs", "2", "--images", "4", "--wait", "--json")
    code, out, err = command("submit-training", annotated, "--name", "six-pictures", *options)
    assert code == 0, err
    assert "has these annotations already" in err
    return json.loads(out)


@pytest.mark.once
def test_a_training_ends_in_a_model_with_a_report(service, trained, uploaded):
    assert (trained["state"], trained["progress"]) == ("succeeded", 1.0)
    assert trained["annotations"] == {"id": uploaded["id"], "name": "six"}
    assert trained["settings"]["size"] == [64, 96]
    assert "loss" in trained["figures"]
    assert trained["stage"]["name"] == "train" and trained["stage"]["cpu_seconds"] > 0
    assert "train" in {step["name"] for step in trained["stage"]["steps"]}
    assert trained["report"]
    model = service.http.get("/v1/models/six-pictures").json()
    assert (model["state"], model["id"]) == ("ready", trained["model"]["id"])
    assert (model["info"]["input"], model["info"]["report"]) == ([64, 96], trained["report"])
    assert trained["log"] and httpx.get(trained["log_url"]).text.endswith(trained["log"])


@pytest.mark.once
def test_its_bundle_can_be_fetched(trained, tmp_path):
    archive = tmp_path / "m.zip"
    archive.write_bytes(httpx.get(trained["bundle_url"]).content)
    with zipfile.ZipFile(archive) as bundle:
        assert json.loads(bundle.read("model.json"))["name"] == "six-pictures"
        assert {"model.onnx", "report.json", "report.md"} <= set(bundle.namelist())


@pytest.mark.once
def test_its_model_labels_a_drive(command, trained, drive_log):
    words = ("--model", "six-pictures", "--preset", "fast", "--wait", "--json")
    code, out, err = command("submit", drive_log, *words)
    assert code == 0, err
    assert json.loads(out)["state"] == "succeeded"


@pytest.mark.once
def test_the_same_request_again_answers_with_the_same_training(service, trained, uploaded):
    request = QUICK | {"name": "six-pictures", "annotations": uploaded["id"]}
    answer = service.http.post("/v1/models/train", json=request)
    assert (answer.status_code, answer.json()["id"]) == (202, trained["id"])
    assert answer.headers["location"] == f"/v1/trainings/{trained['id']}"
    answer = service.http.post("/v1/models/train", json=request | {"seed": 7})
    assert service.refused(answer, 409, "name-taken")["errors"][0]["where"] == "name"


@pytest.mark.once
def test_trainings_are_listed_and_shown(service, command, trained):
    items = service.http.get("/v1/trainings", params={"state": "succeeded"}).json()["items"]
    assert trained["id"] in [item["id"] for item in items]
    code, out, _ = command("trainings", trained["id"])
    assert code == 0 and "six-pictures from six over scratch" in out
    assert 'l3ps_trainings{project="prj_default",state="succeeded"}' in service.http.get("/metrics").text


@pytest.mark.once
def test_annotations_that_cannot_be_used_fail_with_the_trainer_s_words(command, annotated, tmp_path):
    shutil.copytree(annotated, tmp_path / "broken")
    (tmp_path / "broken" / "semantic" / "3.png").write_bytes(b"no picture")
    options = ("--name", "broken", "--backbone", "scratch", "--wait")
    code, _, err = command("submit-training", tmp_path / "broken", *options)
    assert code == 2
    assert "semantic/3.png: the file is neither JPEG nor PNG" in err


def test_an_unknown_backbone_fails_and_names_the_known(service, uploaded):
    classes = {"classes": [{"name": "car", "id": 4}], "void": [0]}
    request = {"name": "unknown", "annotations": uploaded["id"], "backbone": "resnet", "classes": classes}
    training = service.http.post("/v1/models/train", json=request).json()
    failed = service.wait_for_training(training["id"])
    (problem,) = failed["errors"]
    assert (failed["state"], problem["code"]) == ("failed", "unknown-backbone")
    assert "scratch" in problem["remedy"]
    assert [entry["id"] for entry in failed["settings"]["classes"]["classes"]] == [4]
    listed = service.http.get("/v1/trainings", params={"state": "failed"}).json()["items"]
    assert "classes" not in next(item["settings"] for item in listed if item["id"] == training["id"])


@pytest.mark.once
def test_a_training_can_be_cancelled_and_its_annotations_then_deleted(service, annotated, tmp_path):
    archive = tmp_path / "again.tar"
    pack_log(annotated, archive)
    document = service.upload(archive.read_bytes() + bytes(1024), "again.tar", "annotations").json()
    request = QUICK | {"name": "endless", "annotations": document["id"], "epochs": 100_000}
    training = service.http.post("/v1/models/train", json=request).json()
    service.wait(f"/v1/trainings/{training['id']}", lambda now: now["figures"] or now["state"] == "failed")
    path = f"/v1/annotations/{document['id']}"
    service.refused(service.http.delete(path), 409, "conflict")
    answer = service.http.post(f"/v1/trainings/{training['id']}/cancel")
    assert answer.status_code == 202 and answer.json()["cancel_requested"]
    assert service.wait_for_training(training["id"])["state"] == "cancelled"
    service.refused(service.http.get("/v1/models/endless"), 404, "unknown-model")
    assert service.http.delete(path).status_code == 204
    service.refused(service.http.get(path), 404, "unknown-annotations")


def test_only_annotations_can_be_learnt_from(service, uploaded):
    def start(annotations: str, **more) -> httpx.Response:
        return service.http.post("/v1/models/train", json=QUICK | {"name": "x", "annotations": annotations} | more)

    upload = service.announce(100, "bundle.zip", "model")
    document = service.refused(start(upload["id"]), 422, "not-annotations")
    assert "of kind model" in document["detail"] and document["errors"][0]["where"] == "annotations"
    service.refused(start(uploaded["id"], validation=upload["id"]), 422, "not-annotations")
    upload = service.announce(100, "six.tar", "annotations")
    service.refused(start(upload["id"]), 409, "upload-open")
    service.refused(start("ann_none"), 404, "unknown-annotations")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("backbone", "../secret"),
        ("backbone", "onnx:/etc/passwd"),
        ("recipe", "--out=/tmp"),
        ("name", "a/b"),
        ("size", [64]),
        ("classes", {"classes": [{"name": "car", "id": "x" * 101}]}),
        ("classes", {"classes": [{"name": "car", "category": "x" * 101}]}),
        ("classes", {"classes": [{"name": "car", "nuscenes": "x" * 101}]}),
        ("classes", {"classes": [{"name": "car"}], "void": ["x" * 101]}),
        ("classes", {"classes": [{"name": "car"}], "void": [10**400]}),
    ],
)
def test_names_are_names_and_never_paths_or_options(service, uploaded, field, value):
    request = QUICK | {"name": "x", "annotations": uploaded["id"], field: value}
    document = service.refused(service.http.post("/v1/models/train", json=request), 422, "invalid-request")
    assert document["errors"][0]["where"].startswith(field)


def test_a_service_without_a_trainer_says_how_to_get_one(service, api_process):
    url = api_process()
    answer = httpx.post(f"{url}/v1/models/train", json=QUICK | {"name": "x", "annotations": "ann_x"}, timeout=30)
    document = service.refused(answer, 503, "training-unavailable")
    assert "l3ps-trainer" in document["detail"] and "L3PS_TRAINING=1" in document["detail"]


def test_openapi_describes_it(service):
    document = service.http.get("/openapi.json").json()
    for path in ("/v1/models/train", "/v1/trainings", "/v1/trainings/{training_id}", "/v1/annotations"):
        assert path in document["paths"]
    fields = document["components"]["schemas"]["TrainingRequest"]["properties"]
    assert {"name", "annotations", "validation", "backbone", "recipe", "images", "int8", "classes"} <= set(fields)
    assert "annotations" in document["components"]["schemas"]["UploadRequest"]["properties"]["kind"]["enum"]
