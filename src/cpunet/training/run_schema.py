"""Required content of ``run.json``, with types, so that readers of a run can rely on it.

Users edit, truncate and mix up files of runs.  Additional keys are accepted; ``format`` defines
the meaning of the keys and the settings of the recipe.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cpunet.pulses.cuts import CutWindows

FORMAT = 2
"""Format of run folders; those of other versions cannot be loaded."""

_Number = Annotated[float, Field(ge=0, le=1e15)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True, strict=True, allow_inf_nan=False)


class SideFacts(_Part):
    """The pulses of one side; unknown facts, for example of imported runs, may be missing."""

    file: str | None = None
    used: int | str | None = None  # text if the number is unknown, as for imported runs
    read: int | None = None
    sha256: str | None = None
    cuts: Annotated[CutWindows | None, Field(strict=False)] = None


class FitFacts(_Part):
    """Fit of a matched response: errors of its parameters, and their covariance."""

    errors: dict[str, float] | None = None
    covariance: list[list[float]] | None = None


class RunFacts(_Part):
    """The content of ``run.json``."""

    format: Annotated[int, Field(ge=0)] = 0
    recipe: str
    peak: str
    seed: Annotated[int, Field(ge=0)] | None
    device: str
    seconds: _Number | None
    dt_ns: Annotated[float, Field(gt=0, le=1e9)]
    init: str | None = None
    sim: SideFacts | None = None
    data: SideFacts | None = None
    fit: FitFacts | None = None


def problem(info: Mapping[str, Any]) -> str:
    """What is wrong with the content of a ``run.json``, and what to do; empty if nothing is.

    Examples
    --------
    >>> facts = {"recipe": "fast", "peak": "FEP", "seed": 0, "device": "cpu", "seconds": 9.5}
    >>> facts |= {"format": FORMAT}
    >>> problem(facts | {"dt_ns": 16}), problem(facts | {"dt_ns": "16"})
    ('', 'damaged (dt_ns: Input should be a valid number); train again')
    """
    try:
        found = RunFacts.model_validate(info)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        key = ".".join(map(str, first["loc"]))
        wrong = f"no {key}" if first["type"] == "missing" else f"{key}: {first['msg']}"
        return f"damaged ({wrong}); train again"
    if found.format != FORMAT:
        return (
            f"of another version of cpunet (format {found.format}, not {FORMAT}); read it with "
            "that one, or train again"
        )
    return ""
