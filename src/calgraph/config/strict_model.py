"""The base of all parts of rig.yaml: frozen, and strict about unknown keys."""

from pydantic import BaseModel, ConfigDict
from pydantic_core import PydanticCustomError


class StrictModel(BaseModel):
    """A frozen settings record that rejects unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def invalid(key: str, message: str) -> PydanticCustomError:
    """The error for a validator to raise: ``key``, below the part it checks, is invalid because of ``message``."""
    return PydanticCustomError("calgraph", "{message}", {"key": key, "message": message})
