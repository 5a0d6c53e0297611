"""Draws the packages of the source in layers from the import contract in pyproject.toml: `python docs/house.py`.

Each package may import those below it; packages on one line do not import each other. The picture is
docs/images/house.svg.
"""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PURPOSE = {
    "cli": "commands",
    "fleet": "many robots, drift over time",
    "live": "sources, recorder, phone page",
    "simulation": "ground truth",
    "calibration": "dispatch, result files",
    "rig": "a robot with a board",
    "network": "scanners and people",
    "drive": "LiDARs that share no view",
    "report": "page of a result",
    "printing": "boards on paper",
    "viewer": "3-D in the browser",
    "verdict": "grades, tests of parameters, comparison with given poses",
    "boards": "printed boards and their detections",
    "graph": "pairs, pose graphs, trees",
    "surfaces": "flat cells, trajectories",
    "solver": "Levenberg–Marquardt, RANSAC, marginalisation",
    "parallel": "this process, processes of this machine, Dask",
    "recording": "bags, folders: streams of messages",
    "result": "Calibration, its files and exports",
    "config": "rig.yaml and settings",
    "sensors": "kinds of sensors, their messages, camera models",
    "io": "atomic files, YAML, archives",
    "geometry": "poses, planes",
    "errors": "exceptions, Rejected",
}
WIDTH, HEIGHT, GAP = 860, 44, 8


def layers() -> list[list[str]]:
    """The packages, from the top layer down, as the import contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    house = next(contract for contract in contracts if contract["type"] == "layers")
    return [[room.strip() for room in line.split("|")] for line in house["layers"]]


def room(x: float, y: float, width: float, name: str) -> str:
    """One package: a box with its name and purpose."""
    middle = x + width / 2
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{HEIGHT}" rx="4" fill="#eef3f7" '
        f'stroke="#51708a"/>\n<text x="{middle:.1f}" y="{y + 18:.1f}" font-weight="bold">{name}</text>\n'
        f'<text x="{middle:.1f}" y="{y + 35:.1f}" font-size="12" fill="#444">{PURPOSE[name]}</text>'
    )


def house() -> str:
    """The picture as SVG."""
    parts = []
    for floor, rooms in enumerate(layers()):
        width = (WIDTH - GAP * (len(rooms) + 1)) / len(rooms)
        y = GAP + floor * (HEIGHT + GAP)
        parts += [room(GAP + i * (width + GAP), y, width, name) for i, name in enumerate(rooms)]
    height = GAP + len(layers()) * (HEIGHT + GAP)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
        'font-family="sans-serif" font-size="14" text-anchor="middle" fill="#222">\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


if __name__ == "__main__":
    (ROOT / "docs/images/house.svg").write_text(house(), encoding="utf-8")
