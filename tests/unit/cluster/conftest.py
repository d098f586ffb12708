import importlib.util
from pathlib import Path

import numpy as np
import pytest

import l3ps_cluster


@pytest.fixture(autouse=True, scope="session")
def native():
    """These tests are about the C++ part: where it was not built, they fail and say so."""
    assert l3ps_cluster.native, "l3ps-cluster has no C++ part; run `uv sync --reinstall-package l3ps-cluster`"


@pytest.fixture(scope="session")
def reference():
    """The module beside this file: HDBSCAN by brute force."""
    spec = importlib.util.spec_from_file_location("reference", Path(__file__).with_name("reference.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def rng():
    return np.random.default_rng(5)
