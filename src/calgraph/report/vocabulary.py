"""The texts of the report, which depend on the target: a board, people who walk, or surroundings."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from calgraph.config import Rig
from calgraph.sensors.kinds import KINDS


@dataclass(frozen=True)
class Vocabulary:
    """The terms and captions of rigs, networks, or drives; captions are HTML."""

    item: str
    """The unit of a row of captures.csv."""
    items_title: str
    """Title of the section on all rows."""
    no_items: str
    items_caption: tuple[str, str]
    """Caption of the figure of all rows, and the meaning of its gaps."""
    shared_evidence: str
    """The unit of a pair's shared measurements."""
    no_pairs: str
    pair_columns: tuple[str, str, str]
    """Headings of a pair's numbers."""
    graph_caption: str
    fit: Mapping[str, str]
    """Name of the residual of each kind of sensor."""
    errors_caption: str
    """Caption of the residuals in px and mm."""
    residuals_caption: str
    """Caption of the whitened residuals."""
    distances_caption: str
    """Caption of the distances of single captures or walks."""
    coverage_caption: str
    view_title: str
    """Title of the section with the figure of the result."""
    view_caption: str
    advice: Mapping[str, str]
    """Advice for a sensor by grade, where its verdict gives none; without a pose, by its detections."""


BOARD_VOCABULARY = Vocabulary(
    item="capture",
    items_title="Captures",
    no_items="There are no captures: the board was not detected at rest in this recording.",
    items_caption=("Hover over a cell for its time and the reason of a rejection.", "not in view"),
    shared_evidence="capture",
    no_pairs="No two sensors detected the board in the same capture.",
    pair_columns=("shared<br>captures", "inliers", "RMS<br>residual"),
    graph_caption="""\
An edge joins two sensors that detected the board in the same captures. Labels: inliers of shared captures, and
RMS residual under the final poses. Bold: spanning tree used for initialization; dashed: no relative pose was
estimated.""",
    fit={name: kind.residual for name, kind in KINDS.items()},
    errors_caption="""\
Measured minus predicted by the joint solution, of all measurements that it used: reprojection errors of printed
corners, and distances of beam ends from the board, positive beyond it. They should scatter about zero without a
pattern. Regions of one direction (colour) in the image, or a radial error, indicate the lens or the print; a
slope over range a range scale; a dependence on elevation single rings; a step or drift over time a sensor that
moved.""",
    residuals_caption="""\
Residuals of the joint solution, each divided by its predicted standard deviation. With correct noise they
follow the standard normal distribution (dotted) and have an RMS of 1; an RMS above 1 means that the noise is
underestimated, below 1 that it is overestimated.""",
    distances_caption="""\
RMS distance of each sensor's detections from the other sensors' detections of the same capture, under the final
poses. Boxes hold half of the captures; dots are outliers.""",
    coverage_caption="""\
Coverage of each field of view by board detections; darker cells have more captures. The calibration is most
reliable where the board was detected. Uncovered parts are no defect where the fields of view of two sensors do
not overlap.""",
    view_title="3-D view",
    view_caption="""\
Frames with x, y, z axes in red, green and blue; drag to rotate, scroll to zoom, click in the legend to hide. An
ellipsoid contains the sensor's true position with 95 % probability; long axes are clipped.""",
    advice={
        "root": "Nothing can be connected without the root: record captures in its view, or state another root.",
        "weak": "Record more captures with the board at other angles, heights and distances.",
        "unconnected": "Record more captures in which both it and a sensor with a pose detect the board.",
        "undetected": "Check the target in rig.yaml against the board that was used, and in the thumbnails below "
        "whether the board is in its view; then record captures there.",
        "unobservable": "Do not use this pose. Record captures in which the board is tilted about several axes.",
    },
)

NETWORK_VOCABULARY = Vocabulary(
    item="walk",
    items_title="Walks",
    no_items="There are no walks: no scanner tracked a person in this recording.",
    items_caption=("A line is one track of one scanner. Hover over its ends for its time and outcome.", ""),
    shared_evidence="position",
    no_pairs="No two scanners tracked a person simultaneously.",
    pair_columns=("shared<br>positions", "inliers", "pose<br>difference"),
    graph_caption="""\
An edge joins two scanners that tracked a person simultaneously. Labels: inliers of the positions (10 Hz) that
both should measure, and RMS difference of the pair's pose from the final one. Poses of single pairs are from
tracks alone and may be centimetres off: they are start values, which the joint solution replaces. Bold: spanning
tree of the result; dashed: pairs that are inconsistent with the others.""",
    fit={"lidar2d": "range residual"},
    errors_caption="""\
Measured minus predicted range of the beams on people, in the joint solution, which models bodies or legs and
their paths; beams that it rejects as outliers are left out. Residuals should scatter about zero without a
pattern: a slope over range indicates a range scale, a dependence on azimuth the angles or the tilt of a scanner, a
step or drift over time a clock or a scanner that moved. Clothes and gait make single residuals of 10 to 30 mm
normal. <b>σ of a pose is much smaller than these residuals</b>, because it is that of an average: the errors of
thousands of beams, on both sides of people who walk in many directions, cancel but for their mean.""",
    residuals_caption="""\
Differences of simultaneous positions of one person in two scanners, under the final poses, each divided by its
predicted standard deviation. With correct noise they follow the standard normal distribution (dotted) and have
an RMS of 1; an RMS above 1 means that the noise is underestimated, below 1 that it is overestimated.""",
    distances_caption="""\
RMS distance of each scanner's tracks from the other scanners' tracks of the same person, under the final poses.
Boxes hold half of the walks; dots are outliers. These are no errors of poses: a track follows the side of a person
that faces its scanner, or one of two legs, so that tracks of opposite scanners lie up to a body's width apart. The
joint solution fits the body between them.""",
    coverage_caption="""\
Coverage of each field of view by tracks; darker cells have more walks.""",
    view_title="Floor plan",
    view_caption="""\
Measurements of all scanners in the root frame: points are the static background, lines are tracks. Walls or
tracks of two colours that do not coincide indicate a wrong pose. Arrows are the scanners' x axes. Drag to zoom,
double-click to reset, click in the legend to hide a scanner.""",
    advice={
        "root": "Nothing can be connected without the root: let people walk in its view, or state another root.",
        "weak": "Let people walk longer paths in several directions where its view overlaps with others.",
        "unconnected": "Let people walk longer where its view and that of another scanner with a pose overlap.",
        "undetected": "Check its topic and its mounting, and let people walk where its view and others overlap.",
        "unobservable": "Do not use this pose. Let people walk in several directions where views overlap.",
    },
)

SPACE_VOCABULARY = replace(
    NETWORK_VOCABULARY,
    no_items=NETWORK_VOCABULARY.no_items.replace("scanner", "sensor"),
    items_caption=("A line is one track of one sensor. Hover over its ends for its time and outcome.", ""),
    no_pairs=NETWORK_VOCABULARY.no_pairs.replace("scanner", "sensor"),
    graph_caption=NETWORK_VOCABULARY.graph_caption.replace("scanner", "sensor"),
    fit={"lidar3d": "distance from walls and floors", "lidar2d": "distance from walls"},
    residuals_caption=NETWORK_VOCABULARY.residuals_caption.replace("scanner", "sensor"),
    distances_caption="""\
RMS distance of each sensor's tracks from the other sensors' tracks of the same person, under the final poses.
Boxes hold half of the walks; dots are outliers. These are no errors of poses: each sensor measures the side of a
person that faces it. The joint solution estimates the shape of the body between them.""",
    coverage_caption="""\
Coverage of each field of view by people; darker cells have more walks. Directions are those of the middle of their
bodies in the sensor's frame.""",
    view_caption="""\
Measurements of all sensors from above: points are walls, lines are tracks. Walls or tracks of two colours that do
not coincide indicate a wrong pose. The frame is level, with its origin on the floor below a 3-D LiDAR: the root,
if that is one. Arrows are the sensors' x axes. Drag to zoom, double-click to reset, click in the legend to hide a
sensor.""",
    advice={grade: text.replace("scanner", "sensor") for grade, text in NETWORK_VOCABULARY.advice.items()},
)
"""Of networks with 3-D LiDARs."""

DRIVE_VOCABULARY = Vocabulary(
    item="second",
    items_title="Drive",
    no_items="Sensors are calibrated from the whole drive: there are no captures.",
    items_caption=("", ""),
    shared_evidence="motion",
    no_pairs="No sensor's motion agrees with the root's.",
    pair_columns=("motions", "agreeing", "difference"),
    graph_caption="""\
An edge joins the root with a sensor whose motion was compared with its own. Labels: relative motions of 1.5 s that
agree, of all of them. Dashed: no relative pose was estimated.""",
    fit=dict.fromkeys(("lidar2d", "lidar3d"), "distance from the surface"),
    errors_caption="""\
Distances of points from the flat patches of their surfaces, positive beyond them. They should scatter about zero
without a pattern: a slope over range indicates a range scale, a dependence on elevation single rings, one on the
angle of incidence the scanner's way to measure slanted surfaces, and a step or drift over time a clock or a sensor
that moved. Surfaces are not flat to a millimetre, and each sensor meets other parts of them: the joint solution
estimates these differences separately, so that single residuals of 5 to 20 mm are normal.""",
    residuals_caption="",
    distances_caption="",
    coverage_caption="""\
Coverage of each field of view by surfaces that another sensor measured, too; darker cells have more seconds with
such surfaces. Surfaces that one sensor alone measured determine the trajectory, but not where the sensor is.""",
    view_title="3-D view",
    view_caption=BOARD_VOCABULARY.view_caption,
    advice={
        "root": "Nothing can be connected without the root: check its topic, or state another root.",
        "weak": "Drive longer, with more turns, so that all sensors pass the same walls and furniture.",
        "unconnected": "Drive curves, slowly enough for its odometry, where walls and furniture are near.",
        "undetected": "Check its topic, and drive where walls and furniture are within its range.",
        "unobservable": "Do not use this pose. Drive curves, and over ramps where sensors measure in space.",
    },
)


def select_vocabulary(rig: Rig) -> Vocabulary:
    """The vocabulary for a rig's target."""
    if rig.is_drive:
        return DRIVE_VOCABULARY
    if rig.is_network:
        planar = all(spec.kind == "lidar2d" for spec in rig.sensors.values())
        return NETWORK_VOCABULARY if planar else SPACE_VOCABULARY
    return BOARD_VOCABULARY
