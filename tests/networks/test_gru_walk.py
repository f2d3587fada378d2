"""The GRU of one compiled loop against torch's own."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from cpunet.networks.gru_walk import walk

pytestmark = pytest.mark.usefixtures("same_random_numbers")

Results = tuple[Tensor, Tensor]


@pytest.mark.parametrize("scale", [1, 30])  # large ones saturate the gates
def test_outputs_and_all_gradients(scale):
    gru = nn.GRU(3, 5, batch_first=True, bidirectional=True)
    given = (scale * torch.randn(4, 11, 3)).requires_grad_()
    slopes = torch.randn(4, 11, 10), torch.randn(2, 4, 5)
    leaves = [given, *gru.parameters()]

    def gradients(results: Results) -> tuple[Tensor, ...]:
        return torch.autograd.grad(results, leaves, slopes)

    expected, found = gru(given), walk(gru, given)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(gradients(found), gradients(expected), rtol=1e-4, atol=1e-5)


def test_fixed_weights_get_no_gradient():
    gru = nn.GRU(3, 5, batch_first=True, bidirectional=True).requires_grad_(False)
    given = torch.randn(2, 7, 3, requires_grad=True)
    (found,) = torch.autograd.grad(walk(gru, given)[0].sum(), given)
    (expected,) = torch.autograd.grad(gru(given)[0].sum(), given)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_nan_stays_in_its_pulse():
    gru = nn.GRU(3, 5, batch_first=True, bidirectional=True)
    given = torch.randn(2, 7, 3)
    given[1, 3] = torch.nan
    outputs, last = walk(gru, given)
    assert outputs[0].isfinite().all()
    assert outputs[1].isnan().any()
    assert last[:, 1].isnan().all()
