"""Networks behind a readout: used as far as held-out pulses gain, and else left out."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.training import network_runs
from cpunet.training.figures import loss_curves
from cpunet.training.run import Run
from cpunet.training.train import train
from cpunet.translation.export import export_onnx
from cpunet.translation.translator import IREN, REN
from games import SMALL
from synthetic import load_recipe, of_parts, phased_edges, require_drawn, write_line

# more poles than these pulses have take long to be looked for
ONE_POLE = ("generator.poles_ns=[60]", "generator.slow_ns=[]", "generator.fast_decays_us=[]")
SHORT = (*ONE_POLE, "training.start_factors=[1]")
GAME = of_parts("""
residual.generator width=2
residual.training iterations=6 batch_size=16 cycle_size=8
""")
RECIPE = load_recipe("cpunet", [*SHORT, *GAME])


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[PulseFile, PulseFile]:
    folder = tmp_path_factory.mktemp("files")
    return write_line(folder / "sim.lh5", 1, None), write_line(folder / "data.lh5", 2, 4.0)


def test_with_few_pulses_it_is_the_readout_alone(files, tmp_path, caplog):
    caplog.set_level("INFO", "cpunet")
    run = train(*files, tmp_path / "run", recipe=RECIPE, device="cpu")
    assert run.recipe.residual is None
    (line,) = [text for text in caplog.messages if text.startswith("networks: ")]
    assert line.endswith("pulses of a side, a critic needs 600")
    alone = train(*files, tmp_path / "alone", recipe=load_recipe("fast", SHORT), device="cpu")
    assert run.weights_sha256 == alone.weights_sha256
    assert not (tmp_path / "run.unfinished").exists()


@pytest.fixture(scope="module")
def kept(files, tmp_path_factory) -> Run:
    """A run whose networks were kept, though they are hardly trained."""
    out = tmp_path_factory.mktemp("kept") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network_runs, "ENOUGH", 100)
        patch.setattr(network_runs, "_scale", lambda *of: (0.5, f"used; {of[-1]}"))
        return train(*files, out, recipe=RECIPE, device="cpu")


def test_networks_that_gain_are_behind_the_readout_and_its_inverse(kept, files):
    gains = kept.fit.gains
    assert "AUC of held-out pulses" in gains["U-Net of REN"]
    assert "RMS of held-out cycles" in gains["U-Net of IREN"]
    again = Run.load(kept.folder)
    ren, iren = REN.of(again), IREN.of(again)
    assert ren.backend.network.residual is not None
    pulses = phased_edges(5, np.random.default_rng(5), 450, 1100)
    windows = ren.translate(pulses, noise=False)
    ren.backend.network.residual = None
    apart = np.abs(ren.translate(pulses, noise=False) - windows)
    assert 0 < apart.max() < 0.05
    assert iren.translate(windows).shape == windows.shape
    with pytest.raises(CpunetError, match="ONNX graphs have a readout or a network") as error:
        export_onnx(again, kept.folder.with_name("ren.onnx"))
    assert "\n" not in str(error.value)


def test_a_mended_network_translates_as_it_was_trained(files, tmp_path):
    run = train(*files, tmp_path / "run", recipe=load_recipe("paper", SMALL), device="cpu")
    ren, iren = REN.of(run), IREN.of(run)
    pulses = phased_edges(8, np.random.default_rng(5), 450, 1100)
    clean = ren.translate(pulses, noise=False)
    # prepared again: the baseline is 0, the level that of the data
    np.testing.assert_allclose(clean[:, :200].mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(clean[:, -5:].mean(axis=1), 0.8, atol=1e-6)
    noisy = ren.translate(pulses, energy_kev=2614.5, seed=1)
    assert 1e-4 < (noisy - clean)[:, :200].std() < 3e-3
    back = iren.translate(noisy)
    assert np.isfinite(back).all()
    np.testing.assert_allclose(back.max(axis=1), 1, atol=1e-6)  # prepared as simulated ones are
    assert run.fit.tails is not None


def test_losses_and_accuracies_are_drawn(kept):
    records = kept.records
    assert [record["iteration"] for record in records] == list(range(6))
    figure = loss_curves(records)
    labels = [t.get_text() for axes in figure.axes for t in axes.get_legend().get_texts()]
    assert {"data", "data unseen", "sim unseen", "cycle forward"} <= set(labels)
    require_drawn(figure)


@pytest.mark.parametrize(("gain", "scale"), [(-0.1, 0.0), (0.0, 0.0), (0.1, 0.0), (0.3, 0.5)])
def test_what_gains_by_two_standard_errors_is_used(gain, scale):
    used = "used, scaled by 0.5" if scale else "left out"
    assert network_runs._scale(1, gain, 0.1, "AUC") == (scale, f"{used}; AUC")
