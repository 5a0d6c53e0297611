"""Settings of the search for captures. Times in s, distances in m."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class MotionDetectionSettings(StrictModel):
    """The change of a sensor's view between two messages."""

    min_gray_change: float = Field(default=12.0, gt=0)
    """Change of a grey value, averaged over a block, that counts as motion: noise and flicker stay below."""
    min_corner_change: float = Field(default=1.0, gt=0)
    """Change of a detected corner, pixels, that counts as motion: five times the noise of detected corners."""
    image_block: int = Field(default=8, ge=1)
    """Edge of the blocks of an image that are averaged, pixels: noise of a pixel falls to an eighth."""
    min_range_change: float = Field(default=0.05, gt=0)
    """Change of a range, m, that counts as motion: more than twice the noise of a 2-D scanner (20 mm)."""
    min_range_change_ratio: float = Field(default=0.02, ge=0)
    """The same over the smaller of both ranges: noise of ranges and of angles of incidence grows with range."""
    no_return_range: float = Field(default=100.0, gt=0)
    """Range of a beam without return, m: farther than any wall, so that a return that appears is a change."""
    min_activity: float = Field(default=1e-4, gt=0)
    """Change of a view, 0..1, added before the logarithm in which rest and motion are separated: less than one
    beam of a thousand, so that views without any change do not dominate."""
    cell: float = Field(default=0.2, gt=0)
    """Cell by whose occupation two clouds are compared, m: points in cells next to occupied ones have not moved,
    as noise alone takes points across borders of cells."""


class ClockAlignmentSettings(StrictModel):
    """Clock offsets of a rig's sensors, from the times at which their views change."""

    min_messages: int = Field(default=20, ge=3)
    """Minimum number of messages of a sensor: fewer changes of a view agree with others by chance."""
    min_step: float = Field(default=0.005, gt=0)
    """Minimum time between samples of the activity, s; half of the shortest period above it. The offset is
    interpolated to a fraction of it."""
    max_samples: int = Field(default=500_000, gt=0)
    """Maximum number of samples of a view: two hours at 30 Hz. Views of a longer time, or with a stamp that is far
    from all others, are not compared."""
    min_overlap: float = Field(default=0.5, gt=0, le=1)
    """Minimum share of the shorter view that lies within the other with an offset: recordings of cameras that are
    started one after the other overlap for most of their time, and short overlaps agree by chance."""
    peak_width: float = Field(default=1.0, gt=0)
    """Time to both sides of an offset, s, within which larger correlations are of the same maximum: moves of a
    board take a second."""
    min_correlation: float = Field(default=0.5, gt=0, lt=1)
    """Minimum correlation: views from different sides change differently, and share starts and stops."""
    min_distinction: float = Field(default=0.25, gt=0, lt=1)
    """Minimum difference to the correlation with any other offset: moves at equal intervals repeat themselves, and
    those of a hand nearly do."""
    min_significance: float = Field(default=5.0, gt=0)
    """Minimum correlation over its standard deviation by chance: the largest of some thousand offsets reaches four
    in views that have nothing in common."""
    resolution: float = Field(default=0.02, gt=0)
    """Offsets below it, s, are taken for zero: the estimate is no better, and a device that starts its recordings
    together gives them one clock."""
    min_remark: float = Field(default=0.5, gt=0)
    """Minimum offset, s, that is remarked on where rig.yaml states none: smaller ones leave captures within rests,
    and views from different sides differ by them."""


class CameraNoiseSettings(StrictModel):
    """The noise of a camera's corners, estimated from PnP residuals."""

    min_noise: float = Field(default=0.05, gt=0)
    """Minimum noise of a corner, px: errors of the distortion model shift all corners of a board, which the
    residuals of one PnP do not show; corners of the AprilTag library scatter by 0.05 to 0.1 px."""
    min_degrees_of_freedom: int = Field(default=24, gt=0)
    """Minimum degrees of freedom of an estimate: its relative standard deviation is 1 / sqrt(2 x 24) = 14 %."""


class MaxMessageSettings(StrictModel):
    """Maximum numbers of messages of one hold; noise that is common to all messages limits what more give."""

    camera: int = Field(default=2, ge=1)
    """Maximum number of images: each costs as much as all scans and clouds; a second one reveals motion during the
    hold."""
    lidar2d: int = Field(default=20, ge=1)
    """Maximum number of scans: noise of their average is 4 mm at 20 mm a beam, below the bias of a scanner."""
    lidar3d: int = Field(default=5, ge=1)
    """Maximum number of clouds: with some hundred points each on the board, biases of rings dominate."""

    def of(self, kind: str) -> int:
        """The limit of sensors of this kind."""
        return int(getattr(self, kind))


class InputCheckSettings(StrictModel):
    """The checks of all messages of a recording."""

    max_identical_share: float = Field(default=0.5, gt=0, lt=1)
    """Share of identical messages beyond which two topics carry the data of one sensor; of two sensors almost no
    message is identical, as noise differs, and a relay that drops messages passes most."""
    min_identical_messages: int = Field(default=3, ge=1)
    """Minimum number of different messages that both topics have: a covered scanner, or a dark image, repeats
    one."""
    max_intrinsics_change: float = Field(default=1e-5, gt=0)
    """Maximum change of K over the focal length, and of a distortion coefficient, that is rounding: values with
    six digits, or single precision; it moves a pixel by 0.01 px."""
    max_focal_difference: float = Field(default=0.1, gt=0)
    """Maximum relative difference of fx and fy without a remark: pixels are square within 1 %, and those of analog
    cameras within 10 %."""
    max_principal_point_offset: float = Field(default=0.15, gt=0)
    """Maximum distance of a principal point from the middle of the image, as a share of its size, without a
    remark: lenses are mounted within 5 %; K of half the resolution is off by 25 %."""


class EmptyStartSettings(StrictModel):
    """The search for a time without board and operator at the start of a recording."""

    reference_duration: float = Field(default=1.0, gt=0)
    """Time at the start that later measurements are compared with, s: several messages of any scanner."""
    min_duration: float = Field(default=1.5, gt=0)
    """Minimum duration of an empty start, s: a background needs several messages of each scanner."""
    max_duration: float = Field(default=60.0, ge=0)
    """Time from the start that is searched, s: operators who wait longer state a window in rig.yaml. 0: none."""
    entry_margin: float = Field(default=0.3, ge=0)
    """Time between the empty start and the detected entry, s: at 1 m/s, less than half of a person is in view."""
    direction_cell: float = Field(default=0.0174532925199433, gt=0)
    """Edge of the cells in which directions are compared, 1°: several beams of any LiDAR."""
    min_range_change: float = Field(default=0.2, gt=0)
    """Change of a range, m, that is something else: ten times the noise of a scanner; people and boards are
    farther than this from walls."""
    min_range_change_ratio: float = Field(default=0.02, ge=0)
    """The same over the range: noise of directions and of angles of incidence grows with it."""
    min_directions: int = Field(default=3, ge=1)
    """Minimum number of cells with something else: an object of 0.5 m at 10 m covers three in a row."""
    later_messages: int = Field(default=20, ge=5)
    """Messages of each scanner that are searched for what was uncovered, spread over the recording."""
    max_uncovered_share: float = Field(default=0.5, gt=0, lt=1)
    """Share of these beyond which something was in view at the start: what left its place uncovers the room in
    most of them; people who pass cover others."""


class MisplacedTagSettings(StrictModel):
    """When tags contradict the board in rig.yaml. A tag that is blurred or partly hidden is an outlier, too."""

    min_captures: int = Field(default=3, ge=1)
    """Minimum number of captures in which a tag is an outlier: one or two may be accidents."""
    min_share: float = Field(default=0.5, gt=0, le=1)
    """The same over the captures in which the camera detected several tags: a misplaced tag is an outlier in all
    in which the others are the majority, or in half where two tags contradict each other."""


class MovingBoardSettings(StrictModel):
    """Synchronized frames of a moving board."""

    max_captures: int = Field(default=120, ge=1)
    """Maximum number of sets of frames that are used, spread over the recording: consecutive frames show almost
    the same pose, and each costs three detections a sensor."""
    max_interval: float = Field(default=0.3, gt=0)
    """Maximum time between a measurement and the one that shows the velocity of the board, s: within it, the
    motion of a hand is a parabola to some millimetres."""
    max_speed: float = Field(default=3.0, gt=0)
    """Maximum speed of a board, m/s: operators walk and turn at half of it; more is a wrong detection."""
    max_rotation_rate: float = Field(default=6.0, gt=0)
    """Maximum rotation rate of a board, rad/s: more is the second solution of a plane's pose."""
    skew_rounds: int = Field(default=2, ge=0)
    """Rounds of removing the motion from the planes of a sweep, and of estimating the motion from them: where a
    sweep begins and ends on the board, the first plane is rotated by up to 10°, the second by less than 1°."""


class CaptureSettings(StrictModel):
    """When the board rests, and which messages of a capture are used."""

    motion: MotionDetectionSettings = MotionDetectionSettings()
    clock_alignment: ClockAlignmentSettings = ClockAlignmentSettings()
    camera_noise: CameraNoiseSettings = CameraNoiseSettings()
    max_messages: MaxMessageSettings = MaxMessageSettings()
    input_checks: InputCheckSettings = InputCheckSettings()
    empty_start: EmptyStartSettings = EmptyStartSettings()
    misplaced_tags: MisplacedTagSettings = MisplacedTagSettings()
    moving_board: MovingBoardSettings = MovingBoardSettings()
    min_hold: float = Field(default=0.5, gt=0)
    """Minimum duration of a hold found by stillness, s: shorter rests are turning points of a moving board."""
    max_motion_period: float = Field(default=0.5, gt=0)
    """Longest period of a sensor, s, whose messages show motion: slower ones miss moves between two holds."""
    max_snapshot_gap: float = Field(default=1.0, gt=0)
    """Longest time between messages of one pose in a recording of snapshots, s; poses are at least twice apart."""
    max_snapshot_spread: float = Field(default=8.0, gt=0)
    """Longest time between messages of one pose, s, where those within ``max_snapshot_gap`` are fewer than half:
    drivers that answer after several seconds."""
    max_pose_recording: float = Field(default=15.0, gt=0)
    """Maximum duration of a recording that is of one pose of the board, s, where several are given: operators
    record some seconds of each pose, and minutes of a board that is carried around."""
    min_poses: int = Field(default=3, ge=2)
    """Minimum number of bursts or sets of frames that show how a recording was made: two may be accidents, and two
    poses of the board do not calibrate a sensor."""
    min_rests: int = Field(default=12, ge=1)
    """Number of rests from which the captures are rests although the stamps show sets of frames of a moving board:
    a dozen poses calibrate a sensor, and frames of a board at rest are the better ones."""
    min_shared_rests: int = Field(default=5, ge=1)
    """Minimum number of rests in which two sensors detect the board, below which, and below half of the rests, the
    views rest because the board is out of them, if stamps show sets of frames: fewer calibrate no pair of
    sensors."""
    min_rest_share: float = Field(default=0.2, ge=0, le=1)
    """Share of the recording in which nothing moves, below which fewer rests than min_rests are those of a moving
    board, at start and end or where it is turned back: operators who hold the board still do so for half of the
    time."""
    max_spread_share: float = Field(default=0.35, gt=0, lt=0.5)
    """Maximum time between the stamps of a set of frames, where rig.yaml states none, over the shortest period of
    a sensor: sets of consecutive frames do not overlap, and triggers of cameras and drivers that read one camera
    after the other stay within it."""
    max_period_jitter: float = Field(default=0.05, gt=0)
    """Maximum median deviation of the pauses of a sensor over their median in a periodic stream: drivers keep
    their period within some percent; operators who take snapshots do not."""
    max_background_messages: int = Field(default=60, ge=1)
    """Maximum number of messages that a background is learned from: fast scanners send them in one or two
    seconds."""
