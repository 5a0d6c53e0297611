"""Damage of files: what disks, copies, version control and people do to recordings."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

Damage = Callable[[Path, np.random.Generator], Path]
"""Damages the recording at a path, and gives the path that is calibrated then."""
_LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:{}\nsize 123456\n"
_BLOCK = 4096


def files_of(path: Path) -> Sequence[Path]:
    """The files of a recording."""
    return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())


def choose_files(path: Path, rng: np.random.Generator) -> Sequence[Path]:
    """The files to damage: the storage of a bag, and a random number of the files of a plain folder."""
    files = [file for file in files_of(path) if file.name != "metadata.yaml"]
    if len(files) == 1:
        return files
    count = int(np.exp(rng.uniform(0, np.log(len(files)))))
    return [files[i] for i in rng.permutation(len(files))[:count]]


def replace_bytes(file: Path, data: bytes) -> None:
    """Writes a new file: the old one may be a link to that of other runs."""
    file.unlink()
    file.write_bytes(data)


def _each(change: Callable[[bytes, np.random.Generator], bytes]) -> Damage:
    """Changes the bytes of the chosen files."""

    def damage(path: Path, rng: np.random.Generator) -> Path:
        for file in choose_files(path, rng):
            replace_bytes(file, change(file.read_bytes(), rng))
        return path

    return damage


def _truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _truncate_end(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: -int(rng.integers(1, min(len(data), 300)))]


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    """One to 10,000 bytes become random ones."""
    changed = np.frombuffer(data, np.uint8).copy()
    at = rng.integers(len(changed), size=int(10 ** rng.uniform(0, 4)))
    changed[at] = rng.integers(256, size=len(at))
    return changed.tobytes()


def _flip_head(data: bytes, rng: np.random.Generator) -> bytes:
    """One to ten of the first 200 bytes become random ones, where formats state sizes."""
    changed = np.frombuffer(data, np.uint8).copy()
    at = rng.integers(min(200, len(changed)), size=int(rng.integers(1, 11)))
    changed[at] = rng.integers(256, size=len(at))
    return changed.tobytes()


def _block(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    size = min(_BLOCK * int(rng.integers(1, 17)), len(data) // 2)
    return int(rng.integers(len(data) - size + 1)), size


def _zero_block(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _block(data, rng)
    return data[:at] + bytes(size) + data[at + size :]


def _remove_block(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _block(data, rng)
    return data[:at] + data[at + size :]


def _insert_block(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _block(data, rng)
    return data[:at] + rng.bytes(size) + data[at:]


def _swap_blocks(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _block(data, rng)
    to = int(rng.integers(len(data) - size + 1))
    changed = bytearray(data)
    changed[at : at + size], changed[to : to + size] = data[to : to + size], data[at : at + size]
    return bytes(changed)


def _append(data: bytes, rng: np.random.Generator) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 100_000)))


def _remove_files(path: Path, rng: np.random.Generator) -> Path:
    files = choose_files(path, rng) if len(files_of(path)) > 2 or rng.random() < 0.5 else files_of(path)[-1:]
    for file in files:
        file.unlink()
    return path


def _make_folders(path: Path, rng: np.random.Generator) -> Path:
    for file in choose_files(path, rng):
        file.unlink()
        file.mkdir()
    return path


def _rename(path: Path, rng: np.random.Generator) -> Path:
    """The files have the suffix of another format."""
    suffixes = [".mcap", ".db3", ".bag", ".png", ".npz", ".csv", ".pcd", ".txt"]
    changed = path
    for file in choose_files(path, rng):
        other = str(rng.choice([suffix for suffix in suffixes if suffix != file.suffix]))
        moved = file.rename(file.with_name(file.name.removesuffix(file.suffix) + other))
        changed = moved if file == path else changed
    return changed


def _break_links(path: Path, rng: np.random.Generator) -> Path:
    """Symbolic links to nothing, or to themselves."""
    for file in choose_files(path, rng):
        file.unlink()
        file.symlink_to(file.name if rng.random() < 0.5 else "nothing")
    return path


def _spoil_metadata(path: Path, rng: np.random.Generator) -> Path:
    """What describes the recording contradicts it: metadata.yaml of a bag, camera_info.yaml, or a foreign one."""
    found = [file for file in files_of(path) if file.name in ("metadata.yaml", "camera_info.yaml")]
    if not found:
        folder = path.parent / "bag"
        folder.mkdir()
        path.rename(folder / path.name)
        (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [other.bag]}\n")
        return folder
    text = found[0].read_text()
    lines = text.splitlines()
    at = int(rng.integers(len(lines)))
    match int(rng.integers(6)):
        case 0:
            lines[at] = lines[at].partition(":")[0] + ": [1, {"
        case 1:
            del lines[at]
        case 2:
            lines = [line.replace("count: ", "count: 9") for line in lines]
        case 3:
            lines = [line.replace("sensor_msgs/msg/", "std_msgs/msg/").replace("K: [", "K: [-") for line in lines]
        case 4:
            lines = lines[:at]
        case _:
            lines = [line.replace("mcap", "sqlite3").replace("db3", "mcap").replace("0.", "9") for line in lines]
    replace_bytes(found[0], "\n".join(lines).encode())
    return path


def _replace_whole(path: Path, rng: np.random.Generator) -> Path:
    """An empty folder, a folder of other files, or one text file."""
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    match int(rng.integers(3)):
        case 0:
            path.mkdir()
        case 1:
            path.mkdir()
            (path / "notes.txt").write_text("recorded on Monday\n")
        case _:
            path.write_text("recorded on Monday\n")
    return path


FILE_DAMAGE: Mapping[str, Damage] = {
    "none": lambda path, _: path,
    "cut off anywhere": _each(_truncate),
    "last bytes missing": _each(_truncate_end),
    "1 to 10,000 bytes changed": _each(_flip),
    "bytes of headers changed": _each(_flip_head),
    "a block of zeros": _each(_zero_block),
    "a block missing": _each(_remove_block),
    "a block inserted": _each(_insert_block),
    "two blocks interchanged": _each(_swap_blocks),
    "random bytes appended": _each(_append),
    "files of 0 bytes": _each(lambda *_: b""),
    "zeros in full length": _each(lambda data, _: bytes(len(data))),
    "Git LFS pointers": _each(lambda data, _: _LFS.format(f"{len(data):064x}").encode()),
    "files missing": _remove_files,
    "folders in place of files": _make_folders,
    "suffix of another format": _rename,
    "broken symbolic links": _break_links,
    "metadata that contradict": _spoil_metadata,
    "something else": _replace_whole,
}
