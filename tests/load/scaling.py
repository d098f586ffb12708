"""How much faster two workers are than one, with one thread each: ``make bench-scaling``.

The same scenes with one worker and with two, on PostgreSQL, MinIO and Redis of their own, each time in a fresh catalog
and bucket. Workers are up and warm when the clock starts, and the drive has been checked. It runs from the job's
creation to its end, so it holds everything between: messages, claims, commits, publication. Beside it the same scenes
in bare processes (:mod:`bare`), and where the workers' time went.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import bare
import numpy as np
from onnx import TensorProto, helper, numpy_helper

os.environ["L3PS_CHAOS"] = "1"
sys.path.insert(0, str(Path(__file__).parents[1] / "chaos"))

from chaoslib import workload
from chaoslib.servers import Minio, Postgres, Redis, wait_until
from chaoslib.stack import Servers, Service
from chaoslib.workload import Case, Workload
from sqlalchemy import select

from l3ps_platform.catalog import JobState
from l3ps_platform.catalog.attempt_rows import AttemptRow

GOAL = 0.55
AS_SHIPPED = {
    "lease_seconds": 60.0,
    "heartbeat_seconds": 10.0,
    "reconcile_seconds": 5.0,
    "retry_seconds": 5.0,
    "resend_seconds": 30.0,
    "progress_seconds": 0.5,
}
CASE = Case(0, "best", "nuscenes")


def network(path: Path, layers: int = 4, height: int = 192, width: int = 320) -> bytes:
    """The workload's network made slow by convolutions that change nothing: some seconds a scene."""
    same = np.zeros((3, 3, 9, 9), np.float32)
    same[range(3), range(3), 4, 4] = 1
    names = ["image", *(f"x{n}" for n in range(layers))]
    nodes = [helper.make_node("Conv", [a, "same"], [b], pads=[4] * 4) for a, b in pairwise(names)]
    nodes.append(helper.make_node("Identity", names[-1:], ["logits"]))
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, height, width]) for name in ("image", "logits")
    ]
    graph = helper.make_graph(nodes, "slow", ends[:1], ends[1:], [numpy_helper.from_array(same, "same")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return workload.bundle(path, model.SerializeToString(), height, width)


def measure(workers: int, folder: Path, servers: Servers, work: Workload) -> dict[str, float]:
    """Seconds from the job's creation to its end, and what its stages took of them."""
    servers.redis = Redis(folder / "redis")
    servers.redis.start()
    service = Service(folder, servers, work, lambda name, value: None, **AS_SHIPPED)
    try:
        service.start_api()
        service.upload(work.model, "m.zip", "model", name="colours")
        service.drives = [service.upload(drive, "d.zip", "drive") for drive in work.drives]
        for n in range(workers):
            service.start_worker(f"w{n}")
        warm = [service.submit(Case(n + 1, "best", "nuscenes")) for n in range(2)]
        wait_until(lambda: all(service.job(job).state.final for job in warm), "the workers did not get warm", 120)
        job = service.submit(CASE)
        wait_until(lambda: service.job(job).state.final, "the job did not end", 600)
        row = service.job(job)
        assert row.state is JobState.SUCCEEDED, row.error
        seconds = (row.finished_at - row.created_at).total_seconds()
        with service.catalog.reading() as session:
            attempts = session.scalars(select(AttemptRow).where(AttemptRow.job_id == job)).all()
        return {
            "seconds": seconds,
            "stages' seconds": sum(attempt.seconds for attempt in attempts),
            "stages' CPU seconds": sum(attempt.cpu_seconds for attempt in attempts),
            "workers idle": 1 - sum(attempt.seconds for attempt in attempts) / seconds / workers,
        }
    finally:
        service.close()
        servers.redis.stop()


def main() -> int:
    """Print the figures as JSON; 1 when two workers are not fast enough."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=8, help="an even number")
    parser.add_argument("--scans", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=1, help="the best of so many counts")
    given = parser.parse_args()
    kept = os.environ.get("L3PS_CHAOS_CACHE")
    with tempfile.TemporaryDirectory(prefix="l3ps-scaling-") as name:
        folder = Path(name)
        drives = Path(kept) if kept else folder / "drives"
        drives.mkdir(exist_ok=True)
        simulated = workload.drive(
            drives / f"scaling-{given.scenes}x{given.scans}", scenes=given.scenes, scans=given.scans, seed=7
        )
        warm = [workload.drive(drives / f"warm-{n}", scenes=1, scans=1, seed=n + 50) for n in range(2)]
        work = Workload([simulated, *warm], b"", network(folder / "m.zip"), b"")
        servers = Servers(Redis(folder / "redis"), Minio(folder / "minio"), Postgres())
        servers.postgres.start()
        servers.minio.start()
        try:
            service = {
                workers: min(
                    (measure(workers, folder / f"{workers}-{n}", servers, work) for n in range(given.rounds)),
                    key=lambda found: found["seconds"],
                )
                for workers in (1, 2)
            }
        finally:
            servers.minio.stop()
            servers.postgres.stop()
        alone = beside(folder, simulated, work.model, given.rounds)
    figures: dict[str, Any] = {"scenes": given.scenes, "scans": given.scans, "service": service, "bare": alone}
    ratio = service[2]["seconds"] / service[1]["seconds"]
    figures |= {"ratio": round(ratio, 3), "bare ratio": round(alone[2] / alone[1], 3), "goal": GOAL}
    print(json.dumps(figures, indent=1, default=str))
    return 0 if ratio <= GOAL else 1


def beside(folder: Path, drive: bytes, model: bytes, rounds: int) -> dict[int, float]:
    """Processes → seconds of the same scenes without a service."""
    for name, content in {"drive": drive, "model": model}.items():
        (folder / f"{name}.zip").write_bytes(content)
        shutil.unpack_archive(folder / f"{name}.zip", folder / name)
    return {
        processes: min(bare.seconds(folder / "drive", folder / "model", CASE.preset, processes) for _ in range(rounds))
        for processes in (1, 2)
    }


if __name__ == "__main__":
    sys.exit(main())
