"""Reading and writing rig.yaml."""

import math
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from calgraph.rig.atomic import replacing
from calgraph.rig.reading import read_yaml, validated
from calgraph.rig.rig import Rig


def load_rig(path: Path) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, or has wrong keys or values, each named on its own line.

    """
    return validated(Rig, read_yaml(path), path)


def save_yaml(path: Path, content: dict[str, Any]) -> None:
    """Writes plain values as YAML, short lists on one line, in one step."""
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.default_flow_style = None
    yaml.width = 200
    yaml.allow_unicode = True
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        yaml.dump(content, file)


class _Representer(RoundTripRepresenter):
    """Writes 0.000001 as 1.0e-06: readers of YAML 1.1 (ROS) take ruamel's 1e-06 for a text."""

    def represent_number(self, value: float) -> ScalarNode:
        text = {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan" if math.isnan(value) else repr(value))
        if "e" in text and "." not in text:
            text = text.replace("e", ".0e")
        node: ScalarNode = self.represent_scalar("tag:yaml.org,2002:float", text)
        return node


_Representer.add_representer(float, _Representer.represent_number)
