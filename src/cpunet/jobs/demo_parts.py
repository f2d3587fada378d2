"""Parts of an earlier demonstration, kept only if the current options agree with theirs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cpunet.electronics.stand import MARKER, STAND
from cpunet.electronics.stand_plan import StandPlan
from cpunet.errors import CpunetError
from cpunet.outputs import require_replaceable
from cpunet.recipes.schema import Recipe
from cpunet.settings import read_json
from cpunet.training.run import INFO, RUN, Run
from cpunet.validation.report_folder import METRICS, REPORT

# parts in the order of creation, each with a file that exists when it is complete
PARTS = {"stand": MARKER, "run": INFO, "report": METRICS}
_WAY_OUT = "give --force to make all parts anew, or another --out"
_NONE = "none"
_KINDS = {"stand": STAND, "run": RUN, "report": REPORT}


def require_same_parts(out: Path, plan: StandPlan, recipe: Recipe, peak: str) -> None:
    """Raise an error if a part was made with other options, so that no report mixes them.

    Parameters
    ----------
    out
        Folder of the parts; any of them may be missing.
    plan
        Plan of the stand.
    recipe, peak
        Recipe and peak of the training; its seed is that of the stand.

    Raises
    ------
    CpunetError
        If a part was made with other options (the message names the first difference) or
        cannot be read, or if the run's stand is missing.
    """
    stand, run, _ = (out / part for part in PARTS)
    if is_there(out, "stand"):
        wanted = plan.provenance()
        stored = _read_stand(stand)
        _require_same(stand, {key: stored.get(key) for key in wanted}, wanted)
    elif is_there(out, "run"):
        raise CpunetError(f"{run}: its stand is gone; {_WAY_OUT}")
    if is_there(out, "run"):
        made = Run.load(run)
        _require_same(
            run,
            {"peak": made.peak, "seed": made.seed, "recipe": _content(made.recipe)},
            {"peak": peak, "seed": plan.seed, "recipe": _content(recipe)},
        )


def is_there(out: Path, part: str) -> bool:
    """Whether a part exists."""
    return (out / part).exists()


def remove_parts(out: Path) -> None:
    """Remove all parts, or none if something else is in the place of one.

    Raises
    ------
    CpunetError
        If something else is in the place of a part, or a part cannot be removed.
    """
    for part, kind in _KINDS.items():
        require_replaceable(out / part, kind)
    # the stand last, so that an interruption leaves no run without its stand
    for part in reversed(PARTS):
        folder = out / part
        try:
            if folder.exists():
                shutil.rmtree(folder)
        except OSError as error:
            reason = error.strerror or error
            raise CpunetError(f"{folder}: cannot be removed ({reason})") from error


def _read_stand(stand: Path) -> dict[str, Any]:
    return read_json(stand / MARKER, _WAY_OUT)


def _content(recipe: Recipe) -> dict[str, Any]:
    return recipe.model_dump(mode="json")


def _require_same(part: Path, made: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    then, now = dict(_leaves(made)), dict(_leaves(wanted))
    for key in now | then:
        before, after = then.get(key, _NONE), now.get(key, _NONE)
        if before != after:
            raise CpunetError(f"{part}: made with {key} = {before}, not {after}; {_WAY_OUT}")


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Names and JSON values of nested mappings: ``noise.rms_kev``, ``2.5``."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        elif name != "description":  # has no effect
            yield f"{prefix}{name}", json.dumps(value, ensure_ascii=False)
