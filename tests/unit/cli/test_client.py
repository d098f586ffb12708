"""The client against a real HTTP server that misbehaves as networks and busy services do."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from l3ps_cli.client import Client, ServiceProblemError, ServiceUnreachableError


@pytest.fixture
def server():
    """A server that answers each request with the next step of its script: (status, headers, body, declared length)."""

    class Handler(BaseHTTPRequestHandler):
        def answer(self):
            taken = self.rfile.read(int(self.headers.get("content-length", 0)))
            seen.append((self.command, self.path, taken, self.headers.get("authorization")))
            status, headers, body, declared = script.pop(0)
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("content-length", str(len(body) if declared is None else declared))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_PUT = do_POST = do_DELETE = answer  # noqa: N815

        def log_message(self, *_):
            pass

    script, seen = [], []
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever, args=(0.02,))
        thread.start()
        http.script, http.seen = script, seen
        http.url = f"http://127.0.0.1:{http.server_port}"
        yield http
        http.shutdown()
        thread.join()


@pytest.fixture
def client(server):
    with Client(server.url, "s3cret") as client:
        yield client


def answer(document, status=200, **headers):
    return status, headers, json.dumps(document).encode(), None


def test_a_busy_service_is_asked_again(server, client):
    server.script += [answer({}, 503, **{"Retry-After": "0"}), answer({"items": []})]
    assert client.get("/jobs") == {"items": []}
    assert server.seen[0][3] == "Bearer s3cret"


def test_a_service_that_stays_busy_is_unreachable_with_its_own_words(server, client):
    server.script += [answer({"detail": "The queue does not answer."}, 503, **{"Retry-After": "0"})] * 4
    with pytest.raises(ServiceUnreachableError, match="The queue does not answer"):
        client.get("/jobs")


def test_a_refusal_is_not_repeated(server, client):
    server.script += [answer({"detail": "No.", "errors": [{"where": "size", "what": "wrong", "remedy": "Mend."}]}, 422)]
    with pytest.raises(ServiceProblemError, match=r"No\.\n  size: wrong\. Mend\."):
        client.post("/jobs")


def test_an_answer_that_is_no_problem_document_still_makes_a_sentence(server, client):
    server.script += [(404, {}, b"<html>nginx</html>", None)]
    with pytest.raises(ServiceProblemError, match="404 Not Found"):
        client.get("/jobs")


def test_a_post_that_may_have_been_carried_out_is_not_sent_twice(server, client):
    server.script += [(200, {}, b'{"half', 100)]
    with pytest.raises(ServiceUnreachableError):
        client.post("/jobs")
    assert len(server.seen) == 1


def test_an_upload_goes_up_in_parts_without_the_token_and_starts_a_failed_part_over(server, client, tmp_path):
    (tmp_path / "log.tar").write_bytes(b"0123456789")
    parts = [{"number": number, "url": f"/part/{number}?signed"} for number in (1, 2, 3)]
    server.script += [answer({"id": "upl_1", "part_size": 4, "parts": parts})]
    server.script += [answer({}, 503, **{"Retry-After": "0"})]
    server.script += [answer({}, ETag='"tag"')] * 3
    server.script += [answer({"id": "drv_1"})]
    sent = []
    assert client.upload(tmp_path / "log.tar", "drive", "0" * 64, "log", sent.append) == {"id": "drv_1"}

    puts = [request for request in server.seen if request[0] == "PUT"]
    assert {(path, body) for _, path, body, _ in puts} == {
        ("/part/1?signed", b"0123"),
        ("/part/2?signed", b"4567"),
        ("/part/3?signed", b"89"),
    }
    assert all(token is None for *_, token in puts)
    assert sum(sent) == 10, "the bar counts a part that started over once"
    completion = json.loads(server.seen[-1][2])
    assert completion["parts"] == [{"number": number, "etag": "tag"} for number in (1, 2, 3)]


def test_an_upload_that_fails_is_given_up_at_the_service(server, client, tmp_path):
    (tmp_path / "log.tar").write_bytes(b"0123")
    opened = {"id": "upl_1", "part_size": 4, "parts": [{"number": 1, "url": "/part/1"}]}
    server.script += [answer(opened), answer({"detail": "Expired."}, 403), (204, {}, b"", None)]
    with pytest.raises(ServiceProblemError, match="Expired"):
        client.upload(tmp_path / "log.tar", "drive", "0" * 64, "log")
    assert server.seen[-1][:2] == ("DELETE", "/v1/uploads/upl_1")


def test_a_download_that_breaks_off_is_fetched_again_and_appears_whole(server, client, tmp_path):
    server.script += [(200, {}, b"01234", 10), (200, {}, b"0123456789", None)]
    received = []
    client.fetch("/file", tmp_path / "file", received.append)
    assert (tmp_path / "file").read_bytes() == b"0123456789"
    assert sum(received) == 10
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_download_that_never_arrives_leaves_nothing(server, client, tmp_path):
    server.script += [(200, {}, b"01234", 10)] * 4
    with pytest.raises(ServiceUnreachableError):
        client.fetch("/file", tmp_path / "file")
    assert list(tmp_path.iterdir()) == []
