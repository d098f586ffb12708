"""A job that was cancelled is run again through the REST API."""

from l3ps_cli.packing import pack_bundle, pack_log


def test_a_cancelled_job_runs_again_and_a_succeeded_one_does_not(service, drive_log, bundle, tmp_path) -> None:
    pack_log(drive_log, tmp_path / "street.tar")
    pack_bundle(bundle, tmp_path / "m.zip")
    service.upload((tmp_path / "m.zip").read_bytes(), "m.zip", "model", name="again")
    drive = service.upload((tmp_path / "street.tar").read_bytes()).json()["id"]
    job = service.http.post("/v1/jobs", json={"drive_id": drive, "model": "again", "preset": "fast"}).json()["id"]
    service.refused(service.http.post(f"/v1/jobs/{job}/retry"), 409, "conflict")
    service.http.post(f"/v1/jobs/{job}/cancel")
    assert service.wait_for_job(job)["state"] == "cancelled"
    answer = service.http.post(f"/v1/jobs/{job}/retry")
    assert (answer.status_code, answer.json()["state"]) == (202, "queued")
    assert service.wait_for_job(job)["state"] == "succeeded"
    document = service.refused(service.http.post(f"/v1/jobs/{job}/retry"), 409, "conflict")
    assert "failed or cancelled job can be run again" in document["detail"]


def test_unknown_ones_are_not_found(service) -> None:
    service.refused(service.http.post("/v1/jobs/job_none/retry"), 404, "unknown-job")
    service.refused(service.http.post("/v1/trainings/trn_none/retry"), 404, "unknown-training")
