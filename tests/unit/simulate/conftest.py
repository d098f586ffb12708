"""One small simulated drive for all tests of the simulator."""

import numpy as np
import pytest

from l3ps.simulate import simulate_drive
from l3ps.simulate.traffic import build_world
from l3ps.simulate.world import World

SCANS, WIDTH, SEED = 3, 320, 3


@pytest.fixture(scope="session")
def simulated(tmp_path_factory):
    """A drive of one scene with pixel truth."""
    out = tmp_path_factory.mktemp("simulated") / "drive"
    simulate_drive(out, scenes=1, scans=SCANS, seed=SEED, image_truth=True, width=WIDTH)
    return out


@pytest.fixture(scope="session")
def world() -> World:
    """A street scene."""
    return build_world(np.random.default_rng(5), 10.0)
