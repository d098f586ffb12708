"""``chaos-report.json`` and ``chaos-report.md``: per scenario what was done, the figures and the verdict."""

import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

JSON, MARKDOWN = "chaos-report.json", "chaos-report.md"
_COLUMNS = (
    *("scenario", "what was done", "jobs in flight", "jobs at the end", "attempts beyond the first"),
    *("failures counted", "seconds", "verdict"),
)


def write(folder: Path, results: list[dict[str, Any]]) -> None:
    """Write both, keeping what is there of scenarios that did not run this time."""
    path = folder / JSON
    known = {one["scenario"]: one for one in json.loads(path.read_text())["scenarios"]} if path.exists() else {}
    known |= {one["scenario"]: one for one in results}
    scenarios = list(known.values())
    document = {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "scenarios": scenarios,
    }
    path.write_text(json.dumps(document, indent=1) + "\n")
    (folder / MARKDOWN).write_text(_markdown(document))


def _markdown(document: dict[str, Any]) -> str:
    scenarios = document["scenarios"]
    held = sum(one["verdict"] == "held" for one in scenarios)
    lines = [
        "# Chaos report",
        "",
        f"{held} of {len(scenarios)} scenarios held. {document['written']}, {document['machine']}.",
        "",
        f"| {' | '.join(_COLUMNS)} |",
        "|---" * len(_COLUMNS) + "|",
    ]
    for one in scenarios:
        facts = one["facts"]
        states = ", ".join(f"{count} {state}" for state, count in facts.get("jobs by state", {}).items())
        figures = [facts.get(name, "") for name in ("attempts beyond the first", "failures counted")]
        cells = [
            one["scenario"],
            one["what"],
            facts.get("in flight", ""),
            states,
            *figures,
            one["seconds"],
            one["verdict"],
        ]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    faults = [f"- {one['scenario']}: {one['why']}" for one in scenarios if one["why"]]
    return "\n".join([*lines, "", *faults, ""])
