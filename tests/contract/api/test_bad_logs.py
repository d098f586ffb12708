"""Archives that hold no usable drive log: each is rejected with its problems, and nothing of it stays in the store."""

import io
import json
import shutil
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest


def zipped(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return buffer.getvalue()


def truncated_zip(log: Path) -> bytes:
    data = zipped(log)
    return data[: len(data) // 2]


def zip_slip(log: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("../../escaped.txt", "out of here")
    return buffer.getvalue()


def link_to_the_outside(log: Path) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        link = tarfile.TarInfo("samples")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc"
        tar.addfile(link)
    return buffer.getvalue()


def no_log(log: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("readme.txt", "no drive log")
    return buffer.getvalue()


def without_lidar(log: Path) -> bytes:
    shutil.rmtree(log / "samples" / "LIDAR_TOP")
    return zipped(log)


def without_calibration(log: Path) -> bytes:
    (log / "v1.0-mini" / "calibrated_sensor.json").write_text("[]")
    return zipped(log)


def scan_of_three_bytes(log: Path) -> bytes:
    scan = min((log / "samples" / "LIDAR_TOP").iterdir())
    scan.write_bytes(b"abc")
    return zipped(log)


CASES: list[tuple[Callable[[Path], bytes], str]] = [
    (truncated_zip, ".zip"),
    (zip_slip, "escaped.txt"),
    (link_to_the_outside, "samples"),
    (no_log, ""),
    (without_lidar, "LIDAR_TOP"),
    (without_calibration, "calibrated_sensor"),
]


@pytest.fixture
def log(drive_log, tmp_path) -> Path:
    return Path(shutil.copytree(drive_log, tmp_path / "log"))


@pytest.mark.parametrize(("spoil", "where"), CASES, ids=[case[0].__name__ for case in CASES])
def test_a_bad_log_is_rejected_with_its_problems_and_its_archive_is_gone(service, log, spoil, where):
    before = service.objects()
    answer = service.upload(spoil(log), f"{spoil.__name__}.zip")
    assert answer.status_code == 202, answer.text
    drive = service.wait_for_drive(answer.json()["id"])

    assert drive["state"] == "rejected"
    for problem in drive["problems"]:
        assert problem["where"] and problem["what"] and problem["remedy"]
    assert where in json.dumps(drive["problems"])
    assert not list(Path("/").glob("escaped.txt")) and not list(service.settings.scratch.rglob("escaped.txt"))
    service.wait("/healthz", lambda _: service.objects() == before)

    request = {"drive_id": drive["id"], "model": "any"}
    answer = service.http.post("/v1/jobs", json=request)
    assert answer.status_code in (404, 422)


def test_a_job_on_a_rejected_drive_is_refused_with_the_drives_problems(service, log, model):
    drive = service.wait_for_drive(service.upload(without_lidar(log), "blind.zip").json()["id"])
    answer = service.http.post("/v1/jobs", json={"drive_id": drive["id"], "model": model})
    document = service.refused(answer, 422, "unusable-input")
    assert document["errors"] == drive["problems"]
    assert document["errors"][0]["what"] in document["detail"]


def test_a_job_that_was_waiting_when_its_drive_was_rejected_fails_with_its_problems(service, log, model):
    drive = service.upload(truncated_zip(log), "waited.zip").json()
    answer = service.http.post("/v1/jobs", json={"drive_id": drive["id"], "model": model})
    if answer.status_code == 422:
        pytest.skip("the check was faster than the request")
    job = service.wait_for_job(answer.json()["id"])
    assert job["state"] == "failed" and job["errors"] and job["drive"]["state"] == "rejected"


def test_submitting_a_bad_log_ends_with_its_problems_and_exit_code_2(service, command, log, model):
    shutil.rmtree(log / "samples" / "LIDAR_TOP")
    code, _, err = command("submit", log, "--model", model, "--wait")
    assert code == 2
    assert "LIDAR_TOP" in err and "state" not in err
    code, _, err = command("submit", log, "--model", "no-such-model")
    assert (code, "'no-such-model'" in err) == (2, True)


def test_a_scan_of_three_bytes_is_named_and_can_be_skipped(service, log, model):
    drive = service.wait_for_drive(service.upload(scan_of_three_bytes(log), "torn.zip").json()["id"])
    torn = [problem for problem in drive["problems"] if "LIDAR_TOP" in problem["where"]]
    assert len(torn) == 1 and "3 bytes" in torn[0]["what"] and torn[0]["severity"] == "scan", drive["problems"]

    request = {"drive_id": drive["id"], "model": model, "preset": "fast"}
    document = service.refused(service.http.post("/v1/jobs", json=request), 422, "unusable-input")
    assert "skip_bad_scans" in document["detail"]
    answer = service.http.post("/v1/jobs", json=request | {"skip_bad_scans": True})
    assert answer.status_code == 202
    job = service.wait_for_job(answer.json()["id"])
    assert job["state"] == "succeeded", job["message"]
    assert [scene["scans"] for scene in job["scenes"]] == [2]


@pytest.fixture(scope="session")
def model(service, bundle, tmp_path_factory) -> str:
    """The name of a model that is ready."""
    from l3ps_cli.packing import pack_bundle

    archive = tmp_path_factory.mktemp("model") / "colours.zip"
    pack_bundle(bundle, archive)
    answer = service.upload(archive.read_bytes(), "colours.zip", "model", name="for-bad-logs")
    service.wait("/v1/models/for-bad-logs", lambda model: model["state"] == "ready")
    return answer.json()["name"]
