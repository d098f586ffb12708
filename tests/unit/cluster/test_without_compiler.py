"""Installed without the C++ part: the method goes on, slower, and says so once."""

import json
import subprocess
import sys

import numpy as np

from l3ps.refine.cluster import cluster_scene, hdbscan_package
from l3ps_cluster import fill_noise, link, nearest

SCRIPT = """
import json, sys, warnings
sys.modules["l3ps_cluster._core"] = None  # as where it was never built
import numpy as np
import l3ps_cluster
from l3ps.refine.cluster import cluster_scene

rng = np.random.default_rng(5)
points = np.concatenate([rng.normal(c, 0.3, (60, 3)) for c in ((0, 0, 0), (9, 0, 0), (0, 9, 0))]).astype(np.float32)
with warnings.catch_warnings(record=True) as warned:
    warnings.simplefilter("always")
    labels = [cluster_scene(points, points[:, 0] > 5, 5)[0] for _ in range(2)]
try:
    l3ps_cluster.HDBSCAN().fit(points)
    error = ""
except RuntimeError as raised:
    error = str(raised)
distance, index = l3ps_cluster.nearest(points, points[::7] + 0.1, 3, max_distance=0.5)
json.dump({
    "native": l3ps_cluster.native,
    "warned": [str(w.message) for w in warned if "l3ps-cluster" in str(w.message)],
    "error": error,
    "points": points.tolist(),
    "labels": [l.tolist() for l in labels],
    "distance": np.nan_to_num(distance, posinf=-1).tolist(),
    "index": index.tolist(),
    "link": l3ps_cluster.link(points, 0.4).tolist(),
    "filled": l3ps_cluster.fill_noise(points, np.arange(180) % 4 - 1).tolist(),
}, sys.stdout)
"""


def test_everything_works_without_the_compiled_part():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    slow = json.loads(done.stdout)
    points = np.array(slow["points"], np.float32)

    assert slow["native"] is False
    assert len(slow["warned"]) == 1, "once, though four partitions were clustered"
    assert "C++ compiler" in slow["warned"][0]
    assert "uv sync --reinstall-package l3ps-cluster" in slow["error"]

    package = cluster_scene(points, points[:, 0] > 5, 5, clusterer=hdbscan_package)[0]
    assert slow["labels"] == [package.tolist()] * 2

    distance, index = nearest(points, points[::7] + 0.1, 3, max_distance=0.5)
    assert slow["index"] == index.tolist()
    np.testing.assert_allclose(np.nan_to_num(distance, posinf=-1), slow["distance"], rtol=1e-6)
    assert slow["link"] == link(points, 0.4).tolist()
    assert slow["filled"] == fill_noise(points, np.arange(180) % 4 - 1).tolist()
