"""REN and IREN: any array in, the same rows out, reproducible, and no silent failure."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.translation.translator import IREN, REN, RejectionWarning


@pytest.fixture(scope="session")
def ren(network: Path) -> REN:
    return REN.load(network)


@pytest.fixture(scope="session")
def iren(network: Path) -> IREN:
    return IREN.load(str(network))


def test_any_array_and_a_copy_for_another_process_give_the_same(ren, sim):
    """Processes are not forked any more: https://github.com/python/cpython/issues/126831."""
    windows = ren.translate(sim, seed=3)
    assert (type(windows), windows.dtype, windows.shape) == (np.ndarray, np.float32, (5, 800))
    for same in (sim.astype(np.float64), torch.from_numpy(sim), sim.tolist()):
        assert np.array_equal(ren(same, seed=3), windows)
    copy = pickle.loads(pickle.dumps(ren))
    assert np.array_equal(copy.translate(sim, seed=3), windows)
    single = ren.translate(sim[2], seed=4)  # is a batch of one
    assert single.shape == (800,)
    assert np.array_equal(single, ren.translate(sim[2:3], seed=4)[0])


@pytest.mark.parametrize(("side", "kind"), [("ren", "simulated"), ("iren", "measured")])
def test_prepared_pulses_are_not_prepared_again(request, recipe, sim, data, side, kind):
    translator = request.getfixturevalue(side)
    raw = Pulses.of(sim if side == "ren" else data, dt_ns=16)
    windows = prepare(raw, recipe.preparation, kind).pulses.waveforms
    expected = translator.translate(raw.waveforms, noise=False)
    assert windows.shape == expected.shape == (5, 800)
    for act in (translator.translate, translator.apply):
        np.testing.assert_allclose(act(windows, noise=False), expected, atol=2e-5)
    if side == "iren":  # gain and offset of the digitiser are no part of the pulse
        other = translator.translate(3 * data + 500, noise=False)
        np.testing.assert_allclose(other, expected, atol=1e-4)


def test_pulses_that_cannot_be_translated_are_nan_and_counted(ren, sim):
    broken = sim.copy()
    broken[1, 7] = np.nan
    broken[3] = 0.25
    told = "^2 of 5 pulses cannot be translated and are rows of NaN: 1 nan, 1 constant$"
    with pytest.warns(RejectionWarning, match=told) as warnings:
        done = ren.translate(broken, noise=False)
    assert warnings[0].filename == __file__  # told where it was called
    assert np.isnan(done).all(axis=1).tolist() == [False, True, False, True, False]
    expected = ren.translate(sim[[0, 2, 4]], noise=False)
    np.testing.assert_array_equal(done[[0, 2, 4]], expected)
    with pytest.raises(CpunetError, match=r"^the pulse cannot be translated: 1 constant$"):
        ren.translate(broken[3])
    told = "pulses sampled every 10 ns, the run was trained on 16 ns; resample the pulses"
    with pytest.raises(CpunetError, match=f"^{told}$"):
        ren.translate_pulses(Pulses.of(sim, dt_ns=10))
    for shape in ((), (2, 3, 225), (3, 0)):
        with pytest.raises(CpunetError):
            ren.translate(np.zeros(shape, np.float32))
