"""Base of all settings: types of numbers, and the behaviour of a class of settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, le=1e30)]
NonNegative = Annotated[float, Field(ge=0, le=1e30)]
Millimetres = Annotated[float, Field(ge=0, le=1000)]
# Upper limits are far above any realistic value, but not beyond memory and computing time.
Count = Annotated[int, Field(ge=1, le=100_000_000)]
Samples = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=4096)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class Config(BaseModel):
    """Base of all settings: without unknown keys, with finite numbers, immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    switches: ClassVar[tuple[str, ...]] = ()  # numbers that may be given as true and false

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, values: Any) -> Any:
        """Refuse true and false where a number is expected; they would count as 1 and 0."""
        for name, value in values.items() if isinstance(values, Mapping) else ():
            if isinstance(value, bool) and name in cls.model_fields.keys() - {*cls.switches}:
                kinds = _kinds(cls.model_fields[name].annotation)
                if kinds & {int, float} and bool not in kinds:
                    raise ValueError(f"{name}: Input should be a number, not true or false")
        return values


def _kinds(annotation: Any) -> set[Any]:
    """Types that an annotation such as ``Annotated[float, ...] | None`` allows."""
    parts = get_args(annotation)
    if get_origin(annotation) is Annotated:
        parts = parts[:1]
    return set().union(*map(_kinds, parts)) if parts else {annotation}
