"""GRUs that walk together against each alone."""

from __future__ import annotations

import torch
from torch import nn

from cpunet.networks.gru_chains import run_together


def test_outputs_and_all_gradients():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        grus = [nn.GRU(3, 5, batch_first=True, bidirectional=True).double() for _ in range(2)]
        inputs = [
            torch.randn(4, 11, 3, dtype=torch.float64, requires_grad=True) for _ in range(2)
        ]
        slopes = [(torch.randn(4, 11, 10).double(), torch.randn(2, 4, 5).double())] * 2
    expected = [gru(given) for gru, given in zip(grus, inputs, strict=True)]
    found = run_together(grus, inputs)
    leaves = [*inputs, *grus[0].parameters(), *grus[1].parameters()]

    def gradients(results: list[tuple[torch.Tensor, torch.Tensor]]) -> tuple[torch.Tensor, ...]:
        flat = [value for pair in results for value in pair]
        return torch.autograd.grad(flat, leaves, [value for pair in slopes for value in pair])

    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradients(found), gradients(expected), rtol=1e-10, atol=1e-12)
