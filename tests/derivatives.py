"""Derivatives by autograd and by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import torch

Values = dict[str, torch.Tensor]


def slopes(
    function: Callable[[], Values], moved: torch.Tensor, along: torch.Tensor, step: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Derivatives of each value along a direction: by autograd, and by central differences."""

    def values() -> Values:
        torch.manual_seed(1)  # the same noise every time
        return function()

    found, wanted = {}, {}
    for name, value in values().items():
        (slope,) = torch.autograd.grad(value, moved, retain_graph=True, allow_unused=True)
        found[name] = 0.0 if slope is None else float((slope * along).sum())
    with torch.no_grad():
        start = moved.clone()
        sides = []
        for sign in (1, -1):
            moved.copy_(start + sign * step * along)
            sides.append(values())
        moved.copy_(start)
    for name in found:
        wanted[name] = float(sides[0][name] - sides[1][name]) / (2 * step)
    return found, wanted
