"""Metrics of the threads that tidy up and deliver; each API process counts its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from l3ps_platform.workflow.chores import Chore


class ChoreCollector(Collector):
    """How often steps of the chores failed.

    Args:
        chores: of this process.
    """

    def __init__(self, chores: Sequence[Chore]) -> None:
        self._chores = chores

    def collect(self) -> Iterator[CounterMetricFamily]:
        """Every step, those that never failed too: a rate needs the zero."""
        said = "Steps of the reconciler, sweeper and deliverer, or rows they were about, that failed."
        failures = CounterMetricFamily("l3ps_chore_failures", said, labels=["chore", "step"])
        for chore in self._chores:
            for step, count in chore.failures.items():
                failures.add_metric([chore.name, step], count)
        yield failures
