"""What several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the optional reference data; the test skips without it."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CPUNET_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip("no reference data: set CPUNET_REFERENCE_DATA to their folder")
    return folder
