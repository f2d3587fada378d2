"""Windows extended to records."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.finishing import PADDING_BEFORE, record_length, with_room
from cpunet.recipes import load_recipe

CONFIG = load_recipe("paper").preparation
DT_NS, DECAY_NS = 16.0, 54_600.0


@pytest.mark.parametrize("late", [-3, 0, 1, 5])
def test_windows_go_on_with_their_decay_wherever_their_maximum_is(late: int) -> None:
    """A network does not place the maximum of its output exactly."""
    time = (
        np.arange(record_length(CONFIG.length)) - PADDING_BEFORE - CONFIG.samples_before - late
    )
    pulse = np.clip(1 + time / 40, 0, 1) * np.exp(-np.maximum(time, 0) * DT_NS / DECAY_NS)
    window = pulse[np.newaxis, PADDING_BEFORE : PADDING_BEFORE + CONFIG.length]
    record = with_room(window.astype(np.float32), CONFIG, DT_NS)
    np.testing.assert_allclose(record[0], pulse, atol=1e-5)


def test_what_has_no_decay_stays_at_its_last_level() -> None:
    windows = np.ones((2, CONFIG.length), np.float32)
    windows[0, -20] = -1.0
    windows[1, 3] = np.nan
    records = with_room(windows, CONFIG, DT_NS)
    assert (records[0, -300:] == 1).all()
    assert np.isnan(records[1]).all()
