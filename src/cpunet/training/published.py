"""The authors' published weights become a run."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.outputs import refuse_existing
from cpunet.pulses.loading import SideInfo
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import PunetConfig
from cpunet.settings import flat
from cpunet.training.run import Run, require_alike, versions

# Published layer names → names here.
LAYERS = (
    {"inc.double_conv": "inlet", "outc.conv.0": "outlet"}
    | {"fc_mean": "latent_mean", "fc_var": "latent_log_variance"}
    | {f"down{i}.maxpool_conv.1.double_conv": f"down.{i - 1}" for i in range(1, 5)}
    | {f"up{i}.conv.double_conv": f"up.{i - 1}" for i in range(1, 5)}
)
MAPS = [f"pe{i}.pe" for i in range(1, 10)]  # computed here

PUBLISHED_DT_NS = 16.0  # of the windows of 800 samples
# Facts on the training for a report; its pulses were not published.
UNKNOWN = SideInfo(file="not published with the weights", used="an unknown number of")


def import_weights(
    out: str | Path | None = None,
    *,
    ren: str | Path | None = None,
    iren: str | Path | None = None,
    dt_ns: float = PUBLISHED_DT_NS,
    force: bool = False,
) -> Run:
    """Make a run of the published state dicts; nothing of the files is executed.

    Parameters
    ----------
    out
        Run folder to make.
    ren
        Simulation → data: ``fep_REN.pt``.
    iren
        Data → simulation: ``fep_IREN.pt``.
    dt_ns
        Sampling period in ns of the pulses of the training.
    force
        Replace existing output.

    Returns
    -------
    Run
        The run, with the files in ``imported``.

    Raises
    ------
    CpunetError
        If no generator is given, a file is not a plain state
        dict or has another architecture, the two generators differ in width, or `out` cannot
        be written.

    Examples
    --------
    ``cpunet import --ren fep_REN.pt --iren fep_IREN.pt --out run``
    """
    given = {"ren": ren, "iren": iren}
    files = {part: Path(path) for part, path in given.items() if path is not None}
    if not files:
        raise CpunetError("no generator given; name fep_REN.pt (`ren`), fep_IREN.pt (`iren`)")
    if out is not None:
        refuse_existing(Path(out), *files.values(), force=force)
    if not (np.isfinite(dt_ns) and dt_ns > 0):
        raise CpunetError(f"the sampling period is {dt_ns} ns; expected more than 0")
    published = load_recipe("published").at(PUBLISHED_DT_NS)
    length = published.preparation.length
    networks = {part: _generator(path, length) for part, path in files.items()}
    widths = {network.width for network in networks.values()}
    if len(widths) > 1:
        raise CpunetError(
            f"{ren} and {iren}: generators of widths {sorted(widths)}; give a pair"
        )
    # windows of as many samples, whatever the period
    times = flat(published.model_dump(include={"preparation", "training"}))
    settings = {n: v * dt_ns / PUBLISHED_DT_NS for n, v in times if n.endswith("_ns")}
    settings["generator.width"] = widths.pop()
    recipe = load_recipe("published", settings)
    imported = {
        part: {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for part, path in files.items()
    }
    facts: dict[str, Any] = {"peak": "FEP", "seed": None, "device": "elsewhere", "seconds": 0.0}
    facts |= {"dt_ns": dt_ns, "sim": UNKNOWN, "data": UNKNOWN, "imported": imported}
    facts["imported_at"] = datetime.now(UTC).isoformat(timespec="seconds")
    run = Run.of(networks, recipe, **facts, versions=versions())
    return run if out is None else run.save(out, force)


def _generator(path: Path, length: int) -> PositionalUNet:
    """Load a published generator, ``fep_REN.pt`` or ``fep_IREN.pt``, as plain tensors.

    Parameters
    ----------
    path
        File of the state dict.
    length
        Samples per pulse.

    Raises
    ------
    CpunetError
        If the file cannot be read, is not a published generator, or of another architecture.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # a damaged or hostile file can raise anything
        raise CpunetError(
            f"{path}: no plain state dict of tensors, or damaged ({type(error).__name__}); "
            "nothing of it was executed"
        ) from error
    named_tensors = isinstance(state, dict) and all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    )
    first = state.get("inc.double_conv.0.weight") if named_tensors else None
    width = 0 if first is None or first.ndim == 0 else len(first)
    if width < 2 or width % 2:
        raise CpunetError(
            f"{path}: no Positional U-Net (inc.double_conv.0.weight is missing or has an odd "
            "number of channels); give a file such as fep_REN.pt"
        )
    config = PunetConfig(name="punet", width=width, dropout=0.1, linear="none")
    network = PositionalUNet(config, length)
    named: dict[str, Tensor] = {}
    for name, value in state.items():
        if name in MAPS:
            continue
        layer, _, rest = name.rpartition(".")
        # batch norms and convolutions are numbered within their block
        block, _, number = layer.rpartition(".")
        if block in LAYERS and number.isdecimal():
            layer, rest = block, f"{number}.{rest}"
        named[f"{LAYERS.get(layer, layer)}.{rest}" if layer else name] = value
    require_alike(named, network.state_dict(), path)
    network.load_state_dict(named)
    return network.eval()
