"""Checkerboards found by calgraph, and by an exhaustive search: recall, errors, time.

python benchmarks/checkerboard_recall.py                   # 500 rendered boards and 100 images without
python benchmarks/checkerboard_recall.py --real            # every image of ../shared/data or CALGRAPH_DATA
python benchmarks/checkerboard_recall.py --show FILE       # the tables of what has been measured

Rendered boards have 5 x 4 to 28 x 17 inner corners, in images of 0.3 to 12 Mpx, with blur, glare, shading,
shadows, noise, JPEG, tilt, fisheyes and clutter. Corners are right if each is within a third of the shortest
distance between corners from the true one. Real images have no true corners: right are those on which two
searches agree.

The exhaustive search takes OpenCV's two detectors, images of 480 pixels to twice their size, and combinations of
flags, until one has the right corners; what calgraph finds counts as found by it. Each image is a row of
``--csv``; those that are there are not measured again. Seconds are of one processor.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

from calgraph.boards.chessboards import CheckerboardFinder
from calgraph.config import Checkerboard
from checkerboard_images import Array, BoardImage, Gray, draw_empty_image, draw_image, measure_shortest_gap
from real_recordings import DATA
from worlds import make_parser, run_worlds

REAL_BOARDS: Final = {
    "acfr-vlp16-checkerboard": (7, 5),
    "acfr-ouster64-few-poses": (7, 5),
    "acfr-rpg-camera-2dlidar": (11, 8),
    "apriltag-images": (7, 5),
}
"""Inner corners of the boards in the images of each folder; there is none in those of tags."""
SIDES: Final = (960, 480, 1920, 640, 1280, 2880)
"""Longer sides of the exhaustive search, px, best first; the full image and twice its size follow."""
MAX_DOUBLED = 2e6
"""Pixels up to which images are searched at twice their size."""
MAX_EXHAUSTIVE = 1280
"""Longer side, px, up to which OpenCV's own exhaustive search is used: it takes ten times as long as the other."""
TOLERANCE = 1 / 3


class Row(NamedTuple):
    """What was measured in one image; seconds of a processor."""

    name: str
    kind: str
    columns: int
    megapixels: float
    has_board: bool
    found: str
    exhaustive: str
    seconds: float
    error: float


def main() -> None:
    """Measures the images that are not in the table, and prints the tables."""
    parser = make_parser(__doc__, jobs=1, path=Path("build/checkerboard_recall.csv"))
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--boards", type=int, default=500)
    parser.add_argument("--empty", type=int, default=100, help="images without the board")
    parser.add_argument("--real", action="store_true", help="real images instead of rendered ones")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    images = _list_real() if arguments.real else _list_rendered(arguments.first, arguments.boards, arguments.empty)
    rows = run_worlds(Row, _measure, list(images), arguments, key=1)
    for title, real in (("rendered", False), ("real", True)):
        chosen = [row for row in rows if row.name.startswith("real") == real]
        if chosen:
            _print_tables(title, chosen, real)


def _list_rendered(first: int, boards: int, empty: int) -> Iterator[tuple[str, Callable[[], BoardImage]]]:
    for seed in range(first, first + boards):
        yield f"board {seed}", partial(draw_image, seed)
    for seed in range(first, first + empty):
        yield f"empty {seed}", partial(draw_empty_image, seed)


def _list_real() -> Iterator[tuple[str, Callable[[], BoardImage]]]:
    for folder, shape in REAL_BOARDS.items():
        paths = sorted(path for path in (DATA / folder).rglob("*") if path.suffix in {".png", ".jpg"})
        for path in paths:
            yield f"real {path.relative_to(DATA)}", partial(_read_image, path, folder, shape)


def _read_image(path: Path, folder: str, shape: tuple[int, int]) -> BoardImage:
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise OSError(f"{path} is not an image")
    image = np.asarray(gray, dtype=np.uint8)
    return BoardImage(image, folder, shape, _agree(image, shape))


def _agree(gray: Gray, shape: tuple[int, int]) -> Array | None:
    """Corners (rows, columns, 2) that two searches found."""
    found: list[Array] = []
    for corners in _search_exhaustively(gray, shape):
        if any(_is_right(corners, other, any_turn=True) for other in found):
            return corners
        found.append(corners)
    return None


def _measure(name: str, make: Callable[[], BoardImage]) -> Row:
    image = make()
    columns, rows = image.shape
    pattern = Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=0.05)
    seconds, found = _time(CheckerboardFinder(pattern), image.gray)
    verdict = _judge(found, image)
    exhaustive = verdict if image.corners is not None else "missed"
    if image.corners is not None and verdict != "right":
        tries = _search_exhaustively(image.gray, image.shape)
        hit = any(_is_right(corners, image.corners, any_turn=True) for corners in tries)
        exhaustive = "right" if hit else "missed"
    error = np.nan
    if verdict == "right" and found is not None and image.corners is not None:
        turns = (image.corners, image.corners[::-1, ::-1])
        error = min(float(np.sqrt(((found - turn) ** 2).sum(axis=-1).mean())) for turn in turns)
    size, has_board = image.gray.size / 1e6, image.corners is not None
    return Row(name, image.kind, columns, size, has_board, verdict, exhaustive, seconds, error)


def _time(finder: CheckerboardFinder, gray: Gray) -> tuple[float, Array | None]:
    """Seconds of a processor, and corners (rows, columns, 2), NaN where they are hidden."""
    began = time.process_time()
    marks = finder.find(gray)
    seconds = time.process_time() - began
    corners = np.full((finder.pattern.rows * finder.pattern.columns, 2), np.nan)
    corners[marks.ids] = marks.pixels[:, 0]
    return seconds, corners.reshape(finder.pattern.rows, finder.pattern.columns, 2) if len(marks) else None


def _judge(found: Array | None, image: BoardImage) -> str:
    if found is None:
        return "missed"
    if image.corners is None:
        return "wrong"
    # Real corners have any orientation, those of rendered boards the print's, which is known if a half turn swaps
    # its colours.
    any_turn = image.kind in REAL_BOARDS or sum(image.shape) % 2 == 0
    return "right" if _is_right(found, image.corners, any_turn) else "wrong"


def _is_right(found: Array, true: Array, any_turn: bool) -> bool:
    """Whether corners (rows, columns, 2) are the true ones, or these from the other ends."""
    tolerance = TOLERANCE * measure_shortest_gap(true)
    turns = [true, true[::-1, ::-1], true[::-1], true[:, ::-1]] if any_turn else [true]
    return any(bool(np.nanmax(np.linalg.norm(found - turn, axis=-1)) < tolerance) for turn in turns)


def _search_exhaustively(gray: Gray, shape: tuple[int, int]) -> Iterator[Array]:
    """Corners (rows, columns, 2) of every search that finds some."""
    scales = [side / max(gray.shape) for side in SIDES if side < max(gray.shape)] + [1.0]
    scales += [2.0] if gray.size <= MAX_DOUBLED else []
    normalise, exhaustive = (0, cv2.CALIB_CB_NORMALIZE_IMAGE), (0, cv2.CALIB_CB_EXHAUSTIVE)
    for more, scale, flag in product(exhaustive, scales, normalise):
        if more and scale * max(gray.shape) > MAX_EXHAUSTIVE:
            continue
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=way)
        cv2.setRNGSeed(0)
        searches = [cv2.findChessboardCornersSB(small, shape, flags=flag | more)]
        if not more and scale <= 1:
            searches.append(cv2.findChessboardCorners(small, shape, flags=flag | cv2.CALIB_CB_ADAPTIVE_THRESH))
        for found, corners in searches:
            if found:
                ratio = np.array(gray.shape[::-1]) / small.shape[::-1]
                places = np.reshape(corners, (shape[1], shape[0], 2)).astype(np.float64)
                yield np.asarray((places + 0.5) * ratio - 0.5)


def _print_tables(title: str, rows: Sequence[Row], real: bool) -> None:
    """Prints recall by class, detections that are wrong, and times."""
    boards, empty = [row for row in rows if row.has_board], [row for row in rows if not row.has_board]
    print(f"\n{title}: boards found of those that are there; wrong ones; exhaustive counts what calgraph finds")
    print(f"{'':26}{'images':>7}{'found':>7}{'exhaustive':>12}{'recall':>8}{'wrong':>7}")
    for name, chosen in _classify(boards, real).items():
        found, exhaustive = (
            sum(getattr(row, one) == "right" for row in chosen) for one in ("found", "exhaustive")
        )
        wrong = sum(row.found == "wrong" for row in chosen)
        print(f"{name:26}{len(chosen):7}{found:7}{exhaustive:12}{found / max(exhaustive, 1):8.3f}{wrong:7}")
    print(f"{'':26}{'images':>7}{'wrong':>7}{'seconds':>9}")
    groups: Mapping[str, Sequence[Row]] = {"with board": boards, "without": empty, "all": rows}
    for name, chosen in groups.items():
        wrong = sum(row.found == "wrong" for row in chosen)
        print(f"{name:26}{len(chosen):7}{wrong:7}{sum(row.seconds for row in chosen):9.2f}")
    if not real:
        errors = [row.error for row in boards if row.found == "right"]
        print(
            f"RMS error of corners: median {np.median(errors):.3f} px, "
            f"95 % below {np.quantile(errors, 0.95):.3f} px"
        )


def _classify(rows: Sequence[Row], real: bool) -> Mapping[str, Sequence[Row]]:
    """Rows by class; a row is in several."""
    classes: dict[str, Sequence[Row]] = {"all": rows}
    if not real:
        for low, high in ((5, 8), (9, 14), (18, 24), (26, 28)):
            classes[f"{low} to {high} columns"] = [row for row in rows if low <= row.columns <= high]
        for least, most in ((0, 1), (1, 3), (3, 6), (6, 13)):
            classes[f"{least} to {most} Mpx"] = [row for row in rows if least <= row.megapixels < most]
    for kind in dict.fromkeys(row.kind for row in rows):
        classes[kind] = [row for row in rows if row.kind == kind]
    return classes


if __name__ == "__main__":
    main()
