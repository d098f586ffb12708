"""A seed names a drive, byte for byte."""

import hashlib

from l3ps.simulate import annotated_images, simulate_drive


def digests(root):
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_same_seed_same_bytes_whatever_the_threads(tmp_path):
    for name, threads in (("a", 1), ("b", 3)):
        simulate_drive(tmp_path / name, scenes=2, scans=1, seed=11, width=160, image_truth=True, threads=threads)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_another_seed_is_another_drive(tmp_path):
    for seed in (11, 12):
        simulate_drive(tmp_path / str(seed), scenes=1, scans=1, seed=seed, width=160)
    ours, theirs = digests(tmp_path / "11"), digests(tmp_path / "12")
    same = {name for name, digest in ours.items() if digest in theirs.values()}
    assert same == {"v1.0-mini/visibility.json"}  # the one table without tokens of its own


def test_a_training_picture_does_not_depend_on_how_many_are_asked_for():
    few, many = list(annotated_images(1, 4, width=160)), list(annotated_images(2, 4, width=160))
    assert (few[0].rgb == many[0].rgb).all()
    assert (many[0].rgb != many[1].rgb).any()
