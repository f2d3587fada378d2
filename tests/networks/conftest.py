"""Networks that are the same in each test."""

from __future__ import annotations

from synthetic import same_random_numbers as same_random_numbers
