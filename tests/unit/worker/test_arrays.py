"""Primal labels survive the way through the store."""

from pathlib import Path

import numpy as np

from l3ps.labels import Evidence, ScanLabels
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


def test_what_the_cameras_said_is_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def evidence(n: int) -> Evidence:
        columns = (rng.integers(0, 17, (n, 3)), rng.integers(0, 256, (n, 3)), rng.integers(0, 3, n))
        return Evidence(*(column.astype(np.uint8) for column in columns), rng.random(n) < 0.5)

    labels = [
        ScanLabels(f"t{n}", np.full(n, 4, np.uint8), np.ones(n, np.int32), evidence=evidence(n)) for n in (7, 0, 50)
    ]
    write_labels(tmp_path / "x.npz", labels)
    for before, after in zip(labels, read_labels(tmp_path / "x.npz"), strict=True):
        assert before.evidence is not None and after.evidence is not None
        for name in ("classes", "weights", "cameras", "agree"):
            stored, wanted = getattr(after.evidence, name), getattr(before.evidence, name)
            assert stored.dtype == wanted.dtype
            np.testing.assert_array_equal(stored, wanted)


def test_labels_stored_by_an_earlier_version_have_no_evidence(tmp_path: Path) -> None:
    np.savez_compressed(
        tmp_path / "old.npz",
        tokens=np.array(["a", "b"]),
        sizes=np.array([2, 1]),
        semantic=np.array([4, 11, 7], np.uint8),
        instance=np.array([1, 0, 2], np.int32),
    )
    first, second = read_labels(tmp_path / "old.npz")
    assert first.evidence is None and second.evidence is None
    assert (first.semantic.tolist(), second.semantic.tolist()) == ([4, 11], [7])
