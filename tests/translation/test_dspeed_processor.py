"""REN and IREN inside real dspeed chains."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import lh5
import numpy as np
import pytest
import torch
from dspeed import build_dsp
from dspeed.errors import ProcessingChainError
from lgdo import Array, Table

from cpunet.pulses.container import Pulses
from cpunet.translation.dspeed_processor import ren
from cpunet.translation.translator import IREN, REN
from synthetic import waveform_table, write_chain

MODULE = "cpunet.translation.dspeed_processor"


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a readout chain with white noise of 3 keV."""
    return write_chain(tmp_path_factory.mktemp("chain"), noise_kev=3)


def table(waveforms: np.ndarray, energy: np.ndarray, dt_ns: float = 16.0) -> Table:
    kev = Array(energy, attrs={"units": "keV"})
    return Table({"waveform": waveform_table(waveforms, dt_ns), "energy": kev})


def config(run: Path, function: str, args: list[str], *init: Any) -> dict[str, Any]:
    return {
        "outputs": ["wf_out", "amplitude"],
        "processors": {
            "wf_out": {
                "function": function,
                "module": MODULE,
                "init_args": [f"'{run}'", "waveform.period", *init],
                "args": ["waveform", *args, "wf_out(shape=800, period=waveform.period)"],
            },
            "amplitude": {
                "function": "amax",
                "module": "numpy",
                "args": ["wf_out", 1, "amplitude"],
                "kwargs": {"signature": "(n),()->()", "types": ["fi->f"]},
            },
        },
    }


def test_a_chain_of_ren_on_a_file(chain, sim, tmp_path):
    waveforms = np.concatenate([sim, sim[:1] * np.nan, sim, sim])
    energy = np.full(len(waveforms), 2000.0)
    energy[2] = np.nan
    lh5.write(table(waveforms, energy), "raw", str(tmp_path / "sim.lh5"), group="geds")
    settings = config(chain, "ren", [], False)
    (tmp_path / "dsp.json").write_text(json.dumps(settings))
    build_dsp(
        raw_in=str(tmp_path / "sim.lh5"),
        dsp_out=str(tmp_path / "dsp.lh5"),
        dsp_config=str(tmp_path / "dsp.json"),
        lh5_tables=["geds/raw"],
        buffer_len=8,
        block_width=4,
    )
    (name,) = (n for n in lh5.ls(str(tmp_path / "dsp.lh5"), "geds/*") if n != "dsp_info")
    made = lh5.read(name, str(tmp_path / "dsp.lh5"))
    translator = REN.load(chain)
    expected = translator.translate_pulses(Pulses.of(waveforms, dt_ns=16), noise=False)
    found = made["wf_out"]["values"].nda
    assert found.shape == (16, 800)
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), ~expected.valid)
    np.testing.assert_allclose(found, expected.pulses.waveforms, atol=1e-6)
    np.testing.assert_allclose(made["amplitude"].nda, found.max(axis=1))


def test_noise_by_the_energy_of_each_event(chain, sim):
    waveforms = np.concatenate([sim] * 8)
    energy = np.where(np.arange(40) < 20, 2000.0, 500.0)
    energy[3] = np.nan
    given = table(waveforms, energy)
    made = [
        build_dsp(raw_in=given, dsp_config=config(chain, "ren", ["energy"], *init))
        for init in ((True, 3), (True, 3), (True, 4))
    ]
    first, again, other = (tb["wf_out"]["values"].nda for tb in made)
    assert np.isnan(first[3]).all()
    assert np.isfinite(np.delete(first, 3, axis=0)).all()
    np.testing.assert_array_equal(first, again)
    assert np.nanmax(np.abs(first - other)) > 1e-4
    clean = REN.load(chain).translate(waveforms, noise=False)
    spread = [np.nanstd((first - clean)[rows, :200]) for rows in (slice(20), slice(20, 40))]
    assert spread[1] / spread[0] == pytest.approx(4, rel=0.2)


def test_a_network_both_ways(run, sim, data):
    kev = np.ones(5)
    forward = build_dsp(
        raw_in=table(sim, kev), dsp_config=config(run, "ren", [], False), block_width=5
    )
    expected = REN.load(run).translate(sim, noise=False)
    np.testing.assert_allclose(forward["wf_out"]["values"].nda, expected, atol=1e-5)
    back = build_dsp(
        raw_in=table(data.astype(np.uint16), kev),
        dsp_config=config(run, "iren", [], 7),
        block_width=5,
    )
    translator = IREN.load(run)
    drawn = translator.translate_pulses(
        Pulses.of(data.astype(np.uint16), dt_ns=16), generator=translator.seeded(7)
    )
    assert drawn.valid.all()
    np.testing.assert_allclose(back["wf_out"]["values"].nda, drawn.pulses.waveforms, atol=1e-5)


def test_another_sampling_is_refused(chain, sim):
    with pytest.raises(ProcessingChainError) as error:
        build_dsp(
            raw_in=table(sim, np.ones(5), dt_ns=10.0),
            dsp_config=config(chain, "ren", [], False),
        )
    assert "every 10 ns" in str(error.value.__cause__)


def test_one_waveform_alone(chain, sim):
    processor = ren(str(chain), 16.0, False)
    out = np.empty(800, np.float32)
    processor(sim[0], out)
    np.testing.assert_allclose(out, REN.load(chain).translate(sim[0], noise=False), atol=1e-6)
    assert processor.signature == "(n)->(m)"
    assert torch.is_tensor(torch.from_numpy(out))
