"""A trained run: in memory, and as a folder.

``run.json``
    Versions, seed, device, time taken, fingerprints of the files, counts, the fit.
``recipe.yaml``
    Every setting, resolved.
``losses.jsonl``
    A line per iteration.
``weights.safetensors``
    The networks, names prefixed ``ren.``, ``iren.``, ``discriminator_*.``.
"""

from __future__ import annotations

import hashlib
import json
import logging
import platform
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeAlias, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, ValidationInfo, field_validator
from safetensors import SafetensorError
from safetensors.numpy import load, save

import cpunet
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.errors import CpunetError
from cpunet.networks import Array, Stored, require_torch
from cpunet.outputs import FolderKind, folder_written_aside
from cpunet.pulses.loading import InfoPart, SideInfo
from cpunet.recipes.schema import Recipe
from cpunet.settings import checked, read_json, read_values, yaml_text
from cpunet.tables import aligned
from cpunet.training.verdict import FitInfo

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from torch import nn

    from cpunet.pulses.channels import Outcome
    from cpunet.translation.translation import Translation
    from cpunet.translation.translator import IREN, REN
    from cpunet.validation.report import Report

log = logging.getLogger(__name__)

FORMAT = 3
"""Format of run folders; those of other versions cannot be loaded."""


Record = dict[str, float | int | dict[str, float]]
"""What is logged of a step: ``iteration``, ``rate`` and ``losses``."""

INFO, RECIPE, LOSSES, WEIGHTS = "run.json", "recipe.yaml", "losses.jsonl", "weights.safetensors"
RUN = FolderKind(
    name="run",
    command="cpunet train",
    own=r"run\.json|recipe\.yaml|losses\.jsonl|weights\.safetensors"
    r"|calibration\.json|(pulls|directions)\.png|detector\.yaml|settings\.yaml|sim\.lh5",
)
Network = TypeVar("Network", bound="Stored | nn.Module")
_NOT_STORED: Any = {"exclude": True, "repr": False}


class Run(InfoPart):
    """A training run, returned by `cpunet.train` or opened with `Run.load`.

    Parameters
    ----------
    recipe
        All settings of the training.
    weights
        Arrays of all parts by name.
    folder
        Folder of the run; None if it is in memory only.
    peak, seed, device
        Energies trained on, seed, and device.
    dt_ns
        Sampling period in ns.
    started, seconds
        When the training began, and the time taken in s; None if unknown.
    sim, data
        Pulses of both sides.
    fit
        Fit of a readout chain, or what was measured for a network; None if nothing was.
    versions
        Versions of the software.
    imported
        Files of imported weights, by part.
    log
        Records of the training, if it was not read from a folder.
    """

    dt_ns: Annotated[float, Field(gt=0, le=1e9)]
    recipe: Recipe = Field(**_NOT_STORED)
    weights: dict[str, Array] = Field(**_NOT_STORED)
    folder: Path | None = Field(None, **_NOT_STORED)
    log: list[Record] | None = Field(None, **_NOT_STORED)
    peak: str
    seed: Annotated[int, Field(ge=0)] | None
    device: str
    seconds: Annotated[float, Field(ge=0, le=1e15)] | None
    started: str = ""
    sim: SideInfo = SideInfo()
    data: SideInfo = SideInfo()
    fit: FitInfo | None = None
    versions: dict[str, str] = {}
    imported: dict[str, dict[str, str]] = {}

    @field_validator("recipe")
    @classmethod
    def _at_its_period(cls, recipe: Recipe, info: ValidationInfo) -> Recipe:
        return recipe.at(info.data["dt_ns"]) if "dt_ns" in info.data else recipe

    __eq__ = object.__eq__  # weights are not compared
    __hash__ = object.__hash__

    @classmethod
    def of(cls, parts: Mapping[str, Stored | nn.Module], recipe: Recipe, **facts: Any) -> Self:
        """Make a run of trained parts."""
        weights = {
            f"{part}.{name}": np.array(values, order="C")
            for part, of in parts.items()
            for name, values in arrays_of(of).items()
        }
        return cls.model_validate({**facts, "recipe": recipe, "weights": weights})

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Open the folder of a finished run.

        Raises
        ------
        CpunetError
            If the folder is not a finished run, is of another version, or is damaged.
        """
        folder = Path(folder)
        path = folder / INFO
        if not path.is_file():
            raise CpunetError(
                f"{folder}: no finished run (no {INFO}); make it with `cpunet train`"
            )
        facts = read_json(path, "train again")
        if (stored_format := facts.pop("format", 0)) != FORMAT:
            raise CpunetError(
                f"{path}: of another version of cpunet (format {stored_format}, not {FORMAT}); "
                "read it with that, or train again"
            )
        recipe = checked(Recipe, read_values(folder / RECIPE), str(folder / RECIPE))
        try:
            weights = load((folder / WEIGHTS).read_bytes())
        except (OSError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
            raise CpunetError(
                f"{folder / WEIGHTS}: no readable weights; train again"
            ) from error
        facts |= {"recipe": recipe, "weights": weights, "folder": folder}
        try:
            return cls.model_validate(facts)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            key = ".".join(map(str, first["loc"]))
            wrong = f"no {key}" if first["type"] == "missing" else f"{key}: {first['msg']}"
            raise CpunetError(f"{path}: damaged ({wrong}); train again") from error

    def write(self, folder: Path) -> None:
        """Write weights, log, recipe and provenance into an existing folder."""
        lines = [json.dumps(record) + "\n" for record in self.records]
        if lines:
            (folder / LOSSES).write_text("".join(lines), encoding="utf-8")
        (folder / WEIGHTS).write_bytes(save(self.weights))
        settings = yaml_text(self.recipe.model_dump(mode="json"))
        (folder / RECIPE).write_text(settings, encoding="utf-8")
        facts = {"format": FORMAT, "recipe": self.recipe.name}
        facts |= self.model_dump(mode="json", exclude_unset=True)
        (folder / INFO).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")

    def save(self, folder: str | Path, force: bool = False) -> Self:
        """Write the run to a folder, and return the run of that folder.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is not a run.
        """
        with folder_written_aside(Path(folder), RUN, self.folder, force=force) as aside:
            self.write(aside)
        return self.model_copy(update={"folder": Path(folder)})

    def fill(self, part: str, network: Network, device: str = "cpu") -> Network:
        """Fill a network, or a readout, with the arrays of a part (``"ren"``, ``"iren"``, …).

        Raises
        ------
        CpunetError
            If the weights are of another architecture, not finite, or all zero.
        """
        where, prefix = (self.folder or Path()) / WEIGHTS, f"{part}."
        weights = self.weights.items()
        own = {key.removeprefix(prefix): of for key, of in weights if key.startswith(prefix)}
        require_alike(own, arrays_of(network), where)
        floating = {key: values for key, values in own.items() if values.dtype.kind == "f"}
        for key, values in floating.items():
            if not np.isfinite(values).all():
                raise CpunetError(f"{where}: {part}.{key} is not finite; train again")
        if floating and not any(values.any() for values in floating.values()):
            raise CpunetError(f"{where}: all weights of {part} are zero; train again")
        if isinstance(network, Stored):
            network.fill(own)
            return network
        import torch

        network.load_state_dict({key: torch.from_numpy(values) for key, values in own.items()})
        return network.to(torch.device(device)).eval()

    @property
    def name(self) -> str:
        """The folder, as text for messages and records."""
        return "run in memory" if self.folder is None else str(self.folder)

    @cached_property
    def weights_sha256(self) -> str:
        """Fingerprint of the weights: that of their file."""
        return hashlib.sha256(save(self.weights)).hexdigest()

    @property
    def tails(self) -> DrawnTails | None:
        """Pile-up tails under the data, with rate 0 if they have none for sure."""
        tails = None if self.fit is None else self.fit.tails
        if tails is None or tails.drawn is None:
            return None
        drawn = TypeAdapter(DrawnTails).validate_python(tails.drawn)
        return drawn if tails.rate_khz > 0 else replace(drawn, rate_khz=0.0)

    @cached_property
    def records(self) -> list[Record]:
        """Records of the training's log; empty without a log."""
        path = (self.folder or Path()) / LOSSES
        if self.log is not None or self.folder is None or not path.is_file():
            return self.log or []
        try:
            return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        except ValueError as error:
            raise CpunetError(f"{path}: damaged ({error}); remove it or train again") from error

    @cached_property
    def losses(self) -> DataFrame:
        """Losses of the training: a row per record, with ``iteration`` and ``rate``."""
        from pandas import DataFrame

        rows = [dict(record) for record in self.records]
        return DataFrame([row | row.pop("losses") for row in rows])  # type: ignore[operator]

    @cached_property
    def ren(self) -> REN:
        """Translator from simulated to measured-like pulses."""
        from cpunet.translation.translator import REN

        return REN.of(self)

    @cached_property
    def iren(self) -> IREN:
        """Translator from measured to simulation-like pulses."""
        from cpunet.translation.translator import IREN

        return IREN.of(self)

    @cached_property
    def covariance(self) -> DataFrame:
        """Covariance of the fitted parameters, with their names; empty if nothing was fitted.

        Parameters of positive quantities are their logarithms (``log_poles_ns.0``).
        """
        from pandas import DataFrame

        fit = self.fit or FitInfo()
        names = list(fit.errors) if fit.covariance else []
        return DataFrame(np.array(fit.covariance).reshape(-1, len(names)), names, names)

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Physical parameters of the readout chain; each name ends with the unit.

        Raises
        ------
        CpunetError
            If the run is not a readout chain.
        """
        from cpunet.training.chain_description import describe_chain

        return describe_chain(self).values

    def plot(self) -> Figure:
        """Step and impulse response, tail and noise of a readout chain; losses of networks.

        Raises
        ------
        CpunetError
            If a run of networks contains no losses.
        """
        from cpunet.training.chain_description import describe_chain
        from cpunet.training.figures import loss_curves
        from cpunet.training.response import Response

        if self.recipe.generator.name != "response":
            return loss_curves(self.records)
        return Response([describe_chain(self)]).plot()

    def translate(
        self, pulses: Any, out: str | Path | None = None, **how: Any
    ) -> Translation | Outcome[Translation]:
        """Translate with this run, see `cpunet.translate`."""
        from cpunet.translation.translate import translate

        return translate(self, pulses, out, **how)

    def validate(  # type: ignore[override]  # pydantic's own is deprecated
        self, sim: Any, data: Any, out: str | Path | None = None, **how: Any
    ) -> Report | Outcome[Report]:
        """Validate this run, see `cpunet.validate`."""
        from cpunet.validation.validate import validate

        return validate(self, sim, data, out, **how)

    @property
    def ok(self) -> bool:
        """Whether its fit is good, or nothing was fitted."""
        checks = None if self.fit is None else self.fit.checks
        return checks is None or checks.good

    def summary(self) -> list[tuple[str, str]]:
        """What was trained, on what, and how well it fits: topics and texts."""
        from cpunet.training.chain_description import summary

        return summary(self)

    def __str__(self) -> str:
        return aligned(self.summary())

    def __repr__(self) -> str:
        per = None if self.fit is None else self.fit.chi_square_per_moment
        fit = "" if per is None else f", chi-square per moment {per:.2f}"
        fit += "" if self.ok else ", a bad fit"
        return f"<{type(self).__name__} {self.name}: {self.recipe.name}, {self.peak}{fit}>"

    def _repr_html_(self) -> str:
        from cpunet.html_pages import notebook_picture, part

        drawable = self.recipe.generator.name == "response" or self.records
        picture = notebook_picture(self.plot()) if drawable else ""
        return part("object", "cpunet run", rows=self.summary(), picture=picture)


if TYPE_CHECKING:
    RunLike: TypeAlias = str | Path | Run
else:  # which commands read: for them, a run is its folder
    RunLike = str | Path


def as_run(run: RunLike) -> Run:
    """The run itself, or that of a folder."""
    return run if isinstance(run, Run) else Run.load(run)


def used_run(run: RunLike) -> Run:
    """The same, with a warning if its fit is bad."""
    used = as_run(run)
    if used.fit is not None and not used.ok:
        log.warning(f"{used.name}: the fit of this run is bad: {used.fit.causes[0]}")
    return used


def arrays_of(part: Stored | nn.Module) -> dict[str, Array]:
    """What a run stores of a part, by name."""
    if isinstance(part, Stored):
        return part.arrays()
    return {name: values.detach().cpu().numpy() for name, values in part.state_dict().items()}


def require_alike(own: Mapping[str, Any], expected: Mapping[str, Any], path: Path) -> None:
    """Raise a `CpunetError` unless a file has the expected arrays, of either library."""
    shapes = [{name: value.shape for name, value in side.items()} for side in (own, expected)]
    if wrong := sorted({name for name, _ in shapes[0].items() ^ shapes[1].items()}):
        text = f"{len(wrong)} tensors differ, first {wrong[0]}"
        raise CpunetError(f"{path}: weights of another network: {text}")


def resolve_device(device: str, recipe: Recipe) -> str:
    """Resolve ``"auto"`` to the device of a recipe's networks; that of a chain is the CPU.

    Raises
    ------
    CpunetError
        If a device, or torch, is missing.
    """
    match = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", device)
    if match is None:
        raise CpunetError(f"device {device!r} does not exist; use cpu, cuda or auto")
    if device == "cpu" or not recipe.networks:
        return "cpu"
    require_torch()
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if not torch.cuda.is_available():
        raise CpunetError("no GPU; use `device` cpu or install a CUDA build of torch")
    if match[1] and int(match[1]) >= torch.cuda.device_count():
        count = torch.cuda.device_count()
        raise CpunetError(f"device {device!r}: the last of {count} GPUs is cuda:{count - 1}")
    return device


def versions() -> dict[str, str]:
    """Versions of the software that affects the result."""
    numbers = {"python": platform.python_version(), "cpunet": cpunet.__version__}
    for name in ("numpy", "scipy", "numba", "torch"):
        with suppress(PackageNotFoundError):  # torch is needed by networks only
            numbers[name] = version(name)
    return numbers
