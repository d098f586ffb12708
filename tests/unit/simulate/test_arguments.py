"""Bad requests are refused whole, and an interrupted drive leaves nothing."""

import pytest

from l3ps.errors import Cancelled, InputError
from l3ps.simulate import simulate_drive


def test_all_problems_are_told_at_once(tmp_path):
    (tmp_path / "there").write_text("")
    with pytest.raises(InputError) as caught:
        simulate_drive(tmp_path, scenes=0, scans=0, seed=-1, width=100)
    assert [p.where for p in caught.value.problems] == ["scenes", "scans", "seed", "width", str(tmp_path)]


def test_a_cancelled_drive_leaves_nothing(tmp_path):
    def stop(stage, done, total):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        simulate_drive(tmp_path / "drive", scenes=1, scans=2, seed=1, progress=stop, width=64)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_every_scan(tmp_path):
    seen = []
    simulate_drive(
        tmp_path / "drive", scenes=2, scans=2, seed=1, progress=lambda *report: seen.append(report), width=64
    )
    assert seen == [("simulate", done, 4) for done in (1, 2, 3, 4)]
