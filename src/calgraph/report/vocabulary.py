"""What the page calls things, which depends on what the sensors were shown: a board, or people who walk."""

from collections.abc import Mapping
from dataclasses import dataclass

from calgraph.config import Rig


@dataclass(frozen=True)
class Words:
    """The words of one story; long ones are HTML."""

    row: str
    """What a row of captures.csv is about."""
    rows: str
    """Title of the section on all of them."""
    no_rows: str
    key: tuple[str, str]
    """How to read the picture of all rows, and what their gaps are."""
    evidence: str
    """What both sensors of a pair have so many of."""
    no_pairs: str
    columns: tuple[str, str, str]
    """Heads of a pair's numbers."""
    graph: str
    residuals: str
    spread: str
    """On the distances of single captures or walks."""
    coverage: str
    view: str
    """Title of the section with the picture of the result."""
    about_view: str
    advice: Mapping[str, str]
    """What to do about a sensor, by grade, where its verdict does not say."""


BOARD = Words(
    row="capture",
    rows="Captures",
    no_rows="There are no captures: the board was not found at rest in this recording.",
    key=("Point at a cell to see when it was and why it was not used.", "no measurement"),
    evidence="capture",
    no_pairs="No two sensors saw the board in the same capture.",
    columns=("captures<br>of both", "kept", "RMS<br>distance"),
    graph="""A line joins two sensors that saw the board in the same captures: how many were kept of how
many, and the root mean square distance between what the two saw under the final poses. Bold lines are the
tree along which the start values came; dashed ones could not be used.""",
    residuals="""Residuals of the joint solution, each divided by the standard deviation its noise should
give it. With the right noise they follow the dotted curve and have an RMS of 1; above 1 the stated noise
is too small, below it is too large.""",
    spread="""Distances of what each sensor saw in single captures from what the others saw, under the final poses:
half of the captures lie in the box, dots are captures far from the others.""",
    coverage="""How often the board was where in each sensor's field of view, the darker the more captures. A
result holds best where the board was; nothing is known of parts of the view where it never was. What
is missing need not be bad: only where views overlap does a capture tie sensors to each other.""",
    view="3-D view",
    about_view="""Frames with x, y, z axes in red, green and blue; drag to turn, scroll to zoom, click in
the legend to hide. An ellipsoid holds a sensor's true position with 95 % probability; what is too large
is cut off.""",
    advice={
        "weak": "Record more captures with the board at other angles, heights and distances.",
        "unconnected": "No capture ties it to another sensor. Hold the board where both see it at once.",
        "unobservable": "Do not use this pose. Record captures in which the board is tilted about several axes.",
    },
)

NETWORK = Words(
    row="walk",
    rows="Walks",
    no_rows="There are no walks: no scanner could follow anybody in this recording.",
    key=("A line is somebody who walked through a scanner's view. Point at its ends to see who else saw it.", ""),
    evidence="position",
    no_pairs="No two scanners followed anybody at the same time.",
    columns=("positions<br>of both", "agree", "off by"),
    graph="""A line joins two scanners that saw somebody at the same time: of the positions, ten a second,
which both should have seen, how many agree; and how far the pair's own pose is off the final one. Bold
lines are the tree in which the scanners hang; dashed pairs contradict the others.""",
    residuals="""Differences between positions that two scanners measured of one walker at the same time,
under the final poses, each divided by the standard deviation that both tracks state. With the right noise
they follow the dotted curve and have an RMS of 1; above 1 the stated noise is too small, below it is too
large.""",
    spread="""Distances between where each scanner saw people walk and where the others saw them, under the final
poses: half of the walks lie in the box, dots are walks far from the others.""",
    coverage="""How many walks came through which part of each scanner's field of view, the darker the more.""",
    view="Floor plan",
    about_view="""What all scanners saw, in one frame: points stood still, lines are where somebody
walked. If walls or walks of two colours lie beside each other instead of on each other, a pose is wrong.
Arrows point along the scanners' x axes. Drag to zoom, double-click to see all, click in the legend to hide
a scanner.""",
    advice={
        "weak": "Let people walk farther across, and to and fro, where it and others both see them.",
        "unconnected": "Nobody's walk ties it to another scanner. Let people walk where both see them at once.",
        "unobservable": "Do not use this pose. Let people walk to and fro where it and others see them.",
    },
)


def words_for(rig: Rig) -> Words:
    """The words of a rig's story."""
    return NETWORK if rig.is_network else BOARD
