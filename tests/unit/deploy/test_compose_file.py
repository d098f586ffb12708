"""What can be said about docker-compose.yml without an engine; `make compose-check` says the rest."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[3]
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES = COMPOSE["services"]
DATABASES = {"postgres", "redis"}


@pytest.mark.parametrize("name", SERVICES)
def test_every_container_is_kept_from_doing_harm(name):
    """Read-only root, no capabilities, no way to gain any, bounded processes and logs."""
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "cap_add" not in service
    assert "privileged" not in service
    assert service["pids_limit"] <= 512
    assert service["logging"]["options"]["max-size"]


@pytest.mark.parametrize("name", SERVICES)
def test_images_of_others_are_pinned_and_run_as_a_plain_user(name):
    service = SERVICES[name]
    if service.get("pull_policy") == "never":
        assert service["image"].startswith("l3ps/")
        return
    assert re.search(r":v?\d+\.\d+", service["image"]), "pin the patch version"
    assert int(service["user"].split(":")[0]) > 0


@pytest.mark.parametrize("dockerfile", ["deploy/Dockerfile", "deploy/minio/Dockerfile"])
def test_images_built_here_run_as_a_plain_user(dockerfile):
    """The last USER that a shipped stage sees is a number other than root's."""
    users = re.findall(r"^USER (\d+):\d+$", (ROOT / dockerfile).read_text(), re.MULTILINE)
    assert users
    assert all(int(user) > 0 for user in users)


def test_dockerfiles_need_no_registry_beyond_their_base():
    """A `# syntax=` line would pull a frontend, and a base beyond the known ones could not be made offline."""
    for path in [ROOT / "deploy" / "Dockerfile", ROOT / "deploy" / "minio" / "Dockerfile"]:
        text = path.read_text()
        assert "# syntax" not in text
        stages = set(re.findall(r"^FROM \S+ AS (\S+)$", text, re.MULTILINE))
        assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) - stages == {"python:3.11-slim-bookworm"}


def test_ports_are_published_on_loopback_only():
    for name, service in SERVICES.items():
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), name


def test_databases_and_workers_have_no_way_out():
    assert COMPOSE["networks"]["backend"]["internal"] is True
    for name in [*DATABASES, "worker-segment", "worker-refine", "worker-train", "migrate", "bucket"]:
        assert SERVICES[name]["networks"] == ["backend"], name


def test_the_services_start_after_what_they_need():
    for name in ("api", "worker-segment", "worker-refine", "worker-train"):
        needs = {needed: how["condition"] for needed, how in SERVICES[name]["depends_on"].items()}
        assert needs["migrate"] == needs["bucket"] == "service_completed_successfully"
        for needed in ("redis", "postgres", "minio"):
            assert needs[needed] == "service_healthy"
            assert "healthcheck" in SERVICES[needed]


def test_redis_keeps_every_task():
    config = "\n".join(SERVICES["redis"]["command"])
    assert "appendonly yes" in config
    assert "maxmemory-policy noeviction" in config


def test_a_worker_listens_to_each_queue():
    queues = [
        SERVICES[name]["command"][SERVICES[name]["command"].index("-Q") + 1] for name in SERVICES if "worker" in name
    ]
    assert sorted(queues) == ["refine", "segment", "train"]


def test_torch_comes_only_to_those_who_ask_for_it():
    """One profile brings the image with the trainer, one a dashboard; what everybody starts has no profile."""
    assert {name: service["profiles"] for name, service in SERVICES.items() if "profiles" in service} == {
        "worker-train": ["train"],
        "grafana": ["grafana"],
    }
    assert SERVICES["worker-train"]["build"]["target"] == "worker-train"
    assert SERVICES["api"]["environment"]["L3PS_TRAINING"] == "${L3PS_TRAINING:-0}"
    assert any(volume.endswith(":/opt/backbones:ro") for volume in SERVICES["worker-train"]["volumes"])
    assert SERVICES["worker-train"]["environment"]["L3PS_BACKBONES_DIR"] == "/opt/backbones"


def test_every_secret_is_demanded_and_no_other():
    """What .env.example leaves empty is what compose refuses to start without; the rest has defaults."""
    demanded = set(re.findall(r"\$\{(\w+):\?", (ROOT / "docker-compose.yml").read_text()))
    assert demanded == set(_settings(ROOT / ".env.example"))


def test_new_env_fills_in_every_secret_for_the_owner_alone(tmp_path):
    target = tmp_path / ".env"
    subprocess.run(["sh", ROOT / "deploy" / "new-env.sh", target], check=True, capture_output=True)
    secrets = _settings(target)
    assert set(secrets) == set(_settings(ROOT / ".env.example"))
    assert all(re.fullmatch(r"[0-9a-f]{40}", value) for value in secrets.values())
    assert len(set(secrets.values())) == len(secrets)
    assert target.stat().st_mode & 0o077 == 0


def test_new_env_never_overwrites(tmp_path):
    """New secrets would lock the owner out of the volumes."""
    target = tmp_path / ".env"
    target.write_text("L3PS_TOKEN=mine\n")
    done = subprocess.run(["sh", ROOT / "deploy" / "new-env.sh", target], check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert str(target) in done.stderr
    assert target.read_text() == "L3PS_TOKEN=mine\n"


def _settings(path):
    """NAME=value lines that are not commented out."""
    return dict(line.split("=", 1) for line in path.read_text().splitlines() if line[:1].isalpha())
