"""Readouts of an array: tables with errors and correlations, a page with outliers marked."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cpunet.networks.generators import ResponseGenerator
from cpunet.training.chain_parameters import by_name, vector_of
from cpunet.training.response import response
from synthetic import write_chain


def chain(folder: Path, pole_ns: float) -> Path:
    """A run of a chain with a pole that is given, and small errors of all parameters."""
    facts: dict[str, Any] = {}

    def change(generator: ResponseGenerator) -> None:
        generator.response.log_poles_ns[:] = np.log([45.0, pole_ns])
        error = np.full(len(vector_of(generator.response)), 1e-4)
        covariance = np.diag(error**2).tolist()
        facts["fit"] = {"errors": by_name(generator.response, error), "covariance": covariance}

    write_chain(folder, change=change)
    return write_chain(folder, change=change, **facts)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("array")
    poles = (30.0, 30.5, 29.5, 30.2, 29.8, 60.0)
    runs = [chain(folder / f"V{i:02d}", pole) for i, pole in enumerate(poles)]
    response(*runs, out=folder / "array")
    return folder / "array", runs


def test_a_channel_that_differs_comes_first_and_is_marked(made):
    folder, runs = made
    html = (folder / "response.html").read_text()
    assert "Readouts of 6 channels: 1 to look at" in html
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', html)
    assert rows[0][0] == str(runs[5])
    assert 'class="off"' in rows[0][1]
    assert not any('class="off"' in cells for _, cells in rows[1:])


def test_both_tables_have_the_numbers_of_the_command(made):
    folder, runs = made
    known = json.loads((folder / "response.json").read_text())["runs"]
    whole = yaml.safe_load((folder / "response.yaml").read_text())
    with (folder / "response.csv").open() as stream:
        rows = {row["channel"]: row for row in csv.DictReader(stream)}
    for run, one in zip(runs, known, strict=True):
        for name, value in one["values"].items():
            assert whole[str(run)]["numbers"][name]["value"] == pytest.approx(value)
            assert float(rows[str(run)][name]) == pytest.approx(value)


def test_correlations_are_those_of_the_errors(made):
    folder, runs = made
    whole = yaml.safe_load((folder / "response.yaml").read_text())[str(runs[0])]
    names = whole["correlations"]["names"]
    matrix = np.array(whole["correlations"]["matrix"])
    assert {"rise_10_90_ns", "missing_500_ns", "effective_decay_us"} <= set(names)
    np.testing.assert_allclose(np.diag(matrix), 1, atol=1e-3)
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.abs(matrix).max() <= 1.001
    assert all(whole["numbers"][name]["error"] > 0 for name in names)
    # what comes late is not there early
    late, later = (names.index(f"missing_{ns}_ns") for ns in (500, 1000))
    assert matrix[late, later] > 0.5
