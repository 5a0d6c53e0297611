"""Reading rig.yaml."""

from pathlib import Path

from calgraph.rig.reading import read_yaml, validated
from calgraph.rig.rig import Rig


def load_rig(path: Path) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, or has wrong keys or values, each named on its own line.

    """
    return validated(Rig, read_yaml(path), path)
