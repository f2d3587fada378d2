"""What a training leaves behind, in one folder that says where it came from.

``run.json``
    Versions, seed, device, time taken, fingerprints of the files, counts.
``recipe.yaml``
    Every setting, resolved.
``losses.jsonl``
    One line per iteration.
``weights.safetensors``
    The four networks, names prefixed ``ren.``, ``iren.``, ``discriminator_*.``.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

import cpunet
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind
from cpunet.recipes import recipe_from
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import Record

INFO, RECIPE, LOSSES, WEIGHTS = "run.json", "recipe.yaml", "losses.jsonl", "weights.safetensors"
RUN = FolderKind(
    name="run",
    command="cpunet train",
    known_by=INFO,
    own=r"run\.json|recipe\.yaml|losses\.jsonl|weights\.safetensors|tensorboard(/events\.out\..*)?"
    r"|metrics\.json|figures\.npz"  # of an ensemble's members, and of `cpunet figure`
    r"|calibration\.(json|html)|detector\.yaml|settings\.yaml|sim\.lh5",
)


def versions() -> dict[str, str]:
    """Versions of what shapes the result."""
    packages = {name: version(name) for name in ("torch", "numpy", "numba")}
    return {"python": platform.python_version(), "cpunet": cpunet.__version__} | packages


def append_losses(folder: Path, records: Iterable[Record]) -> None:
    """Add training records to the folder's log."""
    with (folder / LOSSES).open("a") as stream:
        stream.writelines(json.dumps(record) + "\n" for record in records)


def write_run(folder: Path, model: nn.Module, recipe: Recipe, info: dict[str, Any]) -> None:
    """Write weights, recipe and provenance into an existing folder."""
    weights = {
        name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()
    }
    (folder / WEIGHTS).write_bytes(save(weights))
    (folder / RECIPE).write_text(
        yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False)
    )
    (folder / INFO).write_text(json.dumps(info, indent=2) + "\n")


def read_info(run: Path) -> dict[str, Any]:
    """Provenance of a run.

    Raises
    ------
    CpunetError
        If the folder is no finished run.
    """
    path = Path(run) / INFO
    try:
        info = json.loads(path.read_text())
    except OSError as error:
        raise CpunetError(
            f"{run}: no finished run ({INFO} cannot be read); make one with `cpunet train`"
        ) from error
    except ValueError as error:
        raise CpunetError(f"{path}: damaged ({error}); train again") from error
    if not isinstance(info, dict):
        raise CpunetError(f"{path}: damaged (no mapping); train again")
    if missing := {"dt_ns", "peak", "recipe", "seconds", "device", "seed"} - info.keys():
        raise CpunetError(f"{path}: damaged (no {min(missing)}); train again")
    return info


def read_recipe(run: Path) -> Recipe:
    """Return the resolved recipe of a run."""
    path = Path(run) / RECIPE
    try:
        return recipe_from(yaml.safe_load(path.read_text()), source=str(path))
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CpunetError(f"{path}: damaged; train again") from error


def read_losses(run: Path) -> list[Record]:
    """Return the training records; empty if the log is missing."""
    path = Path(run) / LOSSES
    if not path.is_file():
        return []
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise CpunetError(f"{path}: damaged ({error}); remove it or train again") from error


def load_network(run: Path, name: str, network: nn.Module, device: str = "cpu") -> nn.Module:
    """Fill `network` with the weights saved under `name` (``"ren"``, ``"iren"``, …).

    Raises
    ------
    CpunetError
        If the file is missing, damaged or of another architecture.
    """
    path = Path(run) / WEIGHTS
    weights = _weights_of(run, device)
    prefix = f"{name}."
    own = {key.removeprefix(prefix): v for key, v in weights.items() if key.startswith(prefix)}
    expected = network.state_dict()
    wrong = sorted(
        (own.keys() ^ expected.keys())
        | {k for k in own.keys() & expected.keys() if own[k].shape != expected[k].shape}
    )
    if wrong:
        raise CpunetError(
            f"{path}: weights of another network: {len(wrong)} tensors differ, first {wrong[0]}"
        )
    network.load_state_dict(own)
    return network.to(torch.device(device)).eval()


def fill_networks(run: Path, model: nn.Module) -> None:
    """Fill all networks of `model` that the run has weights of; REN and IREN at least.

    Raises
    ------
    CpunetError
        If the file is missing, damaged or of another architecture.
    """
    device = str(next(model.parameters()).device)
    there = _weights_of(run, device)
    for name, network in model.named_children():
        if name in ("ren", "iren") or any(key.startswith(f"{name}.") for key in there):
            was_training = network.training
            load_network(run, name, network, device).train(was_training)


def weights_sha256(run: Path) -> str:
    """Fingerprint of a run's weights.

    Raises
    ------
    CpunetError
        If there are none.
    """
    path = Path(run) / WEIGHTS
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CpunetError(f"{path}: no readable weights; train again") from error


def _weights_of(run: Path, device: str) -> dict[str, Tensor]:
    path = Path(run) / WEIGHTS
    try:
        weights: dict[str, Tensor] = load_file(path, device=device)
    except (OSError, SafetensorError) as error:
        raise CpunetError(f"{path}: no readable weights; train again") from error
    return weights
