"""Settings: one URL a place, and a clear word about a wrong one."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from l3ps_platform.objects import DirectoryStore, open_store
from l3ps_platform.settings import S3Location, Settings


def test_everything_lies_in_the_data_directory_by_default(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert settings.catalog_url == f"sqlite:///{tmp_path}/catalog.db"
    assert settings.scratch == tmp_path / "scratch"
    store = open_store(settings)
    assert isinstance(store, DirectoryStore)
    assert store.root == tmp_path / "objects"
    assert settings.migrates_on_start


def test_a_data_directory_with_odd_letters(tmp_path: Path) -> None:
    """The directory goes through a URL and back."""
    store = open_store(Settings(data_dir=tmp_path / "Fahrten & Länge 100%"))
    assert isinstance(store, DirectoryStore)
    assert store.root == tmp_path / "Fahrten & Länge 100%" / "objects"


@pytest.mark.parametrize("scheme", ["postgresql://", "postgres://", "postgresql+psycopg://"])
def test_postgresql_by_any_of_its_names(scheme: str) -> None:
    settings = Settings(database_url=f"{scheme}u:p@host/db")
    assert settings.catalog_url == "postgresql+psycopg://u:p@host/db"
    assert not settings.migrates_on_start


def test_s3_location() -> None:
    location = S3Location.parse("s3://key:se%2Fcret@minio:9000/bucket?secure=0")
    assert (location.endpoint, location.bucket, location.secure) == ("minio:9000", "bucket", False)
    assert (location.access_key, location.secret_key.get_secret_value()) == ("key", "se/cret")
    assert S3Location.parse("s3://k:s@s3.amazonaws.com/b").secure


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("database_url", "mysql://x", "sqlite:///PATH or postgresql://"),
        ("objects_url", "/tmp/x", "file:///DIR or s3://"),
        ("objects_url", "s3://host/bucket", "no credentials"),
        ("objects_url", "s3://k:s@host", "s3://KEY:SECRET@host:port/bucket"),
        ("objects_url", "s3://k:s@host/bucket/deeper", "s3://KEY:SECRET@host:port/bucket"),
        ("trusted_proxies", "*", "addresses or networks"),
        ("trusted_proxies", "10.0.0.7,proxy.example", "addresses or networks"),
        ("trusted_proxies", "172.18.0.1/16", "addresses or networks"),
    ],
)
def test_wrong_places_are_refused_with_the_right_form(name: str, value: str, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Settings(**{name: value})


def test_secrets_are_not_in_the_repr() -> None:
    settings = Settings(token="hunter2", objects_url="s3://key:hunter3@h/b")
    assert "hunter2" not in repr(settings)
    assert "hunter3" not in repr(S3Location.parse(settings.objects_url))


def test_the_environment_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("L3PS_PORT", "9999")
    assert Settings().api_url == "http://127.0.0.1:9999"
    monkeypatch.setenv("L3PS_PUBLIC_URL", "https://labels.example/")
    assert Settings().api_url == "https://labels.example"


def test_redis_by_socket() -> None:
    assert Settings(redis_url="unix:///run/redis.sock").broker_url == "redis+socket:///run/redis.sock"
