"""Content-addressed keys: equal for equal work, different for different work."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from l3ps.presets import PRESETS
from l3ps.segment.presets import BALANCED, FAST
from l3ps_worker import keys

BEST = PRESETS["best"]


def segment(**changes) -> str:
    given = {
        "project": "prj_a",
        "drive_sha256": "d",
        "model_sha256": "m",
        "scene": "s",
        "preset": BEST,
        "look": FAST,
    } | changes
    skip = given.pop("skip", False)
    return keys.segment_key(**given, skip=skip)


def refine(**changes) -> str:
    given = {"primal_key": "stages/prj_a/p", "preset": BEST, "formats": ["nuscenes"], "protocol": "nuscenes"} | changes
    return keys.refine_key(**given)


@pytest.mark.parametrize(
    "change",
    [
        {"project": "prj_b"},
        {"drive_sha256": "x"},
        {"model_sha256": "x"},
        {"scene": "x"},
        {"skip": True},
        {"preset": replace(BEST, min_area=0.5)},
        {"look": BALANCED},
        {"look": replace(FAST, fusion="cuts")},
    ],
)
def test_segment_keys_tell_inputs_apart(change) -> None:
    assert segment() == segment()
    assert segment(**change) != segment()


def test_primal_labels_serve_every_refinement() -> None:
    assert segment(preset=replace(BEST, instance_class=False)) == segment()


@pytest.mark.parametrize(
    "change",
    [
        {"primal_key": "stages/prj_a/x"},
        {"primal_key": "stages/prj_b/p"},
        {"preset": replace(BEST, instance_class=False)},
        {"formats": ["semantickitti"]},
        {"protocol": "paper"},
    ],
)
def test_refine_keys_tell_inputs_apart(change) -> None:
    assert refine() == refine()
    assert refine(**change) != refine()


def test_the_order_of_formats_does_not_matter() -> None:
    assert refine(formats=["a", "b"]) == refine(formats=["b", "a"])


def test_a_changed_vote_rule_refines_anew_from_the_same_primal_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("segment/session.py", "refine/vote.py", "simulate/world.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("before")
    monkeypatch.setattr(keys, "_ROOT", tmp_path)

    def both() -> tuple[str, str]:
        keys.code_version.cache_clear()
        return segment(), refine()

    before = both()
    (tmp_path / "simulate/world.py").write_text("after")
    assert both() == before
    (tmp_path / "refine/vote.py").write_text("after")
    changed = both()
    assert changed[0] == before[0] and changed[1] != before[1]
    (tmp_path / "segment/session.py").write_text("after")
    assert both()[0] != before[0]
    keys.code_version.cache_clear()


def test_chunks_give_labels_of_their_own_but_a_budget_that_is_not_reached_does_not() -> None:
    assert refine(max_points=1000) != refine(max_points=2000) != refine()
    assert refine(max_points=None) == refine()


def test_labels_of_another_build_of_the_clustering_are_other_labels(monkeypatch) -> None:
    before, primal = refine(), segment()
    monkeypatch.setattr(keys, "build", lambda: "another")
    keys.code_version.cache_clear()
    assert refine() != before
    assert segment() == primal, "images know no clusters"
    keys.code_version.cache_clear()


@pytest.mark.parametrize(
    "name", ["../../etc", "a/../../b", "x\x00y", "ü" * 300, "con:1", "%2e%2e", "", "-rf", "a" * 1000]
)
def test_no_name_of_a_log_is_part_of_an_output_s_key(name: str) -> None:
    """Scenes are called what the log calls them; the key holds a digest of that."""
    assert re.fullmatch(r"stages/prj_a/segment-[0-9a-f]{64}", segment(scene=name))
