"""Work that keeps the workers busy: jobs on simulated drives, none of which finds its result in the cache."""

from __future__ import annotations

import threading
import time
from itertools import cycle, product
from pathlib import Path
from typing import Any

import httpx

from l3ps.simulate import simulate_drive
from l3ps_cli.demo import DEMO_MODEL
from l3ps_cli.packing import pack_bundle, pack_log

LOOKS = tuple(product(("paper", "best", "fast"), (["nuscenes"], ["semantickitti"], ["nuscenes", "semantickitti"])))
"""What may differ between two jobs on a drive; each computes something anew."""
SCANS = 4
READY_SECONDS = 120.0


class Feeder:
    """Uploads drives and submits jobs, at first as many as there are clients, then as many as are finished.

    Args:
        http: a client of the service.
        folder: for the drive and the model.
    """

    def __init__(self, http: httpx.Client, folder: Path) -> None:
        self._http = http
        simulate_drive(folder / "log", scenes=1, scans=SCANS, seed=3, width=320)
        pack_log(folder / "log", folder / "log.tar")
        pack_bundle(DEMO_MODEL, folder / "model.zip")
        self._log = (folder / "log.tar").read_bytes()
        model = self._upload((folder / "model.zip").read_bytes(), "model.zip", "model", name="demo")
        self._wait(f"/v1/models/{model['id']}")
        self._looks = cycle(LOOKS)
        self._drives = 0
        self._drive = ""
        self.jobs: list[str] = []

    def submit(self, count: int) -> list[str]:
        """So many new jobs; their ids."""
        made = []
        for _ in range(count):
            if len(self.jobs) % len(LOOKS) == 0:
                self._drives += 1  # bytes after a tar's end change its checksum and nothing else
                self._drive = self._upload(self._log + bytes(512 * self._drives), "log.tar", "drive")["id"]
            preset, formats = next(self._looks)
            request = {"drive_id": self._drive, "model": "demo", "preset": preset, "formats": formats}
            made.append(self._post("/v1/jobs", request)["id"])
            self.jobs.append(made[-1])
        return made

    def under_way(self) -> int:
        """How many jobs are not over."""
        counts = [self._http.get("/v1/jobs", params={"state": state, "limit": 200}) for state in ("queued", "running")]
        return sum(len(answer.raise_for_status().json()["items"]) for answer in counts)

    def keep_busy(self, stop: threading.Event, at_least: int) -> None:
        """Submit more whenever fewer jobs than that are under way."""
        while not stop.wait(5):
            if self.under_way() < at_least:
                self.submit(len(LOOKS))

    def _upload(self, data: bytes, filename: str, kind: str, **completion: str) -> dict[str, Any]:
        upload = self._post("/v1/uploads", {"kind": kind, "filename": filename, "size": len(data)})
        parts = []
        for part in upload["parts"]:
            start = (part["number"] - 1) * upload["part_size"]
            answer = httpx.put(part["url"], content=data[start : start + upload["part_size"]], trust_env=False)
            parts.append({"number": part["number"], "etag": answer.raise_for_status().headers["etag"]})
        return self._post(f"/v1/uploads/{upload['id']}/complete", {"parts": parts, **completion})

    def _post(self, path: str, document: dict[str, Any]) -> dict[str, Any]:
        answer = self._http.post(path, json=document)
        answer.raise_for_status()
        made: dict[str, Any] = answer.json()
        return made

    def _wait(self, path: str) -> None:
        deadline = time.monotonic() + READY_SECONDS
        while self._http.get(path).raise_for_status().json()["state"] != "ready":
            if time.monotonic() > deadline:
                raise TimeoutError(f"{path} was not ready within {READY_SECONDS:.0f} s")
            time.sleep(0.2)
