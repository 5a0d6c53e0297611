"""The settings of rig.yaml: what a user may want to set, with unit, meaning and reason.

Every other number is a constant above the function that reads it.
"""

import math
from typing import Any, Literal

from pydantic import Field, model_validator

from calgraph.config.former_settings import drop_former_settings
from calgraph.errors import InputError
from calgraph.io.strict_model import StrictModel

AveragingMethod = Literal["consensus", "l1mc", "triangles", "spectral", "irls"]
"""How pairs become poses: consensus over trees, or one of the published rotation averagings."""
CenterFeature = Literal["com", "ellipse", "nls"]
"""What is tracked of a person: centre of mass, direct ellipse, or ellipse of fixed radii (nls)."""
MatchFilter = Literal["ransac", "none"]
"""Matches that the joint solution uses: the inliers (``ransac``), or the first candidates of each capture."""
PlaneMethod = Literal["pnp", "mean_plane"]
"""A camera's plane of the board: one PnP over all corners of tags, or the paper's mean over tags."""
RigStart = Literal["tree", "identity", "consensus", "l1mc", "triangles", "spectral", "irls"]
"""Start poses of a rig's joint solution: a spanning tree, identity, or a method that averages all pairs."""
Weights = Literal["uniform", "weighted"]
"""Weights of pairs of scanners: all equal, or by their information."""
_OF_RIGS = ("keep", "start", "tags")
_OF_NETWORKS = ("average", "feature", "icp", "weights")


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


class MovingBoardSettings(StrictModel):
    """Synchronized frames of a moving board."""

    max_captures: int = Field(default=120, ge=1)
    """Maximum number of sets of frames that are used, spread over the recording: consecutive frames show almost
    the same pose, and each costs three detections a sensor."""
    max_speed: float = Field(default=3.0, gt=0)
    """Maximum speed of a board, m/s: operators walk and turn at half of it; more is a wrong detection."""


class CaptureSettings(StrictModel):
    """When the board rests, and which messages of a capture are used."""

    max_messages: MaxMessageSettings = MaxMessageSettings()
    moving_board: MovingBoardSettings = MovingBoardSettings()
    min_hold: float = Field(default=0.5, gt=0)
    """Minimum duration of a hold found by stillness, s: shorter rests are turning points of a moving board."""
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
    max_background_messages: int = Field(default=60, ge=1)
    """Maximum number of messages that a background is learned from: fast scanners send them in one or two
    seconds."""


class TagSettings(StrictModel):
    """AprilTags and the rectified views of them."""

    min_decision_margin: float = Field(default=5.0, ge=0)
    """Minimum decision margin of a tag without bit errors, grey values: image noise reaches 2.3."""
    half_resolution_above: int = Field(default=500_000, gt=0)
    """Images with more pixels are searched at half their resolution, at a ninth of the time: tags down to about
    20 pixels are found, and corners are refined at full resolution (RMS 0.06 instead of 0.05 px)."""


class CameraDetectionSettings(StrictModel):
    """The board in an image."""

    tags: TagSettings = TagSettings()


class ScannerDetectionSettings(StrictModel):
    """What the detections in scans and in clouds have in common."""

    min_depth_jump: float = Field(default=0.10, gt=0)
    """A return this far behind a surface, m, is not on it: range noise and mixed pixels of a board stay below."""


class Lidar2dDetectionSettings(StrictModel):
    """The board in scans of a 2-D scanner."""

    min_beams: int = Field(default=5, ge=3)
    """Minimum number of beams on a line: two parameters, and three residuals to reject outliers by."""
    min_length: float = Field(default=0.15, gt=0)
    """Minimum length of the board in the scan plane, m: shorter ones are legs and arms."""


class Lidar3dDetectionSettings(StrictModel):
    """The board in clouds of a 3-D LiDAR."""

    min_points: int = Field(default=20, ge=4)
    """Minimum number of points on the board: the standard deviation of its offset is then a quarter of that of a
    range."""
    min_rings: int = Field(default=3, ge=2)
    """Minimum number of rings on the board: two determine a plane without any residual."""
    min_range: float = Field(default=0.1, ge=0)
    """Shorter ranges, m, are returns from the housing or the robot, or mark missing beams."""


class CloudBackgroundSettings(StrictModel):
    """The background model of 3-D LiDARs."""

    voxel: float = Field(default=0.10, gt=0)
    """Edge of a voxel, m: five standard deviations of a range of 20 mm; the board is half a metre from walls."""


class CaptureBackgroundSettings(StrictModel):
    """The scene around a 3-D LiDAR without a background, learned from its captures."""

    min_captures: int = Field(default=8, ge=3)
    """Minimum number of captures from which the static scene is learned: with fewer, the time saved is small, and
    a board that stays in one place is soon in most of them. A large number turns it off."""


class DetectionSettings(StrictModel):
    """The target in the messages of one capture."""

    camera: CameraDetectionSettings = CameraDetectionSettings()
    scanner: ScannerDetectionSettings = ScannerDetectionSettings()
    lidar2d: Lidar2dDetectionSettings = Lidar2dDetectionSettings()
    lidar3d: Lidar3dDetectionSettings = Lidar3dDetectionSettings()
    cloud_background: CloudBackgroundSettings = CloudBackgroundSettings()
    capture_background: CaptureBackgroundSettings = CaptureBackgroundSettings()


class StationaritySettings(StrictModel):
    """The test whether a scanner stood still: windows of its scans are registered to each other."""

    min_duration: float = Field(default=10.0, gt=0)
    """Shortest time at rest from which a scanner is calibrated, s: people take 15 steps; if the last one is
    shorter, the longest is taken. Of a shorter recording, half is enough."""


class ClusterSettings(StrictModel):
    """Clusters of foreground beams."""

    max_merged_width: float = Field(default=1.4, gt=0)
    """Parts whose joint extent stays below this multiple of the target's width are one object: two legs, or both
    sides of an occluder; two people side by side are wider."""
    max_width: float = Field(default=1.8, gt=0)
    """Clusters wider than this multiple of the target's width are not one target: arms add half of the width."""


class MotionSettings(StrictModel):
    """Which identities are moving targets, and where their tracks are split."""

    min_duration: float = Field(default=0.5, gt=0)
    """Shortest track of a target, s: one step; flickering edges are shorter."""
    min_travel: float = Field(default=0.4, gt=0)
    """Shortest extent of a target's path, m: half a step; chairs and people who stand move less."""
    min_detections: int = Field(default=5, ge=2)
    """Minimum number of positions of a track: fewer determine a velocity, but not their scatter about it."""


class TrackingSettings(StrictModel):
    """Background, clusters, and the tracks of moving objects in one scanner."""

    stationarity: StationaritySettings = StationaritySettings()
    clusters: ClusterSettings = ClusterSettings()
    motion: MotionSettings = MotionSettings()
    acceleration_density: float = Field(default=0.5, gt=0)
    """Spectral density of a person's acceleration, m²/s³: 1 m/s² with a correlation time of half a second. It
    holds for tracks of one scanner and for the joint solution's paths."""


class BoardPairSettings(StrictModel):
    """Two sensors that detect one board."""

    max_stddev: float = Field(default=0.1, gt=0, allow_inf_nan=False)
    """Standard deviation of a direction, m and rad, above which refinement does not move it: with weaker data the
    step would be noise, and the pose from RANSAC is closer."""


class ClockMountingSettings(StrictModel):
    """The search for clock offsets, and for scanners that are mounted upside-down."""

    max_clock_offset: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    """Maximum clock offset that is searched, s: clocks set by hand, or drivers that stamp messages on arrival.
    Within it, people take different steps; beyond, they often walk where they have just been."""


class ScannerPairSettings(StrictModel):
    """Two scanners that track the same people."""

    clock_mounting: ClockMountingSettings = ClockMountingSettings()


class PairwiseSettings(StrictModel):
    """Relative poses of two sensors."""

    board: BoardPairSettings = BoardPairSettings()
    scanners: ScannerPairSettings = ScannerPairSettings()


class IntrinsicsSettings(StrictModel):
    """Intrinsics of cameras that have none in rig.yaml or the recording."""

    min_views: int = Field(default=5, ge=3)
    """Minimum number of views of boards: three determine a focal length and a principal point (Zhang, 2000), and
    two more test them."""
    max_views: int = Field(default=60, ge=10)
    """Maximum number of views that are used, spread over image, size and tilt: the standard deviations of
    intrinsics fall with the root of their number, and the time is proportional to it."""
    good_focal_length_error: float = Field(default=0.005, gt=0)
    """Relative standard deviation of the focal length up to which intrinsics are called good: half the default
    prior of stated ones."""
    good_principal_point_error: float = Field(default=0.002, gt=0)
    """The same of the principal point, in diagonals of the image: 1.6 px of 640 by 480 pixels, a sixth of the
    default prior of stated ones. Narrow lenses reach it with boards
    that are near and tilted, as a displaced principal point looks like a rotation of the camera."""
    good_border_error: float = Field(default=3.0, gt=0)
    """Standard deviation, pixels, of the projection at the border of the image, after the best rotation, up to
    which intrinsics are called good: half the default prior of stated distortion."""


class LegSettings(StrictModel):
    """People whose legs are measured."""

    max_height: float = Field(default=0.65, gt=0)
    """Height of the scan plane below which people are measured as two legs, m, where it is stated: above the knee,
    clothes join the thighs."""


class NetworkEstimationSettings(StrictModel):
    """The joint estimate of a network of scanners."""

    max_kept_bytes: int = Field(default=2**29, ge=0)
    """Memory of a process for the beams of tracks, of people, and for people and their equations between the steps
    of the joint solution, 0.5 GB each; what is beyond it is in temporary files. Influences no result. Workers of a
    cluster have ``cluster.worker_memory`` for the last of them."""
    legs: LegSettings = LegSettings()


class EstimationSettings(StrictModel):
    """The joint estimators."""

    intrinsics: IntrinsicsSettings = IntrinsicsSettings()
    network: NetworkEstimationSettings = NetworkEstimationSettings()


class PublishedSettings(StrictModel):
    """Single steps of calgraph's method or the papers', instead of those that the estimator implies.

    Without a value, a key follows the estimator: ``joint`` is calgraph's method, ``published`` the paper's.
    """

    estimator: Literal["bundle", "hypergraph", "joint", "averaging"] | None = None
    """The last step. Rigs: bundle (joint) or hypergraph (published). Networks: joint, or averaging (published),
    which ends with the average of pairs, as the paper does."""
    keep: MatchFilter | None = None
    """Rigs: matches of two sensors that are used, the inliers (ransac, as in the paper) or all (none), as in
    figure 5c of the paper."""
    start: RigStart | None = None
    """Rigs: start poses of the joint solution: tree (as in the paper), identity, or a method that averages all
    pairs, which one wrong pair misleads less than a tree."""
    tags: PlaneMethod | None = None
    """Rigs: a camera's plane of the board: one PnP over all corners (pnp, calgraph's), or the mean over tags
    (mean_plane, the paper's), which is less accurate."""
    average: AveragingMethod | None = None
    """Networks: averaging of pairwise poses: consensus (calgraph's), l1mc (the paper's), triangles, spectral or
    irls, which the paper compares."""
    feature: CenterFeature | None = None
    """Networks: centre of a tracked object: the ellipse of fixed radii (nls, calgraph's), a direct fit (ellipse,
    the paper's), or the centre of mass (com), which lies before the true centre."""
    icp: bool | None = None
    """Networks: whether static backgrounds (walls) are registered as well; both methods do so, since people may
    walk on one line."""
    weights: Weights | None = None
    """Networks: weights of pairs: their information (weighted, calgraph's), or uniform, which is sufficient for
    the paper's average below half of outliers."""

    def check_kind(self, *, is_network: bool) -> None:
        """Checks that no key of the other kind of target is stated.

        Args:
            is_network: whether the target is people or a cylinder, instead of a board.

        Raises:
            InputError: there is one.
        """
        others, kind = (_OF_RIGS, "rigs with a board") if is_network else (_OF_NETWORKS, "networks")
        if stated := [f"published.{key}" for key in others if getattr(self, key) is not None]:
            raise InputError(f"{', '.join(stated)}: only for {kind}")


class VerdictSettings(StrictModel):
    """The grade of a sensor's pose by its standard deviations."""

    tolerance_confidence: float = Field(default=0.95, gt=0, lt=1)
    """Probability with which the error along or about an axis of a good pose is within the tolerance of rig.yaml;
    the usual level of data sheets and of error bars: 1.96 standard deviations."""
    unobservable_translation_stddev: float = Field(default=0.2, gt=0)
    """m; beyond it an axis is called unobservable: a tape measure is more accurate."""
    unobservable_rotation_stddev: float = Field(default=math.radians(10), gt=0)
    """rad (10°); the same about an axis. At this size first-order covariances cease to be valid."""
    max_normalized_rms: float = Field(default=3.0, gt=1)
    """A sensor is inconsistent if the RMS residual of all its pairs exceeds the expected noise by this factor,
    whose values in rig.yaml are often wrong by a factor of two."""
    false_alarm_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Probability with which a test of given poses (check, priors, rigid groups) rejects one that is right. One
    value for all of them: a false alarm costs one look at a sensor, so that 1 in 1000 sensors is rare enough."""


class DriftTestSettings(StrictModel):
    """Linear changes of the poses of a rig's sensors in the course of the captures."""

    translation: float = Field(default=1e-4, gt=0)
    """m; standard deviation of the small drift that every sensor has, along each axis: aluminium of 1 m that warms
    by 4 K expands by 0.1 mm."""
    rotation: float = Field(default=math.radians(0.01), gt=0)
    """rad (0.01°); the same about each axis: 0.1 mm over 0.6 m, the distance of a bracket's screws from its end.
    Drifts of this size and more that no test can find are an error of the pose at the end of the recording."""


class RigDiagnosticsSettings(StrictModel):
    """Tests of a rig's calibration."""

    max_bootstrap_captures: int = Field(default=15, ge=1)
    """Captures from which on a calibration does without a bootstrap."""
    suggestions: int = Field(default=3, ge=0)
    """Maximum number of board poses suggested; each is planned in addition to those before it."""


class DiagnosticsSettings(StrictModel):
    """Verdicts and tests of the result."""

    verdict: VerdictSettings = VerdictSettings()
    drifts: DriftTestSettings = DriftTestSettings()
    rig: RigDiagnosticsSettings = RigDiagnosticsSettings()


class LimitSettings(StrictModel):
    """Limits of what is read, checked before memory or disk is taken; they refuse, and influence no result.

    Small damaged files may state or unpack to any size; files of real sensors stay far below.
    """

    max_image_pixels: int = Field(default=2**28, ge=1)
    """Maximum number of pixels of an image, 16,384 squared: 0.8 GB in colour. A third of it in
    progressive JPEGs, whose decoder needs three times the memory. Cameras have up to 150 million."""
    max_points: int = Field(default=2**24, ge=1)
    """Maximum number of points of a cloud or beams of a scan, 16.8 million: 1 GB while it is read. Sweeps of
    LiDARs with 128 rings have half a million; merged scans of surveyors may have more."""
    max_unpacked_bytes: int = Field(default=2**28, ge=1)
    """Maximum size of a compressed message, file of one message, or chunk of a bag once it is unpacked, 268 MB: 16
    million points of 16 bytes. Recorders write chunks of 1 to 8 MB."""
    max_overlapping_bytes: int = Field(default=2**30, ge=1)
    """Maximum size of the chunks of an MCAP that overlap in time once they are unpacked, 1.1 GB: they are in
    memory together. Recorders write one chunk after the other, and converters one for each topic."""
    max_archive_bytes: int = Field(default=2**29, ge=1)
    """Maximum size of all members of a problem.npz or scene.npz once unpacked, 537 MB: those of the largest rigs
    and networks that were tried have some 100 MB."""
    min_free_disk: int = Field(default=2**30, ge=0)
    """Minimum space that a compressed storage file (``.mcap.zstd``, ``.db3.zstd``) leaves on the disk of temporary
    files when it is unpacked there, 1.1 GB: other programs need some."""
    url_timeout: float = Field(default=60.0, gt=0)
    """Time without data after which the server of a URL is given up, s: busy stores answer within seconds. For S3
    and HTTP; other protocols have their own."""
    max_copy_age: float = Field(default=86400.0, ge=0)
    """Time after which an unused copy of a recording from a URL is removed from the disk of temporary files, s: a
    day, in which runs with other options find it."""


class DaskSettings(StrictModel):
    """Calls on a cluster of Dask. None changes a result; scheduler and workers have their own configuration."""

    connect_timeout: float = Field(default=10.0, gt=0)
    """Time in which a scheduler must answer, s; on a local network it takes milliseconds."""
    worker_timeout: float = Field(default=120.0, gt=0)
    """Time in which the first worker must be there, s: cloud machines and queues of batch systems take minutes."""
    retries: int = Field(default=2, ge=0)
    """Repetitions of a call that ends with an error, 2: reading over networks sometimes fails. Repetitions because
    a worker was lost do not count."""
    max_lost_workers: int = Field(default=3, ge=0)
    """Workers of this machine that may be lost one after the other by the same call, 3: it probably needs more
    memory than there is. Schedulers elsewhere have this limit as ``distributed.scheduler.allowed-failures``."""
    calls_ahead: int = Field(default=4, ge=1)
    """Calls of a stream that are submitted for each worker, 4: the arguments of the next ones are sent while it
    works. They are in the memory of the scheduler."""
    worker_memory: float | None = Field(default=None, gt=0)
    """Memory of each worker of this machine, 10⁹ bytes: values that calls keep are moved to disk above 60 % of it,
    and a worker is started again above 95 %. Unlimited by default: values on disk are slow. Other clusters have
    their own limits."""


class ConnectionSettings(StrictModel):
    """Connections to live sources."""

    open_timeout: float = Field(default=5.0, gt=0)
    """Time for the handshake of a connection, s; on a local network it takes milliseconds."""
    max_frame_bytes: int = Field(default=2**27, ge=1)
    """Maximum size of a frame of a server, 134 MB: a larger one ends the connection. Raw images of 20 megapixels
    have 60 MB."""
    max_queue_bytes: int = Field(default=2**26, ge=1)
    """Maximum size of the messages that are received and wait to be recorded, 67 MB: 4 s of 1 GB a minute. Further
    ones are counted as lost."""
    discovery_time: float = Field(default=3.0, gt=0)
    """Time after which a wanted topic that is not served is reported, s: bridges advertise topics some 100 ms
    after a connection, and DDS finds them within 2 s."""
    silence: float = Field(default=5.0, gt=0)
    """Time without a message after which a topic is reported, s; sensors send several each second."""
    max_clock_offset: float = Field(default=1.0, gt=0)
    """Maximum difference of stamps from arrivals that is latency, s; above, arrivals are given by the clock of the
    stamps."""
    notice_interval: float = Field(default=1.0, ge=0)
    """Minimum time between two notices of one kind and topic, s; those between are counted."""


class RecorderSettings(StrictModel):
    """Recording of live messages."""

    max_chunk_duration: float = Field(default=0.5, gt=0)
    """Maximum time from the arrival of a message until it is written to its file, s: a program that is killed
    loses no more, and each chunk costs an index of some 300 bytes."""
    max_queued_bytes: int = Field(default=2**26, ge=1)
    """Maximum size of messages that wait for the disk, 67 MB: 18 s of five sensors with 220 MB a minute. While
    there are more, none is accepted, and the robot keeps or drops what follows."""
    sync_period: float = Field(default=5.0, ge=0)
    """Period at which the disk stores what it was given (``fsync``), s; 0: never. A computer that loses its power
    loses no more. Without it, the system collects data for half a minute, and slow disks then stall."""


class LiveNetworkSettings(StrictModel):
    """The calibration of a network while it is recorded."""

    first: float = Field(default=8.0, gt=0)
    """Time from the first message to the first solution, s: two people have walked 20 m, and some scanners are
    connected."""
    interval: float = Field(default=60.0, gt=0)
    """Length of the intervals that are tracked once, s. People who are in view at the end of one have two tracks,
    and those who stand still for half of one are part of its background."""
    max_minutes: float = Field(default=60.0, gt=0)
    """Longest time to the tolerance that is stated, min: longer extrapolations are guesses."""


class PageSettings(StrictModel):
    """The operator's page, and what its server bears."""

    max_pages: int = Field(default=8, ge=1)
    """Maximum number of pages that are open: an operator's phone and laptop, and some who watch."""
    max_connections: int = Field(default=64, ge=1)
    """Maximum number of connections: a browser opens six for each page."""
    heartbeat: float = Field(default=2.0, gt=0)
    """Time without a change after which a page receives an empty message, s; silence means a lost link."""
    timeout: float = Field(default=10.0, gt=0)
    """Time after which a page that neither answers nor accepts data is disconnected, s; it connects again."""


class MessageRingSettings(StrictModel):
    """The messages that are kept in memory until a capture needs them."""

    max_seconds: float = Field(default=20.0, gt=0)
    """Time after which messages are dropped, s: two sweeps of the slowest scanners (4 s), and the time until the
    board is known to have rested, twice."""
    max_bytes: int = Field(default=2**27, ge=1)
    """Maximum size of the messages of all sensors, 134 MB: 37 s at 220 MB a minute. Sensors that send more have
    captures that begin later in a rest."""


class LiveCaptureSettings(StrictModel):
    """When captures are taken."""

    background: float = Field(default=5.0, gt=0)
    """Time at the start without board and operator, s, where rig.yaml states no window: scanners learn the room in
    it, and captures begin after it."""
    timeout: float = Field(default=10.0, gt=0)
    """Time after which a capture is refused because the board still moves, s: three moves to another pose."""
    min_distance: float = Field(default=0.1, gt=0)
    """Minimum distance of the board from its places in earlier captures for an automatic one, m: captures that are
    closer add little."""
    min_angle: float = Field(default=8.0, gt=0)
    """The same of its rotation, degrees."""


class LiveSettings(StrictModel):
    """Live capture."""

    connection: ConnectionSettings = ConnectionSettings()
    recorder: RecorderSettings = RecorderSettings()
    network: LiveNetworkSettings = LiveNetworkSettings()
    page: PageSettings = PageSettings()
    ring: MessageRingSettings = MessageRingSettings()
    capture: LiveCaptureSettings = LiveCaptureSettings()
    analysis_processes: int = Field(default=3, ge=1)
    """Maximum number of processes that detect; at least one core is left to the recorder and the page."""


class Settings(StrictModel):
    """The key ``settings`` of rig.yaml, stage by stage."""

    captures: CaptureSettings = CaptureSettings()
    detection: DetectionSettings = DetectionSettings()
    tracking: TrackingSettings = TrackingSettings()
    pairwise: PairwiseSettings = PairwiseSettings()
    estimation: EstimationSettings = EstimationSettings()
    published: PublishedSettings = PublishedSettings()
    diagnostics: DiagnosticsSettings = DiagnosticsSettings()
    limits: LimitSettings = LimitSettings()
    cluster: DaskSettings = DaskSettings()
    live: LiveSettings = LiveSettings()

    @model_validator(mode="before")
    @classmethod
    def _accept_former(cls, content: Any) -> Any:
        """Files of earlier versions state all numbers that were settings then."""
        return drop_former_settings(content)
