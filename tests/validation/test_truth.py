"""The truth's traces, read block by block."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.validation.truth import Responses


def prepared(index, n_read):
    return SimpleNamespace(
        prepared=SimpleNamespace(index=index, n_read=n_read), path="sim.lh5", dt_ns=16.0
    )


@pytest.mark.parametrize("size", [1, 3, 7, 100])
@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_responses_are_those_of_the_pulses_in_use_whatever_the_block(tmp_path, size, dtype):
    response = np.arange(40.0).reshape(20, 2).astype(dtype)
    np.savez_compressed(tmp_path / "truth.npz", other=np.zeros(3), response=response)
    used = np.array([0, 1, 2, 9, 10, 17, 19])
    blocks = list(Responses(tmp_path / "truth.npz", prepared(used, 20)).blocks(size))
    assert [len(block) for block in blocks[:-1]] == [size] * (len(blocks) - 1)
    assert all(block.dtype == np.float32 for block in blocks)
    np.testing.assert_array_equal(np.concatenate(blocks), response[used])


@pytest.mark.parametrize("n", [3, 4])
def test_a_truth_without_any_response_is_refused_with_its_last_block(tmp_path, n):
    np.savez(tmp_path / "truth.npz", response=np.full((n, 5), np.nan))
    blocks = Responses(tmp_path / "truth.npz", prepared(np.arange(n), n)).blocks(2)
    next(blocks)
    with pytest.raises(CpunetError, match="no response is finite"):
        next(blocks)


def test_responses_that_cannot_be_read(tmp_path):
    path = tmp_path / "truth.npz"
    np.savez(path, response=np.ones((20, 300)))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(CpunetError, match="cannot be read as NumPy file"):
        Responses(path, prepared(np.arange(20), 20))
