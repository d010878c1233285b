"""What all settings have in common."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Phase = Literal["stance", "pre_swing", "swing", "loading_response"]
PHASE_ORDER: tuple[Phase, ...] = ("stance", "pre_swing", "swing", "loading_response")
Foot = Literal["left_foot", "right_foot"]
SensorName = Literal["left_foot", "right_foot", "left_shank", "right_shank"]

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class ConfigError(ValueError):
    """The session file cannot be used; the message says where and what would be right."""


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error, not a silent typo, and so is ``"3"`` for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)
