"""Published weights against the layer table, written out."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from cpunet.training.published import import_weights
from cpunet.translation.translator import IREN, REN
from synthetic import one_line

M = 4
LENGTH = 800


def blocks(m: int) -> dict[str, tuple[int, int, int]]:
    """Channels in, middle and out of each double convolution, by the layer table."""
    table = {"inc": (1, m, m)}
    for i, (c, o) in enumerate(((m, 2 * m), (2 * m, 4 * m), (4 * m, 8 * m), (8 * m, 8 * m)), 1):
        table[f"down{i}.maxpool_conv.1"] = (c, o, o)
    for i, (c, o) in enumerate(((16, 4), (8, 2), (4, 1), (2, 0.5)), 1):
        table[f"up{i}.conv"] = (c * m, c * m // 2, int(o * m))
    return table


def state_dict(m: int = M, seed: int = 0) -> dict[str, Tensor]:
    """Random weights under the published names, with maps in single precision."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng)

    state: dict[str, Tensor] = {}
    for name, (c, mid, o) in blocks(m).items():
        for first, (i, j, kernel) in ((0, (c, mid, 11)), (3, (mid, o, 7))):
            layer = f"{name}.double_conv"
            scale = 1 / math.sqrt(i * kernel)
            state[f"{layer}.{first}.weight"] = scale * uniform(j, i, kernel)
            norm = f"{layer}.{first + 1}"
            state[f"{norm}.weight"] = uniform(j, low=0.5, high=1.5)
            state[f"{norm}.bias"] = uniform(j)
            state[f"{norm}.running_mean"] = uniform(j)
            state[f"{norm}.running_var"] = uniform(j, low=0.5, high=2.0)
            state[f"{norm}.num_batches_tracked"] = torch.tensor(7)
    for name, c, o in (("fc_mean", 8 * m, 8 * m), ("fc_var", 8 * m, 8 * m)):
        state[f"{name}.weight"] = uniform(o, c, 1) / math.sqrt(c)
        state[f"{name}.bias"] = uniform(o)
    state["outc.conv.0.weight"] = uniform(1, m // 2, 1)
    state["outc.conv.0.bias"] = uniform(1)
    for i, d in enumerate((m, 2 * m, 4 * m, 8 * m, 8 * m, 4 * m, 2 * m, m, m // 2), 1):
        position = torch.arange(10_000).float()
        frequency = torch.exp(torch.arange(0, d, 2).float() * (-math.log(10_000) / d))
        phase = frequency[:, None] * position
        map_ = torch.zeros(1, d, 10_000)
        map_[0, 0::2], map_[0, 1::2] = phase.sin(), phase.cos()
        state[f"pe{i}.pe"] = map_
    return state


def published_forward(state: dict[str, Tensor], pulses: Tensor, epsilon: Tensor) -> Tensor:
    """The network of the layer table, step by step; epsilon is the latent noise."""

    def block(name: str, x: Tensor) -> Tensor:
        for first, pad in ((0, 5), (3, 3)):
            layer = f"{name}.double_conv"
            x = F.conv1d(x, state[f"{layer}.{first}.weight"], padding=pad)
            n = f"{layer}.{first + 1}"
            parts = "running_mean", "running_var", "weight", "bias"
            x = F.batch_norm(x, *(state[f"{n}.{part}"] for part in parts))
            x = F.leaky_relu(x, 0.01)
        return x

    def position(i: int, x: Tensor, offset: int = 0) -> Tensor:
        return x + state[f"pe{i}.pe"][:, :, offset : offset + x.shape[2]]

    m = len(state["inc.double_conv.0.weight"])
    skips = [position(1, block("inc", pulses))]
    for i in (1, 2, 3):
        x = block(f"down{i}.maxpool_conv.1", F.max_pool1d(skips[-1], 2))
        skips.append(position(i + 1, x))
    x = block("down4.maxpool_conv.1", F.max_pool1d(skips[-1], 2))
    mean = F.conv1d(x, state["fc_mean.weight"], state["fc_mean.bias"])
    log_variance = F.conv1d(x, state["fc_var.weight"], state["fc_var.bias"])
    x = position(5, mean + torch.exp(log_variance / 2) * epsilon)
    for i, offset in ((1, 4 * m), (2, 2 * m), (3, 2 * m), (4, None)):
        wide = F.interpolate(x, scale_factor=2, mode="linear", align_corners=True)
        x = block(f"up{i}.conv", torch.cat([skips[4 - i], wide], dim=1))
        if offset is not None:
            x = position(5 + i, x, offset)
    return F.conv1d(x, state["outc.conv.0.weight"], state["outc.conv.0.bias"])


def windows(n: int = 3) -> np.ndarray:
    width = np.linspace(2, 6, n)[:, None]
    charge = 1 / (1 + np.exp(-(np.arange(LENGTH) - 370) / width))
    return charge.astype(np.float32)


def test_imported_generators_give_the_published_outputs(tmp_path):
    ren, iren = tmp_path / "fep_REN.pt", tmp_path / "fep_IREN.pt"
    torch.save(state_dict(seed=1), ren)
    torch.save(state_dict(seed=2), iren)
    run = import_weights(tmp_path / "run", ren=ren, iren=iren)
    assert set(run.imported) == {"ren", "iren"}
    pulses = torch.from_numpy(windows())[:, None]
    for kind, seed in ((REN, 1), (IREN, 2)):
        translator = kind.load(tmp_path / "run")
        mean = translator.apply(windows(), noise=False)
        expected = published_forward(state_dict(seed=seed), pulses, torch.zeros(()))
        assert np.abs(mean - expected[:, 0].numpy()).max() < 1e-5
        drawn = translator.apply(windows(), generator=np.random.default_rng(9))
        draw = torch.Generator().manual_seed(int(np.random.default_rng(9).integers(2**62)))
        epsilon = torch.randn(3, 8 * M, 50, generator=draw)
        expected = published_forward(state_dict(seed=seed), pulses, epsilon)
        assert np.abs(drawn - expected[:, 0].numpy()).max() < 1e-5
    # and the run can be used as any other
    assert REN.load(tmp_path / "run").translate(windows(), noise=False).shape == (3, LENGTH)
    stored = json.loads((tmp_path / "run" / "run.json").read_text())
    assert stored["dt_ns"] == 16
    assert len(stored["imported"]["ren"]["sha256"]) == 64
    import_weights(tmp_path / "alone", ren=ren)
    REN.load(tmp_path / "alone")
    one_line(lambda: IREN.load(tmp_path / "alone"), "weights of another network")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop("fc_var.bias"), "1 tensors differ, first latent_log_variance.bias"),
        (lambda s: s.update({"fc_mean.bias": torch.zeros(3)}), "first latent_mean.bias"),
        (lambda s: s.update({"inc.double_conv.0.weight": torch.zeros(())}), "no Positional"),
    ],
)
def test_other_architectures_are_refused_in_one_line(tmp_path, change, words):
    state = state_dict()
    change(state)
    torch.save(state, tmp_path / "other.pt")
    other = tmp_path / "other.pt"
    one_line(lambda: import_weights(tmp_path / "run", ren=other), words, str(other))
    other.write_bytes(other.read_bytes()[:100])
    one_line(lambda: import_weights(tmp_path / "run", ren=other), "or damaged", str(other))
    other.unlink()
    one_line(lambda: import_weights(tmp_path / "run", ren=other), "cannot be read")
    assert not (tmp_path / "run").exists()
