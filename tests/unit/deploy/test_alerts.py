"""The alerts: complete, and fired by what they are meant for (promtool)."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "deploy" / "prometheus"
RULES = [rule for group in yaml.safe_load((FOLDER / "rules.yml").read_text())["groups"] for rule in group["rules"]]


def test_promtool_runs_the_rules_through_their_scenarios(prometheus_tool: Callable[[str], Path]) -> None:
    command = [prometheus_tool("promtool"), "test", "rules", "rules.test.yml"]
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_promtool_takes_the_configuration(prometheus_tool: Callable[[str], Path], tmp_path: Path) -> None:
    for name in ("prometheus.yml", "rules.yml"):
        shutil.copy(FOLDER / name, tmp_path)
    (tmp_path / "metrics-token").touch()
    command = [prometheus_tool("promtool"), "check", "config", tmp_path / "prometheus.yml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "rules found" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_an_alert_says_what_is_wrong_and_where_to_read_on(rule: dict) -> None:
    assert rule["labels"]["severity"] in ("critical", "warning", "info")
    said = rule["annotations"]
    assert said["summary"] and said["description"].endswith(".")
    page, _, anchor = said["runbook"].partition("#")
    headings = re.findall(r"^#+ (.+)$", (FOLDER.parents[1] / page).read_text(), re.MULTILINE)
    assert anchor in {heading.lower().replace(" ", "-") for heading in headings}


def test_every_alert_is_seen_quiet_and_firing() -> None:
    scenarios = yaml.safe_load((FOLDER / "rules.test.yml").read_text())["tests"]
    healthy, *troubled = scenarios
    quiet = {test["alertname"] for test in healthy["alert_rule_test"] if not test.get("exp_alerts")}
    names = {rule["alert"] for rule in RULES}
    assert quiet == names
    fired = {
        name
        for scenario in troubled
        for test in scenario.get("promql_expr_test", [])
        for sample in [test["expr"], *(sample["labels"] for sample in test["exp_samples"])]
        for name in re.findall(r'alertname="(\w+)"', sample)
    }
    assert fired == names
