"""Matrix products of jobs take one thread, whatever else the machine does."""

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info

from cpunet.matrices import one_thread_for_matrices


def threads() -> list[int]:
    """Threads of each OpenBLAS that is loaded."""
    return [
        pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas"
    ]


def test_one_thread_within_and_all_after() -> None:
    scipy.linalg.eigh(np.eye(2))  # both are loaded
    before = threads()
    with one_thread_for_matrices():
        assert set(threads()) <= {1}
    assert threads() == before


def test_all_again_after_an_error() -> None:
    before = threads()

    @one_thread_for_matrices()
    def fails() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails()
    assert threads() == before
