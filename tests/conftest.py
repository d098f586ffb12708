"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; without it the test is skipped loudly, or fails in CI."""
    folder = Path(os.environ.get("L3PS_REAL_DATA", ROOT.parent / "shared")).resolve()
    if not (folder / "data").is_dir():
        message = f"REAL DATA MISSING: no recordings in {folder}; set L3PS_REAL_DATA to the folder that holds data/"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return folder
