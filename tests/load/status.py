"""The load test: 200 clients that each read their job's status once a second while two workers are busy.

``python tests/load/status.py [embedded] [servers]`` runs it on the stacks named, both by default, and writes
load-report.json. L3PS_LOAD_SECONDS (180) and L3PS_LOAD_CLIENTS (200) make it shorter. Afterwards limits are set low:
the excess must get 429 with Retry-After, and nothing else may fail. Exit code 1 where a bound is broken.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx

sys.path.insert(0, str(Path(__file__).parent))
from stacks import WORKERS, Running, embedded, servers
from work import Feeder

SECONDS = float(os.environ.get("L3PS_LOAD_SECONDS", "180"))
CLIENTS = int(os.environ.get("L3PS_LOAD_CLIENTS", "200"))
P99_MS = 500.0
LIMITED = {"L3PS_RATE_PER_SECOND": "20", "L3PS_RATE_BURST": "20"}
LIMITED_SECONDS, LIMITED_CLIENTS = 15.0, 60
STACKS = {"embedded": embedded, "servers": servers}


def main() -> int:
    """Run, report; 0 where every bound holds."""
    chosen = sys.argv[1:] or list(STACKS)
    report: dict[str, Any] = {"seconds": SECONDS, "clients": CLIENTS, "workers": WORKERS, "stacks": {}}
    report["cores"] = len(os.sched_getaffinity(0))
    broken: list[str] = []
    for name in chosen:
        found = {"load": _load(name), "limited": _limited(name)}
        report["stacks"][name] = found
        broken += [f"{name}: {fault}" for fault in _faults(found)]
    report["broken"] = broken
    Path("load-report.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))
    return 1 if broken else 0


def _load(name: str) -> dict[str, Any]:
    """The load itself."""
    with tempfile.TemporaryDirectory(prefix="l3ps-load-") as folder, STACKS[name](Path(folder) / "data", {}) as stack:
        headers = {"Authorization": f"Bearer {stack.token}"}
        with httpx.Client(base_url=stack.url, headers=headers, timeout=60, trust_env=False) as http:
            feeder = Feeder(http, Path(folder))
            print(f"{name}: submitting {CLIENTS} jobs", flush=True)
            ids = feeder.submit(CLIENTS)
            stop = threading.Event()
            busy = threading.Thread(target=feeder.keep_busy, args=(stop, 4 * WORKERS))
            busy.start()
            watch = _Watch(stack)
            print(f"{name}: {CLIENTS} clients for {SECONDS:.0f} s", flush=True)
            done_before = _succeeded(http)
            try:
                result = _clients(stack, ids, SECONDS, CLIENTS)
            finally:
                stop.set()
                busy.join(60)
            result |= watch.end() | {"jobs_finished_meanwhile": _succeeded(http) - done_before}
            result["jobs_under_way_at_the_end"] = feeder.under_way()
            return result


def _limited(name: str) -> dict[str, Any]:
    """The same clients against low limits, on a service without work."""
    with tempfile.TemporaryDirectory(prefix="l3ps-load-") as folder, STACKS[name](Path(folder), LIMITED) as stack:
        print(f"{name}: {LIMITED_CLIENTS} clients against {LIMITED}", flush=True)
        return _clients(stack, [], LIMITED_SECONDS, LIMITED_CLIENTS)


def _clients(stack: Running, ids: list[str], seconds: float, clients: int) -> dict[str, Any]:
    """Have the clients do their reading; what they met."""
    url = urlsplit(stack.url)
    plan = {
        "host": url.hostname,
        "port": url.port,
        "headers": {"Authorization": f"Bearer {stack.token}"},
        "paths": [f"/v1/jobs/{id}" for id in ids] or ["/v1/jobs"],
        "interval": 1.0,
        "clients": clients,
        "seconds": seconds,
    }
    command = [sys.executable, str(Path(__file__).parent / "clients.py")]
    done = subprocess.run(
        command, input=json.dumps(plan), capture_output=True, text=True, check=False, timeout=seconds + 120
    )
    if done.returncode != 0:
        sys.exit(f"the clients failed:\n{done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


class _Watch:
    """Looks at the API's process and scrapes its metrics, as Prometheus would, every few seconds."""

    def __init__(self, stack: Running) -> None:
        self._stack = stack
        self._pid = stack.api.pid
        self._cpu, self._since = self._processor_seconds(), time.monotonic()
        self._rss: list[float] = [self._megabytes()]
        self._scrapes: list[float] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def end(self) -> dict[str, Any]:
        """What was seen."""
        self._over.set()
        self._thread.join()
        share = (self._processor_seconds() - self._cpu) / (time.monotonic() - self._since)
        return {
            "api_rss_mb": {"first": self._rss[0], "last": self._rss[-1], "highest": max(self._rss)},
            "api_cores": round(share, 2),
            "scrape_ms_slowest": round(max(self._scrapes, default=0.0) * 1000, 1),
        }

    def _look(self) -> None:
        while not self._over.wait(5):
            self._rss.append(self._megabytes())
            started = time.monotonic()
            httpx.get(f"{self._stack.url}/metrics", timeout=30, trust_env=False).raise_for_status()
            self._scrapes.append(time.monotonic() - started)

    def _megabytes(self) -> float:
        status = Path(f"/proc/{self._pid}/status").read_text().splitlines()
        return round(next(int(line.split()[1]) for line in status if line.startswith("VmRSS:")) / 1024, 1)

    def _processor_seconds(self) -> float:
        fields = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _succeeded(http: httpx.Client) -> int:
    lines = [line for line in http.get("/metrics").text.splitlines() if line.startswith("l3ps_jobs{")]
    return sum(int(float(line.split()[-1])) for line in lines if 'state="succeeded"' in line)


def _faults(found: dict[str, Any]) -> list[str]:
    load, limited = found["load"], found["limited"]
    faults = []
    if load["faults"] or set(load["statuses"]) != {"200"}:
        faults.append(f"answers under load: {load['statuses']}, faults: {load['faults']}")
    if load["p99_ms"] is None or load["p99_ms"] >= P99_MS:
        faults.append(f"p99 {load['p99_ms']} ms, the bound is {P99_MS:.0f} ms")
    if limited["faults"] or set(limited["statuses"]) != {"200", "429"} or limited["without_retry_after"]:
        faults.append(
            f"answers beyond the limits: {limited['statuses']}, faults: {limited['faults']}, "
            f"429 without Retry-After: {limited['without_retry_after']}"
        )
    return faults


if __name__ == "__main__":
    sys.exit(main())
