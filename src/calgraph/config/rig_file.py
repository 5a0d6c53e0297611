"""Reading rig.yaml."""

from pathlib import Path

from calgraph.config.rig_config import Rig
from calgraph.io.yaml_limits import MAX_RIG_VALUES
from calgraph.io.yaml_reading import read_yaml, validate_content


def load_rig(path: Path | str) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, has more values than any rig needs, or has invalid keys
            or values, each on one line.
    """
    path = Path(path)
    return validate_content(Rig, read_yaml(path, MAX_RIG_VALUES), path)
