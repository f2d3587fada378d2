"""What all settings share: kinds of numbers, and how a class of settings behaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, le=1e30)]
NonNegative = Annotated[float, Field(ge=0, le=1e30)]
Millimetres = Annotated[float, Field(ge=0, le=1000)]
# Far beyond what anyone needs, and not yet what no machine can hold or live to see.
Count = Annotated[int, Field(ge=1, le=100_000_000)]
Samples = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=4096)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class Config(BaseModel):
    """Base of all settings: unknown keys are refused, numbers finite, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    switches: ClassVar[tuple[str, ...]] = ()  # numbers that may be given as true and false

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, values: Any) -> Any:
        """Refuse true and false where a number is meant, which would count as 1 and 0."""
        for name, value in values.items() if isinstance(values, Mapping) else ():
            if isinstance(value, bool) and name in cls.model_fields.keys() - {*cls.switches}:
                kind = cls.model_fields[name].annotation
                if kind in (int, float) or kind in (int | None, float | None):
                    raise ValueError(f"{name}: Input should be a number, not true or false")
        return values
