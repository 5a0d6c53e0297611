"""Git LFS pointers: short texts in place of large files that were not fetched."""

from pathlib import Path

from calgraph.errors import InputError

# Source: "Git LFS Specification", git-lfs/docs/spec.md.
_MARK = b"version https://git-lfs.github.com/spec/"
POINTER_START = len(_MARK)
"""Number of bytes at the start of a file that show whether it is a pointer."""


def check_git_lfs(path: Path, start: bytes, error: type[InputError] = InputError) -> None:
    """Refuses a Git LFS pointer.

    Args:
        path: the file, as the message names it.
        start: its first bytes, :data:`POINTER_START` or more.
        error: type of the exception.

    Raises:
        InputError: the file is a pointer.
    """
    if start.startswith(_MARK):
        raise error(f"{path}: is a Git LFS pointer, not the file itself; run `git lfs pull` in its repository")
