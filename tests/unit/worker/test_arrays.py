"""Primal labels survive the way through the store."""

from pathlib import Path

import numpy as np

from l3ps.labels import ScanLabels
from l3ps_worker.arrays import read_labels, write_labels


def test_round_trip(tmp_path: Path) -> None:
    """Scans of different size, one of them empty, ids beyond 16 bits."""
    rng = np.random.default_rng(0)
    labels = [
        ScanLabels(f"t{n}", rng.integers(0, 17, n).astype(np.uint8), rng.integers(0, 1 << 20, n).astype(np.int32))
        for n in (5, 0, 1000)
    ]
    write_labels(tmp_path / "x.npz", labels)
    back = read_labels(tmp_path / "x.npz")
    assert [scan.token for scan in back] == ["t5", "t0", "t1000"]
    for before, after in zip(labels, back, strict=True):
        assert (after.semantic.dtype, after.instance.dtype) == (np.uint8, np.int32)
        np.testing.assert_array_equal(after.semantic, before.semantic)
        np.testing.assert_array_equal(after.instance, before.instance)
