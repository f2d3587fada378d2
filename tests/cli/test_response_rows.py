"""What a response tells of itself has a row in the table of ``cpunet response``."""

from __future__ import annotations

import pytest

from cpunet.cli.response import response_table
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes import load_recipe


@pytest.mark.parametrize("also", [{}, {"ringing_mhz": 5.0}, {"free_decays": True}])
def test_every_parameter_has_a_row(also):
    config = load_recipe("fast").matching[0].model_copy(update=also)
    values = ElectronicsResponse(config, 16.0).describe()
    values = {k: v for k, v in values.items() if not k.startswith("slow_")}  # told as a sum
    table = response_table({"runs": [{"path": "run", "values": values, "errors": {}}]})
    assert table.row_count == len(values)
