"""What several test files share: where the real recordings are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: more threads only wait for each other
settings.register_profile("untimed", deadline=None)  # speed is measured in benchmarks/, never asserted
settings.load_profile("untimed")

SHARED = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of real ultrasound beside the checkout; the tests that need it say so when it is missing."""
    if not SHARED.is_dir():
        pytest.skip(f"real recordings are not at {SHARED}: this test needs them")
    return SHARED
