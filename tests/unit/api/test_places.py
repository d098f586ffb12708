"""Who gets a place when there are few."""

import pytest

from l3ps_api.places import Places
from l3ps_api.problems import ApiProblem


def taken(places: Places, project: str) -> list:
    """All places that a project gets when it takes what it can."""
    held = []
    while True:
        place = places.hold(project)
        try:
            place.__enter__()
        except ApiProblem as problem:
            assert problem.status == 429 and problem.code == "too-many" and problem.headers["Retry-After"]
            assert problem.errors[0].remedy == "Wait."
            return held
        held.append(place)


@pytest.fixture
def places() -> Places:
    return Places(12, "too-many", "things", "Wait.")


def test_one_project_gets_half_and_whoever_comes_finds_room(places: Places) -> None:
    held = [taken(places, project) for project in "abcd"]
    assert [len(each) for each in held] == [6, 3, 2, 1]
    assert places.taken == 12


def test_a_place_is_free_again_whatever_its_answer_came_to(places: Places) -> None:
    with pytest.raises(OSError, match="gone"), places.hold("a"):
        raise OSError("gone")
    assert places.taken == 0
