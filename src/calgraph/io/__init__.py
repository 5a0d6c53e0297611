"""Files: atomic writes, YAML, archives of arrays."""

from calgraph.io.atomic import check_place, replacing, replacing_folder, write_text
from calgraph.io.yaml_writing import save_yaml, yaml_text

__all__ = ["check_place", "replacing", "replacing_folder", "save_yaml", "write_text", "yaml_text"]
