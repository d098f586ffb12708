"""What may be read from where: by whole path segments, for the projects that may, and without telling a secret."""

import pytest

from l3ps_platform.objects import Reference, find_source, parse_sources
from l3ps_platform.settings import Settings

URL = "s3://key:s3cr%2Fet@minio:9000/fleet/logs/2026?secure=0"


def test_a_list_may_be_json_or_separated_by_commas():
    other = "s3://k:s@s3.example.com/archive?project=prj_7"
    for text in (f"{URL},{other}", f'["{URL}", "{other}"]', f" {URL} , {other} ,"):
        first, second = parse_sources(text)
        assert (first.location.bucket, first.path, first.project_id) == ("fleet", "logs/2026", None)
        assert (first.location.secret_key.get_secret_value(), first.location.secure) == ("s3cr/et", False)
        assert (second.location.bucket, second.path, second.project_id) == ("archive", "", "prj_7")
    assert parse_sources("") == ()


@pytest.mark.parametrize("text", ["s3://key:topsecret@host", "[1]", "[", "s3://bucket/topsecret", "topsecret"])
def test_settings_that_cannot_be_read_are_said_without_their_secrets(text):
    with pytest.raises(ValueError, match="source") as caught:
        parse_sources(text)
    assert "topsecret" not in str(caught.value) and caught.value.__cause__ is None


@pytest.mark.parametrize(
    ("place", "allowed"),
    [
        ("s3://fleet/logs/2026", True),
        ("s3://fleet/logs/2026/", True),
        ("s3://fleet/logs/2026/11/22", True),
        ("s3://fleet/logs/2026-private", False),
        ("s3://fleet/logs/20", False),
        ("s3://fleet/logs", False),
        ("s3://fleet", False),
        ("s3://fleet2/logs/2026/11", False),
    ],
)
def test_a_source_covers_what_lies_below_its_prefix_by_whole_segments(place, allowed):
    found = find_source(Settings(sources=URL), Reference.parse(place), "prj_default")
    assert (found is not None) is allowed


def test_what_is_one_projects_alone_is_no_others_through_a_wider_source():
    settings = Settings(sources=f"{URL}&project=prj_1,s3://other:k@minio/fleet")

    def key(place: str, project: str) -> str | None:
        found = find_source(settings, Reference.parse(f"s3://{place}"), project)
        return found and found.location.access_key

    assert (key("fleet/logs/2026/a", "prj_1"), key("fleet/logs/2026/a", "prj_2")) == ("key", None)
    assert (key("fleet/other", "prj_1"), key("fleet/other", "prj_2")) == ("other", "other")
    assert (key("fleet", "prj_1"), key("fleet", "prj_2")) == ("other", None), "a place that contains it"


def test_a_source_may_be_several_projects():
    settings = Settings(sources=f"{URL}&project=prj_1,{URL}&project=prj_2")
    place = Reference.parse("s3://fleet/logs/2026/a")
    found = [find_source(settings, place, f"prj_{n}") for n in (1, 2, 3)]
    assert [source and source.project_id for source in found] == ["prj_1", "prj_2", None]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "fleet/logs",
        "http://fleet/logs",
        "s3://",
        "s3://Fleet/logs",
        "s3://key:secret@fleet/logs",
        "s3://fleet/logs/../../other",
        "s3://fleet/./logs",
        "s3://fleet//logs",
        "s3://fleet/lo\ngs",
        "s3://fleet/" + "x" * 2000,
    ],
)
def test_what_is_no_place(text):
    with pytest.raises(ValueError, match=r"it|its|is no name"):
        Reference.parse(text)


def test_settings_that_are_wrong_are_not_repeated(monkeypatch):
    monkeypatch.setenv("L3PS_OBJECTS_URL", "ftp://topsecret")
    with pytest.raises(ValueError, match="object store") as caught:
        Settings()
    assert "topsecret" not in str(caught.value)
