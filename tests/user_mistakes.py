"""Mistakes of users, with the exit code and the message of each; tests/cli/test_user_mistakes.py makes them."""

from collections.abc import Mapping
from typing import Any

CAMERA = {"kind": "camera", "topic": "/camera/image_raw/compressed", "frame_id": "camera_optical"}
K = [240, 240, 239.5, 179.5]
"""Of the simulated camera: fx, fy, cx, cy."""


def camera(**intrinsics: Any) -> dict[str, Any]:
    """The camera with intrinsics in rig.yaml."""
    return {**CAMERA, "intrinsics": {"width": 480, "height": 360, "K": K, **intrinsics}}


RIG_KEYS: Mapping[str, tuple[str, Any, str]] = {
    "no root": ("root", None, "root: is missing"),
    "a root that does not exist": (
        "root",
        "velodyne",
        "must be one of the sensors, camera, lidar, laser_front, got",
    ),
    "a misspelled key": (
        "sensors.lidar.topics",
        "/points",
        "unknown key sensors.lidar.topics; did you mean 'topic'",
    ),
    "a key of another part": ("noise", {"range": 0.02}, "unknown key noise"),
    "an unknown kind": (
        "sensors.lidar.kind",
        "lidar",
        "one of camera, lidar2d, lidar3d, depth_camera, trajectory, gyroscope, got 'lidar'; did you mean",
    ),
    "no kind": (
        "sensors.lidar.kind",
        None,
        "sensors.lidar.kind: is missing; allowed are camera, lidar2d, lidar3d",
    ),
    "a number in quotes": ("target.tags.0.size", "0.32", "must be a number, got '0.32'"),
    "a negative size": ("target.tags.0.size", -0.32, "must be greater than 0, got -0.32"),
    "a size of zero": ("target.size", [0, 0.9], r"target.size\[0\]: must be greater than 0, got 0"),
    "thickness of the board": ("target.size", [1.2, 0.9, 0.01], "target.size: must have 2 elements"),
    "board in mm": ("target.size", [1200, 900], r"target.size\[0\]: is in m and must be 10 or less, got 1200"),
    "board in cm": ("target.size", [120, 90], r"target.size\[0\]: is in m and must be 10 or less, got 120"),
    "board as text": ("target.size", "1.2x0.9", "target.size: must be a list, got '1.2x0.9'"),
    "width and height swapped": ("target.size", [0.9, 1.2], "extends beyond the board: it reaches 0.540 m"),
    "tag in mm": ("target.tags.0.size", 320, "extends beyond the board: it reaches 160.380 m from the centre"),
    "center in mm": ("target.tags.1.center", [380, 200], "extends beyond the board: it reaches 380.160 m"),
    "one id twice": ("target.tags.1.id", 0, r"must differ from that of tags\[0\], got 0 twice"),
    "tags that overlap": ("target.tags.1.center", [-0.3, 0.2], r"tags\[1\]: overlaps tags\[0\] by 0.240 m"),
    "an id that the family lacks": ("target.tags.0.id", 600, "tag36h11 ends at 586, got 600"),
    "an unknown family": ("target.family", "tag36h10", "'tag16h5' or an ArUco dictionary from"),
    "no target": ("target", None, "target: is missing .*calgraph board prints"),
    "a pattern as target": ("target.kind", "checkerboard", "must be one of board, people, cylinder"),
    "people for a robot": ("target", {"kind": "people"}, "must be lidar3d or lidar2d beside .*, got camera"),
    "a cylinder in mm": (
        "target",
        {"kind": "cylinder", "diameter": 500},
        "diameter: is in m and must be 5 or less",
    ),
    "axes of people in cm": (
        "target",
        {"kind": "people", "axes": [25, 15]},
        "is in m and must be 5 or less, got 25",
    ),
    "a cylinder without diameter": ("target", {"kind": "cylinder"}, "target.diameter: is missing"),
    "one topic for two sensors": ("sensors.laser_front.topic", "/lidar/points", "is also that of lidar"),
    "no sensors": ("sensors", {}, "sensors: must not be empty"),
    "background that ends first": ("capture.background", [2.5, 0], "must end after it starts"),
    "background before the start": ("capture.background", [-1, 2.5], "must be 0 or greater, got -1"),
    "background after the end": (
        "capture.background",
        [500, 505],
        "lies after the end of the recording, which is",
    ),
    "exclude without its inner list": ("capture.exclude", [10, 20], r"exclude\[0\]: must be a list, got 10"),
    "tolerance in mm": ("tolerance.translation", 10, "is in m and must be 1 or less, got 10"),
    "tolerance in another unit": ("tolerance.translation", "10 inch", "a number with a unit"),
    "range noise in mm": ("sensors.lidar.noise.range", 20, "is in m and must be 1 or less, got 20"),
    "angle noise in degrees": ("sensors.laser_front.noise.angle", 0.25, "is in rad and must be 0.2 or less"),
    "pixel noise of a scanner": (
        "sensors.lidar.noise",
        {"pixel": 0.3},
        "noise.pixel; allowed here are range, angle",
    ),
    "no noise": ("sensors.lidar.noise.range", 0, "must be greater than 0, got 0"),
    "uncertainty in percent": ("target.uncertainty.print_scale", 1, "must be less than 1, got 1"),
    "K with three numbers": ("sensors.camera", camera(K=K[:3]), "intrinsics.K: must have 4 elements"),
    "K as a matrix": ("sensors.camera", camera(K=[240, 0, 239.5, 0, 240, 179.5, 0, 0, 1]), "must have 4 elements"),
    "a negative focal length": ("sensors.camera", camera(K=[-240, *K[1:]]), r"K\[0\]: must be greater than 0"),
    "intrinsics of another resolution": (
        "sensors.camera",
        camera(width=960, height=720),
        "is 480x360, its intrinsics are for 960x720",
    ),
    "one distortion coefficient": (
        "sensors.camera",
        camera(distortion=[0.1]),
        "has 0, 4, 5 or 8 coefficients, got 1",
    ),
    "ROS' name of a lens": ("sensors.camera", camera(model="plumb_bob"), "must be 'pinhole' or 'fisheye', got"),
    "two sources of intrinsics": (
        "sensors.camera",
        {**camera(), "camera_info": "/camera/camera_info"},
        "give camera_info .a topic. or intrinsics, not both",
    ),
    "a misspelled topic": ("sensors.lidar.topic", "/lidar/point", "has no topic '/lidar/point'; did you mean"),
    "a topic without its slash": ("sensors.lidar.topic", "lidar/points", "did you mean '/lidar/points'"),
    "a misspelled trigger": ("capture.trigger", "/triger", "has no topic '/triger'; did you mean '/trigger'"),
    "a sensor's topic as trigger": (
        "capture.trigger",
        "/laser_front/scan",
        "leave the trigger out to find the holds",
    ),
    "images as camera_info": (
        "sensors.camera.camera_info",
        "/camera/image_raw/compressed",
        "holds no CameraInfo message",
    ),
    "a scan as a cloud": (
        "sensors.laser_front",
        {"kind": "lidar3d", "topic": "/laser_front/scan"},
        "has LaserScan messages; a lidar2d sends those, but its kind lidar3d needs PointCloud",
    ),
    "a clock offset of the root": ("sensors.lidar.clock_offset", 0.5, "is relative to the root's clock"),
    "a clock offset in words": ("sensors.camera.clock_offset", "measure", "must be"),
    "mounting of a rig's scanner": ("sensors.laser_front.mounting", "inverted", "applies to networks only"),
    "a misspelled setting": (
        "settings",
        {"captures": {"minhold": 1}},
        "captures.minhold; did you mean 'min_hold'",
    ),
    "a setting out of range": ("settings", {"captures": {"min_hold": -1}}, "min_hold: must be greater than 0"),
}
"""Key of rig.yaml, its wrong value (None: left out), and the message; exit code 2."""

RIG_TEXTS: Mapping[str, tuple[str, str, str]] = {
    "a tab": ("  kind: board", "\tkind: board", r"line 3: is not valid YAML \(found character '\\t'"),
    "a bracket that is not closed": ("[1.2, 0.9]", "[1.2, 0.9", "line 5: is not valid YAML"),
    "no space after a colon": ("root: lidar", "root:lidar", "line 2: is not valid YAML"),
    "a key twice": ("root: lidar", "root: lidar\nroot: camera", "line 2: the key 'root' is given twice"),
    "not UTF-8": ("lidar", "lid\udce4r", "is not UTF-8 text"),
}
"""What is replaced in the text of rig.yaml, by what, and the message; exit code 2."""

COMMANDS: Mapping[str, tuple[str, str]] = {
    "a cluster without protocol": (
        "calibrate {rig} {rec} -o {out} --cluster 10.0.0.5:8786",
        "--cluster: must be local, or the address of a scheduler such as tcp://10.0.0.5:8786, got '10.0.0.5:8786'",
    ),
    "processes of a cluster elsewhere": (
        "calibrate {rig} {rec} -o {out} --jobs 2 --cluster tcp://10.0.0.5:8786",
        "--jobs: the number of workers of a cluster is its own; leave it out",
    ),
    "a recording of an unknown protocol": (
        "calibrate {rig} carrier://pigeon -o {out}",
        "carrier://pigeon: cannot be read .*; check address, network and credentials",
    ),
    "a rig.yaml that is missing": (
        "calibrate {tmp}/rog.yaml {rec} -o {out}",
        "rog.yaml: does not exist; did you mean '.*/rig.yaml'",
    ),
    "a recording that is missing": ("calibrate {rig} {tmp}/recording -o {out}", "does not exist; check the path"),
    "arguments swapped": ("calibrate {rec} {rig} -o {out}", "seems to be a recording; give RIG.yaml first"),
    "arguments swapped, a file": (
        "calibrate {mcap} {rig} -o {out}",
        "seems to be a recording; give RIG.yaml first",
    ),
    "rig.yaml as recording": ("calibrate {rig} {rig} -o {out}", "is not a recording; give a rosbag2 folder"),
    "an empty folder as recording": (
        "calibrate {rig} {tmp}/empty -o {out}",
        "is no recording: it has neither bag files",
    ),
    "the folder around the recording": (
        "calibrate {rig} {robot} -o {out}",
        "is no recording, but contains .*recording: give that",
    ),
    "an empty bag": ("calibrate {rig} {tmp}/zero.mcap -o {out}", "zero.mcap: is empty; copy it again"),
    "a bag cut off": ("calibrate {rig} {tmp}/cut.mcap -o {out}", "may be truncated: try `mcap recover cut.mcap"),
    "text named .mcap": ("calibrate {rig} {tmp}/text.mcap -o {out}", "may be truncated: .* or copy it again"),
    "a file as OUT": ("calibrate {rig} {rec} -o {tmp}/text.mcap", "is a file, a folder is to be written there"),
    "a folder that cannot be written to": (
        "calibrate {rig} {rec} -o /proc/result",
        "/proc/result: cannot be written",
    ),
    "earlier results in OUT": ("calibrate {rig} {rec} -o {tmp}/earlier", "choose another OUT, or give --force"),
    "an estimator of networks": (
        "calibrate {rig} {rec} -o {out} --estimator averaging",
        "must be bundle or hypergraph",
    ),
    "a misspelled step of a method": (
        "calibrate {rig} {rec} -o {out} --set published.start=trees",
        "--set: published.start: must be 'tree', 'identity'",
    ),
    "a misspelled value of a former option": (
        "calibrate {rig} {rec} -o {out} --start trees",
        "--set: published.start: must be 'tree', 'identity'",
    ),
    "settings of networks": (
        "calibrate {rig} {rec} -o {out} --set published.feature=com --no-icp",
        "published.feature, published.icp: only for networks",
    ),
    "options of networks": ("calibrate {rig} {rec} -o {out} --moved camera", "--moved: only for networks"),
    "deviations without a prior": ("calibrate {rig} {rec} -o {out} --prior-stddev 0.01 0.5", "goes with --prior"),
    "a prior that is missing": (
        "calibrate {rig} {rec} -o {out} --prior {tmp}/robot.urdf",
        "does not exist; check the path",
    ),
    "a rig.yaml as prior": (
        "calibrate {rig} {rec} -o {out} --prior {rig}",
        "must be a calibration.yaml .*, a URDF, or",
    ),
    "rigid sensors without a file": (
        "calibrate {rig} {rec} -o {out} --rigid camera,lidar",
        "as in robot.urdf:camera,laser",
    ),
    "a setting without its value": (
        "calibrate {rig} {rec} -o {out} --set captures.min_hold",
        "must be KEY=VALUE, such as",
    ),
    "an unknown setting": (
        "calibrate {rig} {rec} -o {out} --set captures.hold=1",
        "unknown key captures.hold; did you mean",
    ),
    "a dump into no folder": (
        "calibrate {rig} {rec} -o {out} --dump {tmp}/none/p.npz",
        "its folder does not exist",
    ),
    "a dump into a loop of links": (
        "calibrate {rig} {rec} -o {out} --dump {tmp}/loop",
        "loop: is a link that leads nowhere",
    ),
    "export of no result": (
        "export {tmp}/empty -f tf",
        "has no calibration.yaml; give the folder that calibrate wrote",
    ),
    "export of a rig.yaml": ("export {rig} -f tf", "format: must be calgraph/1"),
    "check against a rig.yaml": ("check {rig} {rec} --against {rig}", "must be a calibration.yaml .*, a URDF, or"),
    "a tolerance of many turns": (
        "check {rig} {rec} --against {truth} --tolerance 0.01 1e300",
        "--tolerance: rotation: is in degrees and must be 45 or less, got 1e[+]300",
    ),
    "a negative tolerance": (
        "check {rig} {rec} --against {truth} --tolerance -1 1",
        "must be two numbers above 0, m and degrees",
    ),
    "verify without a recording": ("verify {rig}", "a rig needs a recording beside it: verify RIG.yaml RECORDING"),
    "solve of a rig.yaml": ("solve {rig} -o {out}", "is not what calibrate --dump writes"),
    "view of no result": ("view {tmp}/empty", "has no calibration.yaml; give the folder that calibrate wrote"),
    "inspect of a rig.yaml": ("inspect {rig}", "is not a recording; give a rosbag2 folder"),
    "init over a rig.yaml": ("init {rec} -o {rig}", "exists already; choose another FILE, or give --force"),
    "init with the PDF": ("init {rec} -o {tmp}/draft.yaml --board {tmp}/board.pdf", "is not UTF-8 text"),
    "a board in m": (
        "board --size 1.2x0.9 -o {tmp}/b.pdf",
        "WIDTHxHEIGHT in mm, such as 1200x900; .* seems to be in m",
    ),
    "a board larger than its paper": (
        "board --size 1200x900 --paper A4 -o {tmp}/b.pdf",
        "leave --paper out .* or give --tile A4",
    ),
    "an unknown paper": ("board --paper B7 -o {tmp}/b.pdf", "is none of a0, a1, .*, nor WIDTHxHEIGHT in mm"),
    "simulate over a recording": ("simulate rig -o {robot}", "exists already; remove it or choose another OUT"),
}
"""Command line and message; exit code 2."""

USAGE: Mapping[str, tuple[str, str]] = {
    "no OUT": ("calibrate {rig} {rec}", "Missing option '--out' / '-o'"),
    "no recording": ("calibrate {rig} -o {out}", "Missing argument 'RECORDING...'"),
    "a misspelled option": ("calibrate {rig} {rec} -o {out} --forse", "No such option: --forse .*--force"),
    "a misspelled command": ("calibrat {rig} {rec}", "No such command 'calibrat'. Did you mean 'calibrate'"),
    "a misspelled choice": (
        "calibrate {rig} {rec} -o {out} --estimator publish",
        "'publish' is not one of 'joint', 'published'",
    ),
    "a misspelled format": ("export {tmp} --format lunch", "'--format' / '-f': 'lunch' is not one of 'launch', "),
    "more processes than any machine has": (
        "calibrate {rig} {rec} -o {out} --jobs 99999999999999999999",
        "'--jobs': .* less than or equal to 256",
    ),
    "a negative number of folds": (
        "calibrate {rig} {rec} -o {out} --folds -1",
        "'--folds': .* greater than or equal to 0",
    ),
}
"""Command line and message of the parser, with a reference to --help; exit code 2."""

TAGS: list[dict[str, Any]] = [
    {"id": 0, "size": 0.32, "center": [-0.38, 0.2]},
    {"id": 1, "size": 0.32, "center": [0.38, 0.2]},
    {"id": 2, "size": 0.32, "center": [0.0, -0.2]},
]
RESULTS: Mapping[str, tuple[str, Any, int, str]] = {
    "tags measured with their white border": (
        "target.tags",
        [{**tag, "size": 0.4} for tag in TAGS],
        0,
        "camera is weak: tags on the board are 20 % smaller than stated; .* check it, correct rig.yaml",
    ),
    "a focal length of 420 instead of 320": (
        "sensors.camera",
        camera(K=[315, 315, *K[2:]]),
        0,
        "camera is weak: the focal length of camera is 2. % shorter than stated; .* correct rig.yaml",
    ),
    "a smaller board than the real one": (
        "target.size",
        [1.1, 0.8],
        0,
        "by its edges .* the board is 1.* m wide .* not 1.100 m and 0.800 m as rig.yaml states",
    ),
    "wrong ids": (
        "target.tags",
        [{**tag, "id": 3 + i} for i, tag in enumerate(TAGS)],
        1,
        "camera is not calibrated: .* only ids 0 to 2 detected, which are not on the board; ids 3 to 5 expected",
    ),
    "ids interchanged": (
        "target.tags",
        [{**tag, "id": new} for tag, new in zip(TAGS, (1, 0, 2), strict=True)],
        1,
        "tags 0, 1, 2 are outliers in up to 8 .*: the board is not as in rig.yaml; check the tags' ids, centres",
    ),
    "centers with y down": (
        "target.tags",
        [{**tag, "center": [tag["center"][0], -tag["center"][1]]} for tag in TAGS],
        0,
        "camera is weak: tag 2 is an outlier in up to 8 .*: the board is not as in rig.yaml; check the tags' ids",
    ),
    "another family": ("target.family", "tag25h9", 1, "no tag of family tag25h9 found; ids 0 to 2 expected"),
    "another board": (
        "target",
        {
            "kind": "board",
            "size": [1.2, 0.9],
            "pattern": {"kind": "checkerboard", "columns": 7, "rows": 6, "square": 0.1},
        },
        1,
        "camera is not calibrated: .*checkerboard of 7x6 inner corners not found",
    ),
    "K in another order": (
        "sensors.camera",
        camera(K=[239.5, 179.5, 240, 240]),
        1,
        "fx and fy of camera differ by 33 %, .*: check that K is fx, fy, cx, cy",
    ),
    "K of half the resolution": (
        "sensors.camera",
        camera(K=[120, 120, 119.5, 89.5]),
        1,
        "principal point of camera is 25 % .* away from its middle: check that K belongs to images of 480 x 360",
    ),
    "distortion of another lens": (
        "sensors.camera",
        camera(distortion=[-0.3, 0.1, 0, 0]),
        0,
        "distortion coefficients of camera displace corners .* calibrate its intrinsics again",
    ),
    "background over the first captures": (
        "capture.background",
        [0.0, 7.0],
        0,
        r"capture.background \[0, 7\] contains 4 of 9 messages of .* must end before the board is in view",
    ),
    "exclude over everything": (
        "capture.exclude",
        [[0, 60]],
        1,
        "all 9 messages of /trigger lie in .*; make these shorter",
    ),
    "one sensor alone": (
        "sensors",
        {"lidar": {"kind": "lidar3d", "topic": "/lidar/points"}},
        1,
        "needs at least two",
    ),
    "the frame of another sensor": (
        "sensors.laser_front.frame_id",
        "lidar",
        0,
        "laser_front state the frame laser_front, rig.yaml states lidar: correct frame_id if it is wrong",
    ),
    "range noise a hundred times too small": (
        "sensors.lidar.noise.range",
        0.0001,
        0,
        "the noise of lidar is .* times that in rig.yaml: check its range noise",
    ),
}
"""Key of rig.yaml, its wrong value, exit code, and what the terminal states."""
