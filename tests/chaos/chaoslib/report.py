"""``chaos-report.json`` and ``chaos-report.md``: per scenario what was done, the figures and the verdict.

The table also goes into ``docs/chaos.md``, between its two marks: ``python tests/chaos/chaoslib/report.py``.
"""

import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

JSON, MARKDOWN = "chaos-report.json", "chaos-report.md"
BEGIN, END = "<!-- report: begin -->", "<!-- report: end -->"
_COLUMNS = (
    *("scenario", "what was done", "jobs in flight", "ends", "seconds to the last end", "retries", "failures counted"),
    *("duplicates", "orphans", "seconds in all", "verdict"),
)


def write(folder: Path, results: list[dict[str, Any]]) -> None:
    """Write both, keeping what is there of scenarios that did not run this time."""
    path = folder / JSON
    known = {one["scenario"]: one for one in json.loads(path.read_text())["scenarios"]} if path.exists() else {}
    known |= {one["scenario"]: one for one in results}
    document = {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "scenarios": list(known.values()),
    }
    path.write_text(json.dumps(document, indent=1) + "\n")
    (folder / MARKDOWN).write_text(f"# Chaos report\n\n{table(document)}")


def table(document: dict[str, Any]) -> str:
    """The report as Markdown, without a heading."""
    scenarios = document["scenarios"]
    held = sum(one["verdict"] == "held" for one in scenarios)
    seconds = sum(one["seconds"] for one in scenarios)
    when = f"{document['written'][:10]}, {document['machine']}, {seconds / 60:.0f} minutes"
    lines = [f"{held} of {len(scenarios)} scenarios held. {when}.", ""]
    lines += [f"| {' | '.join(_COLUMNS)} |", "|---" * len(_COLUMNS) + "|"]
    lines += [f"| {' | '.join(_cells(one))} |" for one in scenarios]
    faults = [f"- {one['scenario']}: {one['why']}" for one in scenarios if one["why"]]
    return "\n".join([*lines, *([""] if faults else []), *faults, ""])


def _cells(one: dict[str, Any]) -> list[str]:
    facts = one["facts"]
    ends = ", ".join(f"{count} {state}" for state, count in facts.get("jobs by state", {}).items())
    figures = ("seconds to the end", "attempts beyond the first", "failures counted", "ends told twice", "orphans")
    found = [str(facts.get(name, "")) for name in figures]
    deaths = facts.get("deaths")
    done = one["what"] if deaths is None else f"{one['what']} {sum(deaths.values())} deaths."
    flight = str(facts.get("in flight", ""))
    return [f"`{one['scenario']}`", done.replace("|", "/"), flight, ends, *found, str(one["seconds"]), one["verdict"]]


def insert(report: Path, page: Path) -> None:
    """Put the report's table between the marks of a page."""
    text = page.read_text()
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    page.write_text(f"{before}{BEGIN}\n{table(json.loads(report.read_text()))}{END}{after}")


if __name__ == "__main__":
    insert(Path(JSON), Path("docs/chaos.md"))
