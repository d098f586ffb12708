"""The main job from end to end through the REST API and the commands, with a real worker."""

import io
import json
import tarfile

import httpx
import numpy as np
import pytest

from l3ps_cli.packing import pack_bundle, pack_log

SUBMIT = ("--preset", "fast", "--format", "nuscenes", "--format", "semantickitti", "--wait", "--json")


@pytest.fixture(scope="session")
def finished(service, command, drive_log, bundle) -> dict:
    """A job that ``l3ps submit --wait`` saw through."""
    code, out, err = command("submit", drive_log, "--model", bundle, *SUBMIT)
    assert code == 0, err
    return json.loads(out)


@pytest.fixture(scope="session")
def packed(drive_log, tmp_path_factory) -> bytes:
    archive = tmp_path_factory.mktemp("packed") / "street.tar"
    pack_log(drive_log, archive)
    return archive.read_bytes()


def test_the_job_tells_what_was_done_and_how_good_it_is(finished):
    assert finished["state"] == "succeeded" and finished["progress"] == 1.0
    assert finished["drive"]["name"] == "street" and finished["model"]["name"] == "colours"
    (scene,) = finished["scenes"]
    assert (scene["scans"], scene["state"]) == (3, "done")
    assert [stage["name"] for stage in scene["stages"]] == ["segment", "refine"]
    assert {stage["name"] for stage in finished["stages"]} == {"ingest", "publish"}
    for stage in scene["stages"] + finished["stages"]:
        assert stage["state"] == "done" and stage["seconds"] > 0, stage
    assert {"ground", "cluster", "vote"} <= {step["name"] for step in scene["stages"][1]["steps"]}
    quality = finished["quality"]
    assert quality["protocol"] == "nuscenes"
    for side in ("primal", "refined"):
        assert 0 <= quality[side]["pq"] <= 100 and "car" in quality[side]["classes"]


def test_download_brings_labels_for_every_point_once(command, finished, drive_log, tmp_path):
    code, _, err = command("download", finished["id"], "--out", tmp_path)
    assert code == 0, err
    scans = list((drive_log / "samples" / "LIDAR_TOP").iterdir())
    files = sorted((tmp_path / "refined" / "panoptic").glob("*_panoptic.npz"))
    assert len(files) == len(scans) == 3
    assert len(list((tmp_path / "primal" / "lidarseg").glob("*_lidarseg.bin"))) == 3
    assert len((tmp_path / "poses.txt").read_text().splitlines()) == 3
    points = sorted(scan.stat().st_size // 20 for scan in scans)
    assert sorted(len(np.load(file)["data"]) for file in files) == points

    before = {file: file.stat().st_mtime_ns for file in files[1:]}
    files[0].write_bytes(b"damaged")
    assert command("download", finished["id"], "--out", tmp_path)[0] == 0
    assert np.load(files[0])["data"].dtype == np.uint16
    assert {file: file.stat().st_mtime_ns for file in files[1:]} == before, "what was whole is not fetched again"


def test_every_format_asked_for_is_there_and_no_other(service, command, finished, tmp_path):
    assert command("download", finished["id"], "--format", "semantickitti", "--out", tmp_path)[0] == 0
    assert len(list(tmp_path.glob("refined/sequences/*/predictions/*.label"))) == 3
    answer = service.http.get(f"/v1/jobs/{finished['id']}/labels", params={"format": "ply"})
    assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "query format"


def test_the_jobs_command_lists_and_shows(command, finished):
    code, out, _ = command("jobs", "--json")
    assert code == 0 and finished["id"] in [job["id"] for job in json.loads(out)["items"]]
    code, out, _ = command("jobs", finished["id"])
    assert "refine" in out and "Quality" in out


def test_what_the_service_has_is_not_sent_again_and_not_computed_again(service, command, finished, drive_log, bundle):
    code, out, err = command("submit", drive_log, "--model", bundle, *SUBMIT)
    again = json.loads(out)
    assert code == 0 and "has this log already" in err
    assert again["drive"]["id"] == finished["drive"]["id"]
    assert all(stage["cached"] for scene in again["scenes"] for stage in scene["stages"])
    assert again["quality"] == finished["quality"]


def test_jobs_come_in_pages_newest_first(service, finished):
    seen, cursor = [], None
    while True:
        page = service.http.get("/v1/jobs", params={"limit": 1} | ({"cursor": cursor} if cursor else {})).json()
        seen += [job["id"] for job in page["items"]]
        cursor = page.get("next")
        if cursor is None:
            break
    assert seen == sorted(seen, reverse=True) and len(set(seen)) == len(seen)
    assert finished["id"] in seen
    only = service.http.get("/v1/jobs", params={"state": "succeeded"}).json()["items"]
    assert {job["state"] for job in only} == {"succeeded"}


def test_jobs_are_found_by_what_they_are_on_and_when_they_were_made(service, finished):
    def found(**wanted) -> set[str]:
        answer = service.http.get("/v1/jobs", params={"limit": 200} | wanted)
        assert answer.status_code == 200, answer.text
        return {job["id"] for job in answer.json()["items"]}

    on_it = {"drive_id": finished["drive"]["id"], "model_id": finished["model"]["id"]}
    assert finished["id"] in found(**on_it, state=["succeeded", "failed"], created_after=finished["created_at"])
    assert finished["id"] not in found(**on_it, created_before=finished["created_at"])
    assert found(drive_id="drv_none") == set()
    assert found(created_after="0001-01-01T00:00:00+14:00", created_before="9999-12-31T23:59:59-14:00") >= found(
        **on_it
    )
    for name, value in (("created_after", "yesterday"), ("created_before", "2026-01-01T00:00:00"), ("state", "done")):
        answer = service.http.get("/v1/jobs", params={name: value})
        assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"].startswith(f"query {name}")


def test_metrics_tell_of_scans_points_seconds_and_quality(service, finished):
    metrics = service.http.get("/metrics").text
    assert 'stage="refine"' in metrics
    assert finished["id"] in metrics
    for word in ("scans", "points", "seconds", "pq", "miou"):
        assert word in metrics, word


def test_a_job_on_a_drive_being_checked_waits_for_it(service, finished, packed):
    drive = service.upload(packed + bytes(1024), "waits.tar").json()
    request = {"drive_id": drive["id"], "model": "colours", "preset": "fast"}
    answer = service.http.post("/v1/jobs", json=request)
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    answer = service.http.get(f"/v1/jobs/{job['id']}/labels")
    assert "when it has succeeded" in service.refused(answer, 409, "no-labels")["detail"]
    answer = service.http.delete(f"/v1/drives/{drive['id']}")
    service.refused(answer, 409, "conflict")

    assert service.wait_for_job(job["id"])["state"] == "succeeded"
    assert service.http.delete(f"/v1/drives/{drive['id']}").status_code == 204
    service.refused(service.http.get(f"/v1/drives/{drive['id']}"), 404, "unknown-drive")
    files = service.http.get(f"/v1/jobs/{job['id']}/labels").json()["files"]
    assert files and httpx.get(files[0]["url"]).is_success, "a finished job keeps its labels"


def test_a_job_can_be_cancelled(service, finished, packed):
    drive = service.upload(packed + bytes(2048), "cancelled.tar").json()
    request = {"drive_id": drive["id"], "model": "colours"}
    job = service.http.post("/v1/jobs", json=request).json()
    answer = service.http.post(f"/v1/jobs/{job['id']}/cancel")
    assert answer.status_code == 202 and answer.json()["cancel_requested"]
    assert service.wait_for_job(job["id"])["state"] == "cancelled"
    assert service.http.post(f"/v1/jobs/{job['id']}/cancel").status_code == 202, "it stays so"
    over = service.http.post(f"/v1/jobs/{finished['id']}/cancel")
    assert "succeeded already" in service.refused(over, 409, "conflict")["detail"]
    answer = service.http.get(f"/v1/jobs/{job['id']}/labels")
    service.refused(answer, 409, "no-labels")


def test_labels_of_an_unknown_job(service):
    document = service.refused(service.http.get("/v1/jobs/job_none/labels"), 404, "unknown-job")
    assert "job_none" in document["detail"] and "/v1/jobs" in document["detail"]


def test_a_job_needs_a_drive_and_a_model_that_exist(service, finished):
    request = {"drive_id": "drv_none", "model": "colours"}
    service.refused(service.http.post("/v1/jobs", json=request), 404, "unknown-drive")
    request = {"drive_id": finished["drive"]["id"], "model": "none"}
    service.refused(service.http.post("/v1/jobs", json=request), 404, "unknown-model")


def test_a_bundle_that_is_none_is_rejected_and_can_be_corrected(service, bundle, tmp_path):
    empty = io.BytesIO()
    with tarfile.open(fileobj=empty, mode="w"):
        pass
    answer = service.upload(empty.getvalue(), "model.zip", "model", name="mended")
    service.refused(answer, 422, "not-an-archive")

    model = service.upload(b"PK\x03\x04 but no zip", "model.zip", "model", name="mended").json()
    rejected = service.wait(f"/v1/models/{model['id']}", lambda model: model["state"] in ("ready", "rejected"))
    assert rejected["state"] == "rejected" and rejected["problems"]

    archive = tmp_path / "colours.zip"
    pack_bundle(bundle, archive)
    model = service.upload(archive.read_bytes(), "model.zip", "model", name="mended").json()
    assert service.wait("/v1/models/mended", lambda model: model["state"] == "ready")["id"] == model["id"]
