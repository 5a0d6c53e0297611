"""Files: atomic writes, YAML, archives of arrays."""

from calgraph.io.atomic import (
    check_output_path,
    follow_links,
    make_temporary_folder,
    remove_temporary_folder,
    replace_folder_atomically,
    temporary_folder,
    write_atomically,
    write_text,
)
from calgraph.io.json_writing import format_json
from calgraph.io.yaml_writing import format_yaml, save_yaml

__all__ = [
    "check_output_path", "follow_links", "format_json", "format_yaml", "make_temporary_folder",
    "remove_temporary_folder", "replace_folder_atomically",
    "save_yaml", "temporary_folder", "write_atomically", "write_text",
]  # fmt: skip
