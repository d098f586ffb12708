"""One request at a time: what is repeated, what an error answer becomes, where the service is looked for."""

import json
import os
import socket

import pytest

import l3ps_client
from l3ps_client import Client, Retry, Unreachable, sentences

AGAIN = {"Retry-After": "0"}


def answer(document, status=200, **headers):
    return status, headers, json.dumps(document).encode(), None


def test_a_busy_service_is_asked_again(server, client):
    server.script += [(503, AGAIN, b"{}", None), answer({"items": []})]
    assert client.jobs.page() == {"items": []}
    assert server.seen[0][3]["authorization"] == "Bearer s3cret"


def test_a_service_that_stays_busy_is_unreachable_with_its_own_words(server, client):
    server.script += [(503, AGAIN, b'{"detail": "The queue does not answer."}', None)] * 4
    with pytest.raises(Unreachable, match="The queue does not answer"):
        client.jobs.page()


def test_a_proxy_that_finds_nobody_is_asked_again(server, client):
    server.script += [(502, {}, b"<html>", None), (504, {}, b"", None), answer({"items": []})]
    assert list(client.jobs.list()) == []


def test_who_asks_too_often_learns_when_to_come_back_and_is_not_kept_waiting_for_minutes(server, client):
    server.script += [answer({"detail": "Too many requests."}, 429, **{"Retry-After": "120"})]
    with pytest.raises(l3ps_client.TooManyRequests) as caught:
        client.jobs.page()
    assert caught.value.retry_after == 120
    assert len(server.seen) == 1


def test_a_time_to_come_back_may_be_a_date(server, client):
    server.script += [answer({}, 429, **{"Retry-After": "Wed, 21 Oct 2015 07:28:00 GMT"}), answer({"items": []})]
    assert client.jobs.page() == {"items": []}


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (400, "InvalidRequest"),
        (401, "Unauthorized"),
        (403, "Forbidden"),
        (404, "NotFound"),
        (409, "Conflict"),
        (412, "Conflict"),
        (422, "InvalidRequest"),
        (500, "Refused"),
    ],
)
def test_a_refusal_is_not_repeated_and_says_what_kind_it_is(server, client, status, kind):
    errors = [{"where": "size", "what": "wrong", "remedy": "Mend."}]
    server.script += [answer({"type": "urn:l3ps:problem:no-such", "detail": "No.", "errors": errors}, status)]
    with pytest.raises(l3ps_client.Refused, match=r"No\.\n  size: wrong\. Mend\.") as caught:
        client.jobs.create(model="m", drive_id="d")
    assert type(caught.value).__name__ == kind
    assert (caught.value.status, caught.value.code) == (status, "no-such")
    assert len(server.seen) == 1


def test_an_answer_that_is_no_problem_document_still_makes_a_sentence(server, client):
    server.script += [(404, {}, b"<html>nginx</html>", None)]
    with pytest.raises(l3ps_client.NotFound, match="404 Not Found"):
        client.jobs.get("job_1")


def test_a_page_that_is_not_the_services_is_said_to_be(server, client):
    server.script += [(200, {"Content-Type": "text/html"}, b"<html>Log in to the hotel</html>", None)]
    with pytest.raises(Unreachable, match="L3PS_URL"):
        client.jobs.get("job_1")


def test_a_post_whose_answer_was_lost_is_sent_again_with_the_same_key(server, client):
    server.script += [(202, {}, b'{"half', 100), answer({"id": "job_1"}, 202), answer({"id": "job_2"}, 202)]
    assert client.jobs.create(model="m", drive_id="d")["id"] == "job_1"
    client.jobs.create(model="m", drive_id="d")
    first, again, other = [headers["idempotency-key"] for _, _, _, headers in server.seen]
    assert first == again != other


def test_a_post_that_is_still_being_carried_out_is_waited_for(server, client):
    server.script += [answer({"detail": "In progress."}, 409, **AGAIN), answer({"id": "job_1"}, 202)]
    assert client.jobs.create(model="m", drive_id="d")["id"] == "job_1"


def test_an_id_is_one_step_of_a_path_whatever_it_holds(server, client):
    server.script += [answer({})]
    client.models.get("../jobs?x=1#é")
    assert server.seen[0][1] == "/v1/models/..%2Fjobs%3Fx%3D1%23%C3%A9"


def test_lists_go_over_all_pages_and_no_further_than_asked(server, client):
    server.script += [answer({"items": [{"id": "1"}, {"id": "2"}], "next": "c"}), answer({"items": [{"id": "3"}]})]
    assert [job["id"] for job in client.jobs.list(state="failed")] == ["1", "2", "3"]
    assert server.seen[0][1] == "/v1/jobs?limit=200&state=failed"
    assert "cursor=c" in server.seen[1][1]
    server.script += [answer({"items": [{"id": "1"}], "next": "c"})]
    assert len(list(client.jobs.list(limit=1))) == 1


def test_what_a_newer_service_adds_stays_in_the_document(server, client):
    server.script += [answer({"id": "job_1", "mood": "sunny"})]
    assert client.jobs.get("job_1")["mood"] == "sunny"


def test_nobody_there_is_said_with_the_address(tmp_path):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        with Client(url, retry=Retry(first=0.0)) as client, pytest.raises(Unreachable, match=url):
            client.me()


def test_a_problem_document_becomes_sentences():
    document = {
        "title": "The log cannot be used",
        "detail": "The log has three problems, the first: calib.txt: the file is missing. Add it.",
        "errors": [
            {"where": "calib.txt", "what": "the file is missing", "remedy": "Add it."},
            {"where": "velodyne/0.bin", "what": "3 bytes are no point.", "remedy": ""},
            {"where": "times.txt", "what": "the times go back", "remedy": "Sort them"},
        ],
    }
    assert str(l3ps_client.Refused(422, document)).splitlines() == [
        "The log has three problems, the first: calib.txt: the file is missing. Add it.",
        "  velodyne/0.bin: 3 bytes are no point.",
        "  times.txt: the times go back. Sort them.",
    ]
    assert sentences({}) == ["The service refused the request."]


@pytest.fixture
def local(monkeypatch, tmp_path):
    """A data directory in which a stack says it runs, as process ``pid``."""
    for name in ("L3PS_URL", "L3PS_TOKEN", "L3PS_PROJECT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("L3PS_DATA_DIR", str(tmp_path))

    def up(url, pid):
        (tmp_path / "up.json").write_text(json.dumps({"url": url, "token": "local-token", "pid": pid}))

    return up


def test_a_stack_on_this_machine_is_found_with_its_token(server, local):
    local(server.url, os.getpid())
    server.script += [answer({})] * 2
    with Client(retry=Retry(first=0.0)) as client:
        assert client.url == server.url
        client.me()
    with Client(server.url + "/") as client:
        client.me()
    assert [headers["authorization"] for *_, headers in server.seen] == ["Bearer local-token"] * 2


def test_the_local_stacks_token_goes_nowhere_else(server, local, monkeypatch):
    local("http://127.0.0.1:1", os.getpid())
    server.script += [answer({})] * 2
    with Client(server.url) as client:
        client.me()
    monkeypatch.setenv("L3PS_URL", server.url)
    with Client() as client:
        client.me()
    assert all("authorization" not in headers for *_, headers in server.seen)


def test_what_a_stack_that_was_killed_left_behind_is_not_believed(local):
    local("http://127.0.0.1:1", 2**22 + 1)  # beyond the largest process id
    with Client() as client:
        assert client.url == "http://127.0.0.1:8080"


def test_a_proxy_of_the_environment_is_not_asked_for_this_machine(server, monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:1")
    monkeypatch.setenv("NO_PROXY", "")
    server.script += [answer({"scope": "read"})]
    with Client(server.url, "t", retry=Retry(first=0.0)) as client:
        assert client.me() == {"scope": "read"}


def test_the_project_goes_with_every_request(server):
    server.script += [answer({})]
    with Client(server.url, "operator", project="prj_7") as client:
        client.me()
    assert server.seen[0][3]["l3ps-project"] == "prj_7"
