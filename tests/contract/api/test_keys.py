"""API keys: what each scope permits, how a key begins and ends, and that its secret stays one."""

import secrets
from datetime import UTC, datetime, timedelta

import httpx
import pytest

from l3ps_api.keyring import Keyring, digest, new_secret
from l3ps_platform.catalog import DEFAULT_PROJECT, Catalog, keys
from l3ps_platform.errors import Conflict
from l3ps_platform.ids import new_id

UPLOAD = {"kind": "drive", "filename": "log.tar", "size": 9}


def made(service, scope="read", **more) -> dict:
    answer = service.http.post("/v1/keys", json={"name": f"a {scope} key", "scope": scope, **more})
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == f"/v1/keys/{answer.json()['id']}"
    return answer.json()


def ask(service, secret: str, path="/v1/me", method="GET", **request) -> httpx.Response:
    headers = {"Authorization": f"Bearer {secret}"} | request.pop("headers", {})
    return httpx.request(method, f"{service.url}{path}", headers=headers, **request)


def test_a_key_says_who_it_is(service):
    key = made(service)
    assert ask(service, key["secret"]).json() == {
        "project": {"id": DEFAULT_PROJECT, "name": "default"},
        "scope": "read",
        "key": {"id": key["id"], "name": "a read key"},
    }
    shown = service.http.get(f"/v1/keys/{key['id']}").json()
    assert "secret" not in shown and shown["last_used_at"] is not None
    assert key["id"] in {item["id"] for item in service.http.get("/v1/keys").json()["items"]}


@pytest.mark.parametrize(
    ("scope", "permitted"),
    [("read", {"GET /v1/drives"}), ("write", {"GET /v1/drives", "POST /v1/uploads"}), ("admin", None)],
)
def test_a_scope_permits_what_it_says_and_the_refusal_names_the_one_needed(service, scope, permitted):
    secret = made(service, scope)["secret"]
    needed = {"GET /v1/drives": "read", "POST /v1/uploads": "write", "GET /v1/keys": "admin"}
    for request, wanted in needed.items():
        method, path = request.split()
        answer = ask(service, secret, path, method, json=UPLOAD if method == "POST" else None)
        if permitted is None or request in permitted:
            assert answer.is_success, answer.text
        else:
            document = service.refused(answer, 403, "forbidden")
            assert f"scope {wanted}" in document["detail"]
            assert f'scope="{wanted}"' in answer.headers["www-authenticate"]
    service.refused(ask(service, secret, "/v1/projects"), 403, "forbidden")


def test_projects_are_the_operators_even_where_a_key_may_everything_else(service):
    secret = made(service, "admin")["secret"]
    document = service.refused(ask(service, secret, "/v1/projects", "POST", json={"name": "mine"}), 403, "forbidden")
    assert "operator" in document["detail"]


def test_a_rotated_key_takes_both_secrets_for_a_while_if_asked_to(service):
    key = made(service)
    path = f"/v1/keys/{key['id']}/rotate"
    rotated = service.http.post(path, json={"overlap_seconds": 3600}).json()
    assert ask(service, key["secret"]).is_success and ask(service, rotated["secret"]).is_success
    last = service.http.post(path).json()
    assert ask(service, last["secret"]).is_success
    for old in (key["secret"], rotated["secret"]):
        service.refused(ask(service, old), 401, "unauthorized")


def test_a_revoked_key_ends_at_once_and_stays_in_the_list(service):
    key = made(service)
    assert ask(service, key["secret"]).is_success
    assert service.http.delete(f"/v1/keys/{key['id']}").status_code == 204
    service.refused(ask(service, key["secret"]), 401, "unauthorized")
    assert service.http.get(f"/v1/keys/{key['id']}").json()["revoked_at"] is not None
    service.refused(service.http.post(f"/v1/keys/{key['id']}/rotate"), 409, "conflict")


def test_nobody_learns_why_credentials_are_not_valid(service):
    ended = new_id("key")
    secret = new_secret(ended)
    past = datetime.now(UTC) - timedelta(seconds=1)
    with service.catalog.transaction() as tx:
        keys.add(tx, id=ended, name="x", scope="admin", secret_sha256=digest(secret), expires_at=past)
    revoked = made(service)
    service.http.delete(f"/v1/keys/{revoked['id']}")
    wrong = [
        secret,
        revoked["secret"],
        new_secret(made(service)["id"]),
        new_secret(new_id("key")),
        "x",
        service.token[:-1],
    ]
    answers = [service.refused(ask(service, given), 401, "unauthorized") for given in wrong]
    assert answers == [answers[0]] * len(answers)


def test_a_key_can_be_given_an_end_but_not_in_the_past(service):
    soon = (datetime.now(UTC) + timedelta(hours=1)).isoformat()
    assert ask(service, made(service, expires_at=soon)["secret"]).is_success
    body = {"name": "x", "scope": "read", "expires_at": "2001-01-01T00:00:00Z"}
    answer = service.http.post("/v1/keys", json=body)
    assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "expires_at"


@pytest.mark.parametrize("date", ["9999-12-31T23:59:59-23:59", "0001-01-01T00:00:00+14:00", "9000-01-01T00:00:01Z"])
def test_a_date_at_the_edge_of_the_calendar_is_refused(service, date):
    """In another zone it would be outside."""
    answers = [service.http.post("/v1/keys", json={"name": "x", "scope": "read", "expires_at": date})]
    answers += [service.http.post("/v1/webhooks/whk_none/replay", json={"since": date})]
    for answer, field in zip(answers, ("expires_at", "since"), strict=True):
        error = service.refused(answer, 422, "invalid-request")["errors"][0]
        assert error["where"] == field and "1970 and 9000" in error["what"]


def test_secrets_in_the_query_open_nothing(service):
    secret = made(service)["secret"]
    for name in ("token", "access_token", "key"):
        assert httpx.get(f"{service.url}/v1/drives", params={name: secret}).status_code == 401
        refused = service.refused(ask(service, secret, "/v1/drives", params={name: secret}), 422, "invalid-request")
        assert refused["errors"][0]["where"] == f"query {name}"


def test_no_secret_is_in_the_log_wherever_it_was_sent(service):
    key = made(service, "admin")
    rotated = service.http.post(f"/v1/keys/{key['id']}/rotate", json={"overlap_seconds": 60}).json()
    for secret in (key["secret"], rotated["secret"]):
        ask(service, secret, "/v1/uploads", "POST", json=UPLOAD)
        ask(service, secret, f"/v1/keys/{secret}", "DELETE")
        ask(service, secret, f"/v1/{secret}")
        ask(service, secret, "/v1/uploads", "POST", json=UPLOAD | {"sha256": secret})
        ask(service, secret, "/v1/uploads", "POST", json=UPLOAD, headers={"Idempotency-Key": secret})
        httpx.request("DELETE", f"{service.url}/v1/drives/{secret}", params={"token": secret})
    log = (service.settings.data_dir / "logs" / "api.log").read_text()
    assert key["id"] in log, "who asked is in it"
    for secret in (key["secret"], rotated["secret"], service.token):
        assert secret not in log
        assert secret[-43:] not in log


def test_the_catalog_holds_digests_alone(service):
    key = made(service)
    with service.catalog.reading() as session:
        row = keys.get(session, key["id"])
        assert row.secret_sha256 == digest(key["secret"])
        assert key["secret"] not in {getattr(row, column.key) for column in row.__table__.columns}


def test_the_operator_acts_in_the_project_named_and_a_key_in_its_own(service):
    project = service.http.post("/v1/projects", json={"name": secrets.token_hex(8)}).json()
    there = {"L3PS-Project": project["id"]}
    assert service.http.get("/v1/me", headers=there).json()["project"] == {"id": project["id"], "name": project["name"]}
    key = service.http.post("/v1/keys", json={"name": "theirs", "scope": "write"}, headers=there).json()
    assert ask(service, key["secret"]).json()["project"]["id"] == project["id"]
    assert key["id"] not in service.http.get("/v1/keys").text
    service.refused(ask(service, key["secret"], headers={"L3PS-Project": DEFAULT_PROJECT}), 403, "forbidden")
    unknown = service.http.get("/v1/me", headers={"L3PS-Project": new_id("prj")})
    assert service.refused(unknown, 422, "invalid-request")["errors"][0]["where"] == "L3PS-Project"


def test_a_project_is_deleted_when_it_is_empty_and_its_keys_end(service):
    name = secrets.token_hex(8)
    project = service.http.post("/v1/projects", json={"name": name}).json()["id"]
    service.refused(service.http.post("/v1/projects", json={"name": name}), 409, "conflict")
    there = {"L3PS-Project": project}
    secret = service.http.post("/v1/keys", json={"name": "x", "scope": "write"}, headers=there).json()["secret"]
    upload = ask(service, secret, "/v1/uploads", "POST", json=UPLOAD).json()["id"]
    document = service.refused(service.http.delete(f"/v1/projects/{project}"), 409, "conflict")
    assert "1 open uploads" in document["detail"]
    assert ask(service, secret, f"/v1/uploads/{upload}", "DELETE").status_code == 204
    assert service.http.delete(f"/v1/projects/{project}").status_code == 204
    service.refused(ask(service, secret), 401, "unauthorized")
    service.refused(service.http.get(f"/v1/projects/{project}"), 404, "unknown-project")
    service.refused(service.http.get("/v1/me", headers=there), 422, "invalid-request")
    assert service.http.post("/v1/projects", json={"name": name}).status_code == 201, "the name is free again"
    service.refused(service.http.delete(f"/v1/projects/{DEFAULT_PROJECT}"), 409, "conflict")


def test_a_key_revoked_elsewhere_makes_no_successor(service, replica):
    key = made(service, "admin")
    replica.headers["Authorization"] = f"Bearer {key['secret']}"
    assert replica.get("/v1/me").is_success
    assert service.http.delete(f"/v1/keys/{key['id']}").status_code == 204
    assert replica.get("/v1/me").is_success, "what it reads it may for a moment"
    body = {"name": "successor", "scope": "admin"}
    service.refused(replica.post("/v1/keys", json=body), 401, "unauthorized")
    other = made(service)["id"]
    service.refused(replica.post(f"/v1/keys/{other}/rotate"), 401, "unauthorized")


def test_a_key_that_ends_while_it_makes_another_makes_none(service):
    with service.catalog.transaction() as tx:
        ended = keys.add(tx, id=new_id("key"), name="x", scope="admin", secret_sha256="0" * 64, expires_at=None).id
        keys.hold_maker(tx, ended)
        keys.revoke(tx, ended)
    with service.catalog.transaction() as tx, pytest.raises(Conflict, match="ended meanwhile"):
        keys.hold_maker(tx, ended)


def test_no_key_of_a_deleted_project_opens_anything(service, replica):
    project = service.http.post("/v1/projects", json={"name": secrets.token_hex(8)}).json()["id"]
    there = {"L3PS-Project": project}
    key = service.http.post("/v1/keys", json={"name": "x", "scope": "admin"}, headers=there).json()
    replica.headers["Authorization"] = f"Bearer {key['secret']}"
    assert replica.get("/v1/me").is_success
    assert service.http.delete(f"/v1/projects/{project}").status_code == 204
    body = {"name": "successor", "scope": "admin"}
    service.refused(replica.post("/v1/keys", json=body), 401, "unauthorized")
    scoped = service.catalog.whole().scoped(project)
    with scoped.transaction() as tx, pytest.raises(Conflict, match="ended meanwhile"):
        keys.hold_maker(tx, None)
    with scoped.transaction() as tx:
        late = new_secret(new_id("key"))
        id = late[len("l3ps_") :][:29]
        keys.add(tx, id=id, name="late", scope="admin", secret_sha256=digest(late), expires_at=None)
    service.refused(ask(service, late), 401, "unauthorized")


def test_what_was_read_before_a_revocation_is_not_remembered_after_it(service):
    key = made(service)

    class Slow(Keyring):
        def _verified(self, secret, project):
            found = super()._verified(secret, project)
            self.forget(key["id"])  # the revocation comes between reading and remembering
            return found

    keyring = Slow(service.settings, service.catalog.whole())
    assert keyring.verify(key["secret"].encode(), "").key_id == key["id"]
    assert keyring.recall(key["secret"].encode(), "") is None


def test_use_is_noted_at_most_once_a_minute(service):
    key = made(service)
    catalog = Catalog(service.catalog.url).scoped(DEFAULT_PROJECT)
    recently = datetime.now(UTC) - timedelta(seconds=50)
    with catalog.transaction() as tx:
        keys.get(tx.session, key["id"]).last_used_at = recently
    ask(service, key["secret"])
    with catalog.transaction() as tx:
        row = keys.get(tx.session, key["id"])
        assert row.last_used_at == recently
        row.last_used_at = recently - timedelta(seconds=20)
    service.http.post(f"/v1/keys/{key['id']}/rotate", json={"overlap_seconds": 60})  # it is no longer remembered
    ask(service, key["secret"])
    with catalog.reading() as session:
        assert keys.get(session, key["id"]).last_used_at > recently
    catalog.dispose()
