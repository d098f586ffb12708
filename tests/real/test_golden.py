"""The published refinement rules, point by point, on three real recordings: given the clusters, equality."""

import numpy as np
import pytest

from l3ps.presets import PAPER
from l3ps.refine.instances import correct_instances
from l3ps.refine.vote import vote

LOGS = ("kitti-raw-frames-0-3", "nuscenes-one-keyframe", "urban-surround-scene-02")


@pytest.fixture(scope="module", params=LOGS)
def golden(request, real_data):
    with np.load(real_data / "golden" / f"{request.param}.npz") as archive:
        return {name: archive[name] for name in archive.files}


@pytest.mark.real
def test_vote_equals_the_published_rules(golden):
    refined = vote(golden["cluster"], golden["primal_semantic"], PAPER.voting)
    np.testing.assert_array_equal(refined, golden["refined_semantic"])
    assert (refined != golden["primal_semantic"]).mean() > 0.01, "the vote must have had something to do"


@pytest.mark.real
def test_instance_correction_equals_the_published_rules(golden):
    for frame in np.unique(golden["frame"]):
        scan = golden["frame"] == frame
        ids = correct_instances(
            golden["points"][scan],
            golden["primal_semantic"][scan],
            golden["primal_instance"][scan].astype(np.int32),
            golden["refined_semantic"][scan],
        )
        np.testing.assert_array_equal(ids, golden["refined_instance"][scan])
