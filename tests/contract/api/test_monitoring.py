"""What Prometheus and Grafana are set up to ask is what the service tells, after a real job."""

import json
import re
import subprocess
import time
from pathlib import Path

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from l3ps_cli.stack import free_port

DEPLOY = Path(__file__).parents[3] / "deploy"
RULES = DEPLOY / "prometheus" / "rules.yml"
DASHBOARD = DEPLOY / "grafana" / "dashboards" / "l3ps.json"
NAMES = re.compile(r"\b(?:l3ps|process)_[a-z0-9_]+\b")
ONLY_EMBEDDED = {"l3ps_disk_free_bytes", "l3ps_disk_size_bytes"}


def rule_expressions() -> list[str]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return [rule["expr"] for group in groups for rule in group["rules"]]


def panel_expressions() -> list[str]:
    panels = json.loads(DASHBOARD.read_text())["panels"]
    return [target["expr"] for panel in panels for target in panel.get("targets", [])]


def told(service) -> dict[str, set[str]]:
    """The names of all samples, each with the names of its labels."""
    found: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(service.http.get("/metrics").text):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


@pytest.mark.parametrize("expressions", [rule_expressions, panel_expressions])
def test_every_figure_asked_for_is_told_with_the_labels_asked_for(service, observed, expressions):
    known = told(service)
    embedded = service.settings.store_url.startswith("file:")
    for expression in expressions():
        for name in set(NAMES.findall(expression)) - (set() if embedded else ONLY_EMBEDDED):
            assert name in known, f"{name} of {expression}"
            for selector in re.findall(rf"\b{name}\{{([^}}]*)\}}", expression):
                labels = set(re.findall(r"(\w+) *(?:=~|!~|!=|=)", selector)) - {"job"}
                assert labels <= known[name], f"{name}{{{selector}}}"


@pytest.mark.once
def test_a_real_prometheus_scrapes_the_service_and_evaluates_it_all(service, observed, prometheus_tool, tmp_path):
    """Every rule without a fault, none of them firing after a job that went well; every panel's question answered."""
    config = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())
    config["global"] = {"scrape_interval": "500ms", "scrape_timeout": "500ms", "evaluation_interval": "500ms"}
    config["rule_files"] = [str(RULES)]
    config["scrape_configs"] = config["scrape_configs"][:1]
    config["scrape_configs"][0]["static_configs"][0]["targets"] = [service.url.removeprefix("http://")]
    (tmp_path / "metrics-token").touch()  # as compose has it where the service wants none
    (tmp_path / "prometheus.yml").write_text(yaml.safe_dump(config))
    url = f"http://127.0.0.1:{free_port()}"
    address = f"--web.listen-address={url.removeprefix('http://')}"
    options = [f"--config.file={tmp_path / 'prometheus.yml'}", f"--storage.tsdb.path={tmp_path / 'data'}", address]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen([prometheus_tool("prometheus"), *options], stdout=log, stderr=log)
    try:
        with httpx.Client(base_url=f"{url}/api/v1", timeout=10) as prometheus:
            rules = _evaluated(prometheus, process)
            faults = {rule["name"]: rule.get("lastError") for rule in rules if rule["health"] != "ok"}
            firing = [rule["name"] for rule in rules if rule["state"] == "firing"]
            assert (faults, len(rules)) == ({}, len(rule_expressions()))
            assert firing == []
            for expression in panel_expressions():
                asked = expression.replace("$__rate_interval", "1m").replace("$project", ".*").replace("$model", ".*")
                answer = prometheus.get("/query", params={"query": asked})
                assert answer.json()["status"] == "success", f"{asked}: {answer.text}"
    finally:
        process.terminate()
        process.wait(20)


def _evaluated(prometheus: httpx.Client, process: subprocess.Popen) -> list[dict]:
    """The rules once the service has been scraped and every rule been evaluated after that."""
    deadline = time.monotonic() + 60
    scraped = None
    while True:
        assert process.poll() is None and time.monotonic() < deadline
        try:
            targets = prometheus.get("/targets").json()["data"]["activeTargets"]
            rules = [rule for group in prometheus.get("/rules").json()["data"]["groups"] for rule in group["rules"]]
        except (httpx.TransportError, ValueError):
            time.sleep(0.1)
            continue
        if scraped is None and targets and targets[0]["health"] == "up":
            scraped = targets[0]["lastScrape"]
        if scraped and rules and all(rule["lastEvaluation"] > scraped for rule in rules):
            return rules
        time.sleep(0.1)
