"""Draws docs/images/calibration.gif: `PYTHONPATH=benchmarks python docs/animation.py`, which takes two minutes.

A rig of five sensors is simulated, and calibrated from the captures so far after each of them: poses, standard
deviations and verdicts are those of calgraph. Frames are drawn as SVG, and rendered by Chromium.
"""

import io
import shutil
from dataclasses import dataclass, replace

import numpy as np
from pictures import BAD, BOARD, GOOD, IMAGES, INK, disc, line, shape, svg, text
from PIL import Image as Picture
from playwright.sync_api import sync_playwright

import calgraph
from calgraph.geometry import Array, se3, so3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from ideal_detections import simulate_detections

SCENARIO = RigScenario(
    camera=CameraOptions(count=2),
    laser=LaserOptions(count=2),
    multibeam=MultibeamOptions(count=1),
    spinning=SpinningOptions(count=0),
    bearings=(-45, -30, -15, 0, 15, 30, 45),
    radii=(2.4, 1.7),
    samples=2,
)
SEED = 3
COLORS = {
    "lidar": "#1f6fb2",
    "laser_front": "#8a4fae",
    "laser_left": "#b5477d",
    "camera": "#0c8a7b",
    "camera_2": "#5b8c1a",
}
"""By sensor, in the order of the table."""
GRADES = {"good": GOOD, "weak": BOARD, "unobservable": BAD}
WIDTH, HEIGHT = 880, 430
PANEL = 560
"""Where the table begins, pixels."""
EYE, TARGET, FOCAL = np.array([-3.0, 2.0, 2.3]), np.array([1.1, -0.1, -0.1]), 560.0
GROUND = -0.8
ENLARGED = 30
"""By how much ellipses are larger than the standard deviations."""


@dataclass(frozen=True, eq=False)
class Stage:
    """What is known after some captures."""

    captures: int
    T_root_sensor: dict[str, Array]
    covariance: dict[str, Array]
    grade: dict[str, str]


def first_captures(captured: CaptureSet, count: int) -> CaptureSet:
    """The detections of the first captures."""
    return replace(
        captured,
        holds=captured.holds[:count],
        detections={
            name: {k: found for k, found in own.items() if k < count} for name, own in captured.detections.items()
        },
        rejections={key: reason for key, reason in captured.rejections.items() if key[0] < count},
    )


def calibrate_first(rig: calgraph.Rig, captured: CaptureSet, count: int) -> Stage:
    """The calibration from the first captures; without poses where these do not suffice."""
    root = {rig.root: np.eye(4)}
    nothing = Stage(count, root, {}, {rig.root: "root"})
    try:
        options = calgraph.RigOptions(folds=0)
        problem = calgraph.build_problem_from_captures(
            rig, first_captures(captured, count), options, np.random.default_rng(0)
        )
        calibration = calgraph.solve_problem(problem)
    except calgraph.CalgraphError:
        return nothing
    known = [one for one in calibration.sensors if one.name != rig.root and np.isfinite(one.covariance).all()]
    return Stage(
        count,
        root | {one.name: one.T_root_sensor for one in known},
        {one.name: one.covariance for one in known},
        nothing.grade | {one.name: one.verdict.grade for one in known},
    )


def project(points: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) in the root's frame."""
    ahead = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    in_view = (np.asarray(points) - EYE) @ np.stack([right, down, ahead], axis=1)
    return in_view[..., :2] / in_view[..., 2:] * FOCAL + np.array([PANEL / 2, 235])


def polygon(points: Array, fill: str, more: str = "") -> str:
    """A filled polygon in space."""
    return shape([(float(x), float(y)) for x, y in project(points)], fill, more)


def polyline(points: Array, color: str, width: float = 1.5, more: str = "") -> str:
    """A line in space."""
    return line([(float(x), float(y)) for x, y in project(points)], color, width, more)


def box(low: Array, high: Array, fill: tuple[str, str, str]) -> list[str]:
    """The back, left and top faces of a box, as visible from behind, from the left and from above."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    back = [(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)]
    left = [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)]
    top = [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)]
    return [polygon(np.array(face, float), color) for face, color in zip((left, back, top), fill, strict=True)]


def floor() -> list[str]:
    """A grid of metres."""
    lines = [np.array([[x, -2.5, GROUND], [x, 2.5, GROUND]]) for x in np.arange(-1, 4.1)]
    lines += [np.array([[-1, y, GROUND], [4, y, GROUND]]) for y in np.arange(-2.5, 2.6)]
    return [polyline(one, "#e4e4e4", 1) for one in lines]


def robot() -> list[str]:
    """Body, wheels and mast."""
    wheels = []
    for x in (-0.15, 0.5):
        a = np.linspace(0, 2 * np.pi, 30)
        rim = np.stack([x + 0.16 * np.cos(a), np.full(30, 0.36), GROUND + 0.16 + 0.16 * np.sin(a)], axis=1)
        wheels.append(polygon(rim, "#444"))
    body = box(np.array([-0.4, -0.33, -0.66]), np.array([0.72, 0.33, -0.25]), ("#b9bec4", "#a4aab1", "#d3d7db"))
    mast = box(np.array([-0.05, -0.05, -0.25]), np.array([0.05, 0.05, -0.06]), ("#999", "#888", "#aaa"))
    return [*body, *wheels, *mast]


def board(T_root_board: Array, face: bool = True) -> list[str]:
    """The board with its three tags; only its outline where it was before."""
    target = SCENARIO.board

    def corners(width: float, height: float, center: tuple[float, float] = (0.0, 0.0)) -> Array:
        x, y = np.array([-1, 1, 1, -1]) * width / 2 + center[0], np.array([-1, -1, 1, 1]) * height / 2 + center[1]
        return np.asarray(se3.apply(T_root_board, np.stack([x, y, np.zeros(4)], axis=1)))

    outline = corners(*target.size)
    if not face:
        return [polygon(outline, BOARD, f'fill-opacity="0.07" stroke="{BOARD}" stroke-opacity="0.55"')]
    tags = [polygon(corners(tag.size, tag.size, tag.center), "#222") for tag in target.tags]
    return [polygon(outline, "#fff", f'stroke="{BOARD}" stroke-width="3"'), *tags]


def operator(T_root_board: Array) -> list[str]:
    """Who holds the board, behind it."""
    behind = T_root_board[:2, 3] * (1 + 0.35 / np.linalg.norm(T_root_board[:2, 3]))
    feet, neck, head = project(np.array([[*behind, GROUND], [*behind, 0.55], [*behind, 0.78]]))
    scale = float(feet[1] - neck[1])
    return [
        f'<ellipse cx="{feet[0]:.1f}" cy="{feet[1]:.1f}" rx="{0.2 * scale:.1f}" ry="{0.09 * scale:.1f}" '
        'fill="#e8e8e8"/>',
        line([(feet[0], feet[1]), (neck[0], neck[1])], "#c9c4bb", 0.22 * scale, 'stroke-linecap="round"'),
        disc(float(head[0]), float(head[1]), 0.1 * scale, "#b3ada3"),
    ]


def sensor(T_root_sensor: Array, name: str) -> list[str]:
    """A camera as a pyramid, a scanner as a disc with its axis."""
    color, at = COLORS[name], T_root_sensor
    if name.startswith("camera"):
        x, y, z = 0.11, 0.08, 0.16
        rim = se3.apply(at, np.array([[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]]))
        origin = at[:3, 3]
        sides = [polyline(np.stack([origin, corner]), color, 2) for corner in rim]
        return [polygon(rim, color, 'fill-opacity="0.35"'), polyline(np.vstack([rim, rim[:1]]), color, 2), *sides]
    a = np.linspace(0, 2 * np.pi, 40)
    x, y = 0.09 * np.cos(a), 0.09 * np.sin(a)
    rings = [se3.apply(at, np.stack([x, y, np.full(40, z)], axis=1)) for z in (-0.05, 0.05)]
    ahead = se3.apply(at, np.array([[0, 0, 0.05], [0.2, 0, 0.05]]))
    return [polygon(rings[0], color), polygon(rings[1], color, 'stroke="#fff"'), polyline(ahead, color, 3)]


def ellipse(T_root_sensor: Array, covariance: Array, color: str) -> str:
    """Standard deviations of the position, enlarged, as they appear from here."""
    at, step = T_root_sensor[:3, 3], 1e-4
    J = np.stack([(project(at + step * e) - project(at - step * e)) / (2 * step) for e in np.eye(3)], axis=1)
    values, vectors = np.linalg.eigh(J @ covariance[:3, :3] @ J.T)
    radii = np.minimum(ENLARGED * np.sqrt(values), 120)
    (x, y), turn = project(at), np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    return (
        f'<ellipse cx="{x:.1f}" cy="{y:.1f}" rx="{radii[1]:.1f}" ry="{radii[0]:.1f}" fill="{color}" '
        f'fill-opacity="0.2" stroke="{color}" transform="rotate({turn:.1f} {x:.1f} {y:.1f})"/>'
    )


def measured(captured: CaptureSet, stage: Stage, capture: int) -> list[str]:
    """Points of the scanners on the board, by the poses known so far."""
    parts = []
    for name, T_root_sensor in stage.T_root_sensor.items():
        for found in captured.detections[name].get(capture, ())[:1]:
            if isinstance(found, calgraph.PlanePatch | calgraph.Segment):
                points = se3.apply(T_root_sensor, found.ranges[:, None] * found.directions)
                kept = points[:: max(1, len(points) // 120)]
                parts += [disc(float(x), float(y), 1.8, COLORS[name]) for x, y in project(kept)]
    return parts


def row(k: int, name: str, stage: Stage) -> list[str]:
    """A sensor in the table."""
    y, grade = 118 + 46 * k, stage.grade.get(name, "")
    color = INK if name in stage.T_root_sensor else "#aaa"
    parts = [disc(PANEL + 14, y - 5, 7, COLORS[name] if name in stage.T_root_sensor else "#ddd")]
    parts.append(text(PANEL + 30, y, name, color, "start"))
    if grade == "root":
        return [*parts, text(WIDTH - 24, y, "root", "#777", "end")]
    if not grade:
        return [*parts, text(WIDTH - 24, y, "no pose yet", "#aaa", "end")]
    sigma = 1000 * np.sqrt(np.linalg.eigvalsh(stage.covariance[name][:3, :3])[-1])
    number = f"{sigma:.1f}" if sigma < 9.95 else f"{sigma:.0f}"
    return [
        *parts,
        text(PANEL + 190, y, f"{number} mm" if sigma < 1000 else "&gt; 1 m", INK, "end"),
        text(WIDTH - 24, y, grade, GRADES[grade], "end"),
    ]


def frame(
    captured: CaptureSet, boards: list[Array], stage: Stage, T_root_board: Array | None, held: int | None
) -> str:
    """One picture: the scene and the table."""
    total, done = len(boards), sum(grade == "good" for grade in stage.grade.values()) == len(COLORS) - 1
    headline = (
        "A board is carried around the robot" if len(stage.grade) == 1
        else "Poses appear, with standard deviations" if not done
        else "All poses good: within 10 mm and 0.3° (95 %)"
    )  # fmt: skip
    parts = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>', *floor()]
    earlier = range(stage.captures if held is None else held)
    behind = sorted(earlier, key=lambda k: -float(np.linalg.norm(boards[k][:3, 3] - EYE)))
    parts += [part for k in behind for part in board(boards[k], face=False)]
    if T_root_board is not None:
        parts += [*operator(T_root_board), *board(T_root_board)]
    if held is not None:
        parts += measured(captured, stage, held)
    parts += robot()
    for name, T_root_sensor in stage.T_root_sensor.items():
        if name in stage.covariance:
            parts.append(ellipse(T_root_sensor, stage.covariance[name], COLORS[name]))
        parts += sensor(T_root_sensor, name)
    parts.append(f'<rect x="{PANEL - 18}" width="{WIDTH - PANEL + 18}" height="{HEIGHT}" fill="#f6f7f8"/>')
    parts.append(f'<text x="20" y="34" font-size="19" font-weight="bold">{headline}</text>')
    parts.append(text(PANEL + 190, 76, "σ of position", "#777", "end"))
    parts.append(text(WIDTH - 24, 76, "verdict", "#777", "end"))
    parts += [part for k, name in enumerate(COLORS) for part in row(k, name, stage)]
    length, share, color = WIDTH - PANEL - 26, stage.captures / total, GOOD if done else BOARD
    parts += [
        f'<rect x="{PANEL}" y="362" width="{length}" height="8" rx="4" fill="#ddd"/>',
        f'<rect x="{PANEL}" y="362" width="{length * share:.0f}" height="8" rx="4" fill="{color}"/>',
        text(PANEL, 394, f"capture {stage.captures} of {total}", INK, "start"),
        text(20, HEIGHT - 16, f"simulated rig; ellipses: σ × {ENLARGED}", "#999", "start"),
    ]
    return svg(WIDTH, HEIGHT, parts).replace('font-size="13"', 'font-size="15"', 1)


def between(first: Array, second: Array, share: float) -> Array:
    """The board on its way from one pose to the next."""
    turn = so3.log(first[:3, :3].T @ second[:3, :3])
    return se3.pose(first[:3, :3] @ so3.exp(share * turn), (1 - share) * first[:3, 3] + share * second[:3, 3])


def draw_frames(captured: CaptureSet, boards: list[Array], stages: list[Stage]) -> list[tuple[str, int]]:
    """All pictures, with how long each is shown, ms."""
    frames = []
    for k, T_root_board in enumerate(boards):
        if k:
            moving = between(boards[k - 1], T_root_board, 0.5)
            frames.append((frame(captured, boards, stages[k - 1], moving, None), 100))
        frames.append((frame(captured, boards, stages[k], T_root_board, k), 280))
    return [*frames, (frame(captured, boards, stages[-1], None, None), 3500)]


def render(frames: list[tuple[str, int]]) -> None:
    """Writes the GIF: one palette for all pictures."""
    pictures = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        for content, _ in frames:
            page.set_content(f'<body style="margin:0">{content}</body>')
            pictures.append(Picture.open(io.BytesIO(page.screenshot())).convert("RGB"))
        browser.close()
    # One palette for all: the colours of the drawing, and what anti-aliasing makes of them in some pictures.
    samples = Picture.new("RGB", (WIDTH, 5 * HEIGHT))
    for k, one in enumerate(pictures[:: max(1, len(pictures) // 4)][:4]):
        samples.paste(one, (0, k * HEIGHT))
    for k, color in enumerate([*COLORS.values(), *GRADES.values(), INK]):
        samples.paste(color, (k * WIDTH // 9, 4 * HEIGHT, (k + 1) * WIDTH // 9, 5 * HEIGHT))
    palette = samples.quantize(96)
    first, *others = [one.quantize(palette=palette, dither=Picture.Dither.NONE) for one in pictures]
    first.save(
        IMAGES / "calibration.gif",
        save_all=True,
        append_images=others,
        duration=[duration for _, duration in frames],
        loop=0,
        optimize=True,
    )


def main() -> None:
    """Simulates, calibrates and draws."""
    rig, captured, truth = simulate_detections(build_world(SCENARIO, SEED), SEED)
    boards = [one.T_root_board for one in truth.boards]
    stages = [calibrate_first(rig, captured, count) for count in range(1, len(boards) + 1)]
    render(draw_frames(captured, boards, stages))


if __name__ == "__main__":
    main()
