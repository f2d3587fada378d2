"""Run folder: the results of a training, with their provenance.

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
from cpunet.recipes.schema import Recipe
from cpunet.settings import checked, read_json, read_values
from cpunet.training.loop import Record
from cpunet.training.run_schema import FORMAT, problem

INFO, RECIPE, LOSSES, WEIGHTS = "run.json", "recipe.yaml", "losses.jsonl", "weights.safetensors"
RUN = FolderKind(
    name="run",
    command="cpunet train",
    known_by=INFO,
    own=r"run\.json|recipe\.yaml|losses\.jsonl|weights\.safetensors"
    r"|calibration\.json|(profiles|pulls|directions)\.png|detector\.yaml|settings\.yaml|sim\.lh5",
)


def versions() -> dict[str, str]:
    """Versions of the software that affects the result."""
    packages = {name: version(name) for name in ("torch", "numpy", "numba")}
    return {"python": platform.python_version(), "cpunet": cpunet.__version__} | packages


def append_losses(folder: Path, records: Iterable[Record]) -> None:
    """Add training records to the folder's log."""
    with (folder / LOSSES).open("a") as stream:
        stream.writelines(json.dumps(record) + "\n" for record in records)


def write_run(
    folder: Path, model: nn.Module, recipe: Recipe, info: dict[str, Any]
) -> dict[str, Any]:
    """Write weights, recipe and provenance into an existing folder; return the provenance."""
    weights = {
        name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()
    }
    (folder / WEIGHTS).write_bytes(save(weights))
    (folder / RECIPE).write_text(
        yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), encoding="utf-8"
    )
    content = {"format": FORMAT} | info
    (folder / INFO).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return content


def read_info(run: Path) -> dict[str, Any]:
    """Provenance of a run.

    Raises
    ------
    CpunetError
        If the folder is not a finished run, or of another version.
    """
    path = Path(run) / INFO
    if not path.is_file():
        raise CpunetError(f"{run}: no finished run (no {INFO}); make one with `cpunet train`")
    info = read_json(path, "train again")
    if wrong := problem(info):
        raise CpunetError(f"{path}: {wrong}")
    return info


def read_recipe(run: Path) -> Recipe:
    """Return the resolved recipe of a run."""
    path = Path(run) / RECIPE
    return checked(Recipe, read_values(path), str(path))


def read_losses(run: Path) -> list[Record]:
    """Return the training records; empty if the log is missing."""
    path = Path(run) / LOSSES
    if not path.is_file():
        return []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        records = [json.loads(line) for line in lines]
        if not all(map(_is_record, records)):
            raise ValueError("a line holds no losses")
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise CpunetError(f"{path}: damaged ({error}); remove it or train again") from error
    return records


def _is_record(record: Any) -> bool:
    """Whether a line of the log is an iteration, its rate and its losses."""
    if not isinstance(record, dict) or not isinstance(record.get("losses"), dict):
        return False
    numbers = [record.get("iteration"), record.get("rate", 0.0), *record["losses"].values()]
    return all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)


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
    _require_weights(path, name, own)
    network.load_state_dict(own)
    return network.to(torch.device(device)).eval()


def fill_networks(run: Path, model: nn.Module) -> None:
    """Fill the networks of a CycleGAN for which the run has weights, at least REN and IREN.

    Raises
    ------
    CpunetError
        If the file is missing, damaged or of another architecture.
    """
    device = str(next(model.parameters()).device)
    there = _weights_of(run, device)
    for name, network in model.named_children():
        judge = name.startswith("discriminator_")
        if name in ("ren", "iren") or (judge and any(k.startswith(f"{name}.") for k in there)):
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


def _require_weights(path: Path, name: str, weights: dict[str, Tensor]) -> None:
    """Raise a `CpunetError` if a weight is not finite, or all weights are zero."""
    floating = {key: w for key, w in weights.items() if w.is_floating_point()}
    for key, values in floating.items():
        if not bool(torch.isfinite(values).all()):
            raise CpunetError(f"{path}: {name}.{key} is not finite; train again")
    if floating and not any(bool(values.any()) for values in floating.values()):
        raise CpunetError(f"{path}: all weights of {name} are zero; train again")


def _weights_of(run: Path, device: str) -> dict[str, Tensor]:
    path = Path(run) / WEIGHTS
    try:
        weights: dict[str, Tensor] = load_file(path, device=device)
    except (OSError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise CpunetError(f"{path}: no readable weights; train again") from error
    return weights
