"""The vote of a cluster, rule by rule (METHOD 3.4)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps.presets import Voting
from l3ps.refine.vote import vote

VOID, BUS, CAR, MOTORCYCLE, ROAD, VEGETATION = 0, 3, 4, 6, 11, 16
PUBLISHED = Voting()


def outcome(*classes):
    semantic = np.array(classes, np.uint8)
    refined = vote(np.zeros(len(semantic), np.int32), semantic, PUBLISHED)
    assert len(set(refined.tolist())) == 1
    return int(refined[0])


@pytest.mark.parametrize(
    ("classes", "winner"),
    [
        ([CAR] * 6 + [ROAD] * 4, CAR),
        ([VOID] * 19 + [CAR], VOID),  # 0.95 void
        ([VOID] * 9 + [CAR], CAR),  # exactly 0.9 is not above the threshold
        ([VOID] * 6 + [CAR] * 1 + [ROAD] * 3, ROAD),
        ([CAR] * 6 + [BUS] * 4, BUS),  # rare, 0.4
        ([CAR] * 7 + [BUS] * 3, CAR),  # rare, exactly 0.3
        ([CAR] * 2 + [BUS] * 4 + [MOTORCYCLE] * 5, BUS),  # first in the published order, not the most frequent
        ([VOID] * 6 + [BUS] * 4, BUS),
        ([VOID] * 5 + [BUS] * 4 + [CAR] * 4, BUS),  # void first: the rare rule is not asked, the lowest of equals wins
    ],
)
def test_rules(classes, winner):
    assert outcome(*classes) == winner


def test_points_of_no_cluster_keep_their_class():
    cluster = np.array([-1, 0, 0, 0, -1], np.int32)
    semantic = np.array([CAR, ROAD, ROAD, CAR, VOID], np.uint8)
    assert vote(cluster, semantic, PUBLISHED).tolist() == [CAR, ROAD, ROAD, ROAD, VOID]
    assert vote(np.full(2, -1, np.int32), semantic[:2], PUBLISHED).tolist() == [CAR, ROAD]


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 16)), min_size=1, max_size=300))
def test_every_cluster_ends_with_one_class_that_one_of_its_points_had(pairs):
    cluster, semantic = (np.array(x) for x in zip(*pairs, strict=True))
    refined = vote(cluster.astype(np.int32), semantic.astype(np.uint8), PUBLISHED)
    for c in np.unique(cluster):
        won = np.unique(refined[cluster == c])
        assert len(won) == 1
        assert won[0] in semantic[cluster == c]
