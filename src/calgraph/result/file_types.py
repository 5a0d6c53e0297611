"""Types of numbers in calibration.yaml: what is read is checked to be one, and nothing else is converted to it."""

from typing import Annotated

from pydantic import Field, Strict

from calgraph.result.frame_tree import MAX_DISTANCE

Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Strict(), Field(ge=0)]
Positive = Annotated[float, Strict(), Field(gt=0)]
Count = Annotated[int, Strict(), Field(ge=0)]
Flag = Annotated[bool, Strict()]
Distance = Annotated[float, Strict(), Field(ge=-MAX_DISTANCE, le=MAX_DISTANCE, allow_inf_nan=False)]
