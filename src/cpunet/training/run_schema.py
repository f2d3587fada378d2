"""What must stand in ``run.json``, and as what: whoever reads a run can rely on it.

Files of runs are edited by hand, cut off and mixed up.  Further keys are left alone, since
every version may add some; ``format`` tells which keys mean what.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cpunet.pulses.cuts import CutWindows

FORMAT = 1
"""Of the folders written now; those of versions before it, which do not tell, load as well."""

_Number = Annotated[float, Field(ge=0, le=1e15)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True, strict=True, allow_inf_nan=False)


class SideFacts(_Part):
    """The pulses of one side; what is not known, as of runs made elsewhere, may be missing."""

    file: str | None = None
    used: int | str | None = None  # of runs made elsewhere, it may not be known
    read: int | None = None
    sha256: str | None = None
    cuts: Annotated[CutWindows | None, Field(strict=False)] = None


class FitFacts(_Part):
    """Of a matched response: errors of its parameters, and how they go together."""

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
    """What is wrong with the content of a ``run.json``, in words; empty if nothing is.

    Examples
    --------
    >>> facts = {"recipe": "fast", "peak": "FEP", "seed": 0, "device": "cpu", "seconds": 9.5}
    >>> problem(facts | {"dt_ns": 16}), problem(facts | {"dt_ns": "16"})
    ('', 'dt_ns: Input should be a valid number')
    """
    try:
        found = RunFacts.model_validate(info)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        key = ".".join(map(str, first["loc"]))
        return f"no {key}" if first["type"] == "missing" else f"{key}: {first['msg']}"
    if found.format > FORMAT:
        return f"format {found.format} of a newer version; read it with that one"
    return ""
