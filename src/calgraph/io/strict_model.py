"""The base of all parts of rig.yaml: frozen, and strict about unknown keys."""

from pydantic import AfterValidator, BaseModel, ConfigDict
from pydantic_core import PydanticCustomError


class StrictModel(BaseModel):
    """A frozen settings record that rejects unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


def invalid(key: str, message: str) -> PydanticCustomError:
    """The error for a validator to raise: ``key``, below the part it checks, is invalid because of ``message``."""
    return PydanticCustomError("calgraph", "{message}", {"key": key, "message": message})


def limit_to(limit: float, unit: str) -> AfterValidator:
    """The validator of a number that states its unit: most numbers beyond the limit are in another unit."""

    def check(value: float) -> float:
        if value > limit:
            raise invalid("", f"is in {unit} and must be {limit:g} or less, got {value:g}")
        return value

    return AfterValidator(check)
