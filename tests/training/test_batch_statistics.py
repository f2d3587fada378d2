"""The batch-norm statistics, on sets whose answer is known."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from cpunet.training.loop import EpochSampler, refresh_batch_statistics


def test_statistics_are_plain_averages_over_the_batches():
    pulses = torch.randn(12, 1, 7, generator=torch.Generator().manual_seed(0)) * 3 + 1
    network = nn.Sequential(nn.BatchNorm1d(1), nn.Conv1d(1, 2, 3), nn.BatchNorm1d(2)).eval()
    with torch.no_grad():
        network[0].weight.fill_(1.7)
        network(torch.full((2, 1, 7), 99.0))
    sampler, same_sampler = (EpochSampler(pulses, 4, seed=3) for _ in range(2))
    refresh_batch_statistics(network, sampler, 3)

    means, variances = ([], []), ([], [])
    for _ in range(3):
        x = same_sampler.next_batch()
        means[0].append(x.mean())
        variances[0].append(x.var())
        centred = (x - x.mean()) / torch.sqrt(x.var(correction=0) + network[0].eps)
        y = nn.functional.conv1d(1.7 * centred, network[1].weight, network[1].bias)
        means[1].append(y.mean(dim=(0, 2)))
        variances[1].append(y.var(dim=(0, 2)))
    for norm, mean, variance in zip((network[0], network[2]), means, variances, strict=True):
        expected = torch.stack(mean).mean(dim=0).detach().reshape(-1)
        torch.testing.assert_close(norm.running_mean, expected)
        expected = torch.stack(variance).mean(dim=0).detach().reshape(-1)
        torch.testing.assert_close(norm.running_var, expected)


def test_statistics_are_those_without_dropout():
    pulses = torch.randn(40, 1, 50, generator=torch.Generator().manual_seed(0)) + 5
    network = nn.Sequential(nn.Dropout(0.5), nn.BatchNorm1d(1)).eval()
    refresh_batch_statistics(network, EpochSampler(pulses, 40, seed=3), 1)
    torch.testing.assert_close(network[1].running_var, pulses.var().reshape(1))
    assert network[0].p == 0.5
    assert network(pulses).std().item() == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize("training", [True, False])
def test_all_else_is_left_as_it_was(training):
    network = nn.Sequential(nn.BatchNorm1d(1, momentum=0.3), nn.Conv1d(1, 1, 1))
    network.train(training)
    weights = [p.detach().clone() for p in network.parameters()]
    refresh_batch_statistics(network, EpochSampler(torch.randn(5, 1, 4), 2, seed=0), 2)
    assert network[0].momentum == 0.3
    assert all(module.training == training for module in network.modules())
    assert all(map(torch.equal, network.parameters(), weights))
    assert all(p.grad is None for p in network.parameters())
