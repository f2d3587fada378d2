"""Exported graphs and dspeed's processors against the run, by the tools that read them."""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path
from typing import Any

import lh5
import numpy as np
import pytest
import torch
from dspeed import build_dsp
from lgdo import Array, Table

from cpunet.errors import CpunetError
from cpunet.networks.generators import LinearInverse, ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.translation import export
from cpunet.translation.dspeed_processor import ren
from cpunet.translation.export import chain_model, export_onnx
from cpunet.translation.translator import IREN, REN
from synthetic import load_recipe, waveform_table, write_chain, write_pulses

MODULE = "cpunet.translation.dspeed_processor"


def fitted(chain: ResponseGenerator) -> None:
    """Elsewhere than where a fit begins."""
    if chain.response.drift is not None:
        chain.response.drift.stretch[...] = 0.08, -0.02
    for times, found in (("log_poles_ns", [33.0, 71.0]), ("log_decay_us", [54.6])):
        getattr(chain.response, times)[...] = np.log(found)


def unity(_chain: ResponseGenerator) -> LinearInverse:
    """An inverse that changes nothing."""
    recipe = load_recipe("fast")
    inverse = LinearInverse(recipe.preparation.length, recipe.matching.training)
    inverse.half_height.fill(0.4)
    inverse.weights[...] = np.eye(len(inverse.weights))
    return inverse


def written(folder: Path, *settings: str) -> Path:
    """A run of a readout chain."""
    fit = {"errors": {"log_poles_ns.2": 0.02, "log_decay_us.1": 0.002}}
    how = {"change": fitted, "inverse": unity, "noise_kev": 3}
    return write_chain(folder, *settings, **how, fit=fit)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("exports") / "chain")


def prepared(sim: np.ndarray) -> np.ndarray:
    config = load_recipe("fast").preparation
    return prepare(Pulses.of(sim, dt_ns=16), config, "simulated").pulses.waveforms


@pytest.mark.thorough
def test_the_graph_of_a_chain_with_its_noise_and_origin(chain, sim, tmp_path):
    onnx = pytest.importorskip("onnx")
    ort = pytest.importorskip("onnxruntime")
    done = export_onnx(chain, tmp_path / "ren.onnx")
    assert done.difference < 2e-5
    model = onnx.load(done.graph)
    onnx.checker.check_model(model)
    assert {opset.version for opset in model.opset_import if not opset.domain} == {18}
    assert model.ir_version == 8  # that of ONNX 1.13, which brought opset 18
    facts = {entry.key: entry.value for entry in model.metadata_props}
    assert (facts["recipe"], facts["peak"], facts["dt_ns"]) == ("fast", "FEP", "16.0")
    session = ort.InferenceSession(done.graph, providers=["CPUExecutionProvider"])
    (records,) = session.run(None, {"windows": prepared(sim)})
    assert records.shape == (5, 1400)
    translator = REN.load(chain)
    # prepared as data, they are the translation
    preparation = translator.recipe.preparation.model_copy(update={"saturation_run": 2000})
    clean = prepare(Pulses.of(records, dt_ns=16), preparation, "measured").pulses.waveforms
    np.testing.assert_allclose(clean, translator.translate(sim, noise=False), atol=5e-5)
    assert done.noise.name == "ren.noise.npz"
    with np.load(done.noise) as noise:
        total = noise["shares"] @ (noise["continua"] + noise["lines"])
        np.testing.assert_allclose(total, 9.0, rtol=1e-5)
        assert noise["samples"] == 2 * (len(total) - 1)
    with pytest.raises(CpunetError, match="exists already"):
        export_onnx(chain, tmp_path / "ren.onnx")
    # noise of before does not stay with an export that has none
    again = export_onnx(chain, tmp_path / "ren.onnx", inverse=True, force=True)
    assert again.difference < 2e-5
    assert again.noise is None
    assert not done.noise.exists()


@pytest.mark.slow
def test_onnx_runtime_gives_the_network_with_its_draw(network, sim, tmp_path):
    pytest.importorskip("onnx")
    ort = pytest.importorskip("onnxruntime")
    export_onnx(network, tmp_path / "ren.onnx")
    session = ort.InferenceSession(tmp_path / "ren.onnx", providers=["CPUExecutionProvider"])
    windows, translator = prepared(sim), REN.load(network)
    channels = translator.backend.network.unet.latent_mean.out_channels
    zeros = np.zeros((5, channels, 50), np.float32)
    (mean,) = session.run(None, {"windows": windows, "epsilon": zeros})
    np.testing.assert_allclose(mean, translator.apply(windows, noise=False), atol=1e-5)
    seed = int(np.random.default_rng(4).integers(2**62))
    draw = torch.randn(zeros.shape, generator=torch.Generator().manual_seed(seed)).numpy()
    (drawn,) = session.run(None, {"windows": windows, "epsilon": draw})
    expected = translator.apply(windows, generator=np.random.default_rng(4))
    np.testing.assert_allclose(drawn, expected, atol=1e-5)
    assert np.abs(drawn - mean).max() > 1e-5


@pytest.mark.thorough
def test_graphs_of_a_stretched_drift_and_of_a_network(network, tmp_path):
    # as where the physics are off
    stretched = written(tmp_path / "stretched", "generator.drift_terms=2")
    for folder, inverse in ((stretched, False), (network, True)):
        done = export_onnx(folder, tmp_path / "graph.onnx", inverse=inverse, force=True)
        assert done.difference < 2e-5


def test_without_onnx_or_with_another_graph_nothing_is_left(chain, tmp_path, monkeypatch):
    def other(response: ElectronicsResponse, length: int) -> Any:
        slower = copy.deepcopy(response)
        slower.log_decay_us += 1
        return chain_model(slower, length)

    with monkeypatch.context() as patch:
        patch.setattr(export, "chain_model", other)
        with pytest.raises(CpunetError, match=r"ren.onnx: the exported graph differs"):
            export_onnx(chain, tmp_path / "ren.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(CpunetError, match=r"pip install 'cpunet-hpge\[onnx\]'"):
        export_onnx(chain, tmp_path / "ren.onnx")
    assert not list(tmp_path.iterdir())


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


def test_a_chain_of_ren_on_a_file_that_dspeed_reads_in_buffers(chain, sim, tmp_path):
    waveforms = np.concatenate([sim, sim[:1] * np.nan, sim, sim])
    energy = np.full(len(waveforms), 2000.0)
    energy[2] = np.nan
    pulses = Pulses.of(waveforms, dt_ns=16, energy_kev=energy)
    how = {"waveform_units": "ADC", "attrs": {"run": "r001"}}
    write_pulses(tmp_path / "sim.lh5", pulses, table="geds/raw", **how)
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
    expected = REN.load(chain).translate_pulses(pulses, noise=False)
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
    configs = (config(chain, "ren", ["energy"], True, seed) for seed in (3, 3, 4))
    made = [build_dsp(raw_in=given, dsp_config=of_seed) for of_seed in configs]
    first, again, other = (tb["wf_out"]["values"].nda for tb in made)
    assert np.isnan(first[3]).all()
    assert np.isfinite(np.delete(first, 3, axis=0)).all()
    np.testing.assert_array_equal(first, again)
    assert np.nanmax(np.abs(first - other)) > 1e-4
    clean = REN.load(chain).translate(waveforms, noise=False)
    spread = [np.nanstd((first - clean)[rows, :200]) for rows in (slice(20), slice(20, 40))]
    assert spread[1] / spread[0] == pytest.approx(4, rel=0.2)


def test_a_network_both_ways(network, sim, data):
    data = data.astype(np.uint16)
    for given, function, init, translator in (
        (sim, "ren", False, REN.load(network)),
        (data, "iren", 7, IREN.load(network)),
    ):
        settings = config(network, function, [], init)
        made = build_dsp(raw_in=table(given, np.ones(5)), dsp_config=settings, block_width=5)
        pulses, how = Pulses.of(given, dt_ns=16), {"generator": np.random.default_rng(7)}
        expected = translator.translate_pulses(pulses, noise=bool(init), **how)
        assert expected.valid.all()
        found = made["wf_out"]["values"].nda
        np.testing.assert_allclose(found, expected.pulses.waveforms, atol=1e-5)


def test_one_waveform_alone(chain, sim):
    processor = ren(str(chain), 16.0, False)
    out = np.empty(800, np.float32)
    processor(sim[0], out)
    np.testing.assert_allclose(out, REN.load(chain).translate(sim[0], noise=False), atol=1e-6)
    assert processor.signature == "(n)->(m)"
    with pytest.raises(CpunetError, match="every 10 ns"):
        ren(str(chain), 10.0, False)
