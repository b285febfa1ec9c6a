"""Shared by all tests: where the optional real data is, and a folder to run in."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
"""Meshes, environments and an ImageNet classifier that nobody on this project made; see README. May be absent."""


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real test data, or a skip that says what is missing."""
    if not (DATA / "models").is_dir():
        pytest.skip("the folder ../shared/data with real meshes, environments and a classifier is not here")
    return DATA
