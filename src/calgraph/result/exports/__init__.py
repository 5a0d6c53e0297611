"""A calibration in the formats of other programs."""

from calgraph.result.exports.formats import FORMATS, Parents, export
from calgraph.result.exports.json_text import to_json

__all__ = ["FORMATS", "Parents", "export", "to_json"]
