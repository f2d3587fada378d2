"""What the tests of this folder share."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Tiny networks: threads that wait for each other cost more than they gain."""
    torch.set_num_threads(1)
