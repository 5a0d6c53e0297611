"""Contents of the files of a result that do not depend on the command and the time of its computation."""

import re
from pathlib import Path

_PROVENANCE = re.compile(rb"\nprovenance:\n.*|<details><summary>Provenance</summary>.*?</details>", re.DOTALL)


def read_without_provenance(path: Path) -> bytes:
    """The content of calibration.yaml, report.html or another file of a result, without its provenance."""
    return path.read_bytes() if path.suffix == ".npz" else _PROVENANCE.sub(b"", path.read_bytes())
