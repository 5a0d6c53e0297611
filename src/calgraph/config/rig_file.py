"""Reading rig.yaml."""

from pathlib import Path

from calgraph.config.rig_config import Rig
from calgraph.io.yaml_reading import read_yaml, validated


def load_rig(path: Path) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, or has wrong keys or values, each named on its own line.

    """
    return validated(Rig, read_yaml(path), path)
