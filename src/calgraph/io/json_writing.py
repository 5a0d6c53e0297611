"""Plain values and arrays as JSON."""

import json
import math
from typing import Any

import numpy as np


def format_json(content: Any, indent: int | None = None) -> str:
    """Mappings, sequences, arrays and scalars as JSON; NaN and infinities, which JSON lacks, become null."""
    return json.dumps(_to_plain(content), ensure_ascii=False, allow_nan=False, indent=indent)


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _to_plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_to_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
