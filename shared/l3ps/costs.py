"""What a stage costs: wall seconds, CPU seconds and peak memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


@dataclass(slots=True)
class StageCost:
    """Cost of one stage.

    Attributes:
        seconds: wall time.
        cpu_seconds: CPU time of the process in that span.
        peak_mb: highest resident memory of the process during the stage, in MB, or since the process started where
            the kernel does not allow the mark to be reset.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0

    def add(self, other: StageCost) -> None:
        """Count another span to this stage: times add up, the higher peak stays."""
        self.seconds += other.seconds
        self.cpu_seconds += other.cpu_seconds
        self.peak_mb = max(self.peak_mb, other.peak_mb)


class CostBook:
    """Costs by stage name, filled by :meth:`span`."""

    def __init__(self) -> None:
        self.stages: dict[str, StageCost] = {}

    @contextmanager
    def span(self, stage: str) -> Iterator[None]:
        """Count the time and memory of a ``with`` block to a stage; spans of one name add up."""
        _reset_peak()
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            cost = StageCost(time.perf_counter() - wall, time.process_time() - cpu, peak_mb())
            self.stages.setdefault(stage, StageCost()).add(cost)


def peak_mb() -> float:
    """Highest resident memory of the process since the last reset, in MB."""
    try:
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _reset_peak() -> None:
    with suppress(OSError):
        _CLEAR.write_text("5")  # resets VmHWM, see proc(5)
