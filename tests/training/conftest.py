"""What several tests of trainings begin with."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from cpunet.recipes.schema import Recipe
from games import as_published
from synthetic import same_random_numbers as same_random_numbers


@pytest.fixture
def tiny() -> Callable[..., Recipe]:
    """Make the published recipe tiny; arguments override more of it."""
    return as_published
