"""A request with an Idempotency-Key: one does the work, its effect and its note are one commit."""

import threading

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, drives, projects, requests
from l3ps_platform.errors import Conflict

pytestmark = pytest.mark.services
FILE = {"filename": "f.zip", "size": 9, "object_key": "uploads/u/f.zip"}
LONG = {"lease_seconds": 60.0, "keep_seconds": 3600.0}
DEAD = {"lease_seconds": 0.0, "keep_seconds": 3600.0}
KINDS = frozenset({"drives", "jobs"})


def begin(catalog: Catalog, key: str = "k", fingerprint: str = "f", most: int = 100, **seconds: float):
    with catalog.transaction() as tx:
        return requests.begin(tx, key, fingerprint, **(seconds or LONG), most=most)


def bound(held: requests.Held):
    from dataclasses import replace

    return requests.bound(replace(held, kinds=KINDS))


def make(catalog: Catalog) -> str:
    with catalog.transaction() as tx:
        return workflow.accept_drive(tx, name="d", **FILE).id


def finish(catalog: Catalog, held: requests.Held, body: bytes = b"{}", **how) -> None:
    with catalog.transaction() as tx:
        requests.finish(tx, held, 201, {"location": "/x"}, body, **({"limit": 100} | how))


def test_of_many_at_once_one_does_the_work(catalog: Catalog) -> None:
    barrier, states = threading.Barrier(8), []

    def start() -> None:
        barrier.wait()
        states.append(begin(catalog))

    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(type(state).__name__ for state in states) == ["Busy"] * 7 + ["Held"]


def test_the_answer_is_kept_for_the_same_request_and_no_other(catalog: Catalog) -> None:
    held = begin(catalog)
    finish(catalog, held)
    kept = begin(catalog)
    assert isinstance(kept, requests.Kept)
    assert (kept.status, kept.headers, kept.body) == (201, {"location": "/x"}, b"{}")
    with pytest.raises(requests.OtherRequest):
        begin(catalog, fingerprint="another")
    assert isinstance(begin(catalog, key="another"), requests.Held)


def test_what_a_request_made_before_it_died_is_what_the_next_one_finds(catalog: Catalog) -> None:
    held = begin(catalog, **DEAD)
    with bound(held):
        drive = make(catalog)
    again = begin(catalog)
    assert isinstance(again, requests.Held)
    assert again.made == ("drives", drive)


def test_a_request_that_died_before_its_commit_leaves_the_work_to_the_next(catalog: Catalog) -> None:
    held = begin(catalog, **DEAD)
    with pytest.raises(RuntimeError), bound(held), catalog.transaction() as tx:
        workflow.accept_drive(tx, name="d", **FILE)
        raise RuntimeError
    again = begin(catalog)
    assert isinstance(again, requests.Held)
    assert again.made is None


def test_a_request_that_lost_its_lease_cannot_commit_any_more(catalog: Catalog) -> None:
    slow = begin(catalog, **DEAD)
    quick = begin(catalog)
    assert isinstance(quick, requests.Held)
    with pytest.raises(Conflict, match="took over"), bound(slow):
        make(catalog)
    with bound(quick):
        drive = make(catalog)
    finish(catalog, slow, b"the slow one's")
    assert isinstance(begin(catalog), requests.Busy), "the slow one's answer is not the answer"
    finish(catalog, quick)
    with catalog.reading() as session:
        assert [row.id for row in drives.page(session)] == [drive]


def test_of_several_things_made_the_first_of_the_kind_asked_for_counts(catalog: Catalog, play) -> None:
    from dataclasses import replace

    with catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", **FILE).id
        model = workflow.accept_model(tx, name="m", **FILE).id
    held = begin(catalog, **DEAD)
    with requests.bound(replace(held, kinds=KINDS, only="jobs")), catalog.transaction() as tx:
        workflow.accept_drive(tx, name="by the way", **FILE)
        job = workflow.submit_job(tx, drive_id=drive, model=model).id
    assert begin(catalog).made == ("jobs", job)


def test_an_act_that_makes_nothing_can_name_what_answers_for_it(catalog: Catalog) -> None:
    drive = make(catalog)
    held = begin(catalog, **DEAD)
    with bound(held), catalog.transaction() as tx:
        requests.note_result(tx.session, "drives", drive)
    assert begin(catalog).made == ("drives", drive)


def test_what_failed_is_given_back_but_what_it_made_stays_noted(catalog: Catalog) -> None:
    for key, making in (("made nothing", False), ("made a drive", True)):
        held = begin(catalog, key)
        made = None
        if making:
            with bound(held):
                made = ("drives", make(catalog))
        with catalog.transaction() as tx:
            requests.release(tx, held)
        again = begin(catalog, key)
        assert isinstance(again, requests.Held)
        assert again.made == made


def test_an_answer_too_large_to_keep_is_left_to_its_resource(catalog: Catalog) -> None:
    held = begin(catalog)
    with bound(held):
        drive = make(catalog)
    finish(catalog, held, b"x" * 101)
    kept = begin(catalog)
    assert (kept.body, kept.made) == (None, ("drives", drive))


@pytest.mark.parametrize("answer", [{"body": b"x" * 101}, {"private": True}])
def test_an_answer_without_a_resource_that_is_large_or_private_is_not_kept_and_done_again(catalog, answer) -> None:
    finish(catalog, begin(catalog), **answer)
    assert isinstance(begin(catalog), requests.Held)


def test_an_answer_that_its_resource_gives_again_is_not_kept(catalog: Catalog) -> None:
    held = begin(catalog)
    with bound(held):
        drive = make(catalog)
    finish(catalog, held, private=True, again=frozenset({"drives"}))
    kept = begin(catalog)
    assert (kept.status, kept.body, kept.made) == (201, None, ("drives", drive))


def test_a_project_has_so_many_keys_and_the_others_are_not_its_concern(catalog: Catalog) -> None:
    with catalog.whole().transaction() as tx:
        other = catalog.whole().scoped(projects.add(tx, "other").id)
    for number in range(2):
        assert isinstance(begin(catalog, str(number), most=2), requests.Held)
    with pytest.raises(requests.TooMany):
        begin(catalog, "a third", most=2)
    finish(catalog, begin(catalog, "kept", most=3))
    assert isinstance(begin(catalog, "kept", most=2), requests.Kept), "a repetition is no new key"
    assert isinstance(begin(other, "first", most=2), requests.Held)


def test_a_key_lives_for_its_time(catalog: Catalog) -> None:
    finish(catalog, begin(catalog, lease_seconds=60.0, keep_seconds=0.0))
    assert isinstance(begin(catalog, fingerprint="another"), requests.Held), "its time is over"
    with catalog.transaction() as tx:
        assert requests.purge(tx) == 0
    for key in ("old", "older", "oldest"):
        begin(catalog, key, lease_seconds=0.0, keep_seconds=0.0)
    with catalog.transaction() as tx:
        assert [requests.purge(tx, most=2) for _ in range(3)] == [2, 1, 0]


def test_work_without_a_key_notes_nothing(catalog: Catalog) -> None:
    make(catalog)
    assert begin(catalog).made is None
