"""Settings of live capture. Times in s, distances in m. None changes what ``calgraph calibrate`` computes."""

import numpy as np
from pydantic import Field

from calgraph.config.strict_model import StrictModel


class ConnectionSettings(StrictModel):
    """Connections to live sources."""

    first_delay: float = Field(default=0.5, gt=0)
    """Delay of the first attempt to connect again, s; it doubles with each further one."""
    max_delay: float = Field(default=2.0, gt=0)
    """Maximum delay, s: an operator who has put a cable back waits no longer, and an attempt costs nothing."""
    open_timeout: float = Field(default=5.0, gt=0)
    """Time for the handshake of a connection, s; on a local network it takes milliseconds."""
    ping_interval: float = Field(default=2.0, gt=0)
    """Time between two questions whether the server is still there, s: without them, a robot that lost its power
    looks like one that has nothing to send."""
    ping_timeout: float = Field(default=10.0, gt=0)
    """Time for the answer, s; behind the frames that a slow wireless link still carries it may take seconds."""
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
    usual_intervals: int = Field(default=20, ge=3)
    """Number of last messages of a sensor whose stamps state its usual interval: their median."""
    gap_ratio: float = Field(default=3.5, gt=1)
    """Minimum ratio of a time between two stamps to the usual interval for the messages between to count as lost:
    drivers skip single ones without any fault."""
    min_gap: float = Field(default=0.05, ge=0)
    """Minimum time between two such stamps, s: stamps of fast sensors vary by the scheduling of computers."""
    alignment_time: float = Field(default=1.0, ge=0)
    """Time from the first message until the clocks of stamps and arrivals are compared, s: most sensors have sent
    messages, and one with a wrong clock does not decide alone."""
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
    max_chunk_bytes: int = Field(default=2**22, ge=1)
    """Size above which a chunk is written earlier, 4.2 MB: readers unpack a whole chunk for one message."""
    max_queued_bytes: int = Field(default=2**26, ge=1)
    """Maximum size of messages that wait for the disk, 67 MB: 18 s of five sensors with 220 MB a minute. While
    there are more, none is accepted, and the robot keeps or drops what follows."""
    sync_period: float = Field(default=5.0, ge=0)
    """Period at which the disk stores what it was given (``fsync``), s; 0: never. A computer that loses its power
    loses no more. Without it, the system collects data for half a minute, and slow disks then stall."""
    rate_window: float = Field(default=30.0, gt=0)
    """Time over which the rate is averaged that predicts when the disk is full, s: images vary over seconds."""


class PageSettings(StrictModel):
    """The operator's page, and what its server bears."""

    max_rate: float = Field(default=10.0, gt=0)
    """Maximum rate at which a page receives the state, Hz: as fast as a reader follows."""
    max_pages: int = Field(default=8, ge=1)
    """Maximum number of pages that are open: an operator's phone and laptop, and some who watch."""
    max_connections: int = Field(default=64, ge=1)
    """Maximum number of connections: a browser opens six for each page."""
    command_rate: float = Field(default=5.0, gt=0)
    """Commands per second that a page may send on average: no finger is faster for long."""
    command_burst: int = Field(default=20, ge=1)
    """Commands that a page may send in fast succession before the rate counts."""
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


class RestSettings(StrictModel):
    """Rest and motion of the board while it is recorded."""

    max_rate: float = Field(default=10.0, gt=0)
    """Maximum number of messages of a sensor per second whose change is measured, 1/s: a rest is noticed within
    0.1 s, and fast cameras leave time for the detection."""
    max_waiting: int = Field(default=20, ge=1)
    """Maximum number of messages of a sensor that wait for it: 2 s; older ones are skipped, and the next is
    compared with the last one measured."""
    noise_ratio: float = Field(default=2.5, gt=1)
    """Change over the median change of views at rest from which a view moves: noise of scanners reaches 1.8 times
    its median, and Otsu's threshold on simulated recordings lies between 2.2 and 2.6 times it."""
    min_change: float = Field(default=5e-4, gt=0)
    """Least share of a view that is motion: two blocks of an image of 640 x 480 pixels, whose noise changes
    none."""
    quiet_share: float = Field(default=0.25, gt=0, lt=1)
    """Share of the messages with operator whose changes show the noise: boards rest for a larger share of the
    time."""
    max_noise_growth: float = Field(default=4.0, ge=1)
    """Maximum ratio of this noise to that of the time without operator: a board and a person in view of a LiDAR
    triple it, and a board that moves all the time is no noise."""
    min_quiet: int = Field(default=10, ge=1)
    """Minimum number of messages of the time without operator that show the noise: 1 s."""
    min_separation: float = Field(default=0.7, gt=0)
    """Minimum difference of the mean logarithms (base 10) of the changes at rest and in motion, from which Otsu's
    threshold is taken, if it is above the noise: changes of views that only rest, or only move, differ by
    less."""
    min_messages: int = Field(default=60, ge=2)
    """Minimum number of messages for Otsu's threshold: 6 s of rest and motion."""
    settle: float = Field(default=0.2, ge=0)
    """Time from the last motion to the start of a capture, s: 0.1 s before the end of a move by 1 m the board is
    still 10 mm from its place, and moves no more than noise."""
    max_clock_difference: float = Field(default=1.0, gt=0)
    """Maximum difference of a sensor's latency, from the end of a measurement to its arrival, from that of the
    others, s, that is none of clocks: networks and drivers take some tenths."""
    silence: float = Field(default=2.0, gt=0)
    """Time without messages, s, after which a sensor is taken for silent; three periods of slow ones."""


class LiveCaptureSettings(StrictModel):
    """When captures are taken."""

    background: float = Field(default=5.0, gt=0)
    """Time at the start without board and operator, s, where rig.yaml states no window: scanners learn the room in
    it, and captures begin after it."""
    timeout: float = Field(default=10.0, gt=0)
    """Time after which a capture is refused because the board still moves, s: three moves to another pose."""
    max_replay_lead: float = Field(default=0.5, gt=0)
    """Time by which a replayed recording may be ahead of the detection before it waits, s: no rest of the board
    begins and ends in it. Robots do not wait."""
    min_distance: float = Field(default=0.1, gt=0)
    """Minimum distance of the board from its places in earlier captures for an automatic one, m: captures that are
    closer add little."""
    min_angle: float = Field(default=8.0, gt=0)
    """The same of its rotation, degrees."""
    covering_captures: int = Field(default=3, ge=1)
    """Number of captures after which a region of a view is covered: lenses and patches need several."""


class ViewSettings(StrictModel):
    """Pictures of the views with the detected board."""

    rate: float = Field(default=3.0, gt=0)
    """Maximum number of pictures of a sensor per second: operators see motion, and processes are free for
    captures."""
    width: int = Field(default=480, ge=16)
    """Width of a picture, px: that of a phone with two pictures beside each other; 15 kB as a JPEG."""
    quality: int = Field(default=60, ge=1, le=100)
    """Quality of the JPEG: lower ones blur outlines."""
    detection_width: int = Field(default=800, ge=16)
    """Minimum width of the images in which the board is searched for a picture, px: larger ones are reduced by a
    whole factor to no less, which takes a quarter of the time."""
    max_range: float = Field(default=5.0, gt=0)
    """Largest distance that pictures of scanners show, m: boards are carried nearer, and are well visible."""
    sharpness_ratio: float = Field(default=0.5, gt=0, lt=1)
    """Sharpness of an image over its median of late, below which it is blurred: rest and small boards change it
    by less."""
    sharpness_images: int = Field(default=60, ge=2)
    """Number of images that this median is of: 20 s."""


class LiveNetworkSettings(StrictModel):
    """The calibration of a network while it is recorded."""

    first: float = Field(default=8.0, gt=0)
    """Time from the first message to the first solution, s: two people have walked 20 m, and some scanners are
    connected."""
    pause: float = Field(default=2.0, ge=0)
    """Minimum time from the end of a solution to the next, s, so that there is something new."""
    max_load: float = Field(default=0.5, gt=0, le=1)
    """Maximum share of the time in which solutions are computed."""
    interval: float = Field(default=60.0, gt=0)
    """Length of the intervals that are tracked once, s. People who are in view at the end of one have two tracks,
    and those who stand still for half of one are part of its background."""
    overlap: float = Field(default=15.0, ge=0)
    """Time before an interval that is tracked with it, s, whose tracks are those of the one before: a scanner that
    is moved between the two has 10 s at rest before and after it."""
    min_interval: float = Field(default=10.0, gt=0)
    """Minimum time after the last of these intervals that is tracked, s: with the overlap 25 s, in half of which
    people do not stand still."""
    max_intervals: int = Field(default=4, ge=1)
    """Maximum number of intervals that are tracked before a solution, of sessions that are resumed: 10 s of
    work for ten scanners."""
    max_work: float = Field(default=20.0, gt=0)
    """Processor time of a solution, s, above which the next is computed from fewer intervals; those that add least
    are left out. Five scanners and two people need 2 s for each minute, 8 s where their legs are modelled."""
    walk_range: float = Field(default=8.0, gt=0)
    """Range within which scanners detect people reliably, m: nine beams of 0.5 degrees; more if they have tracked
    people farther away."""
    cell: float = Field(default=0.25, gt=0)
    """Width of the cells of the floor plan, m: half of a person's. Large plans have wider ones."""
    max_cells: int = Field(default=80, ge=10)
    """Maximum number of cells along the longer side of the floor plan: 4 px each on a phone."""
    min_walked: float = Field(default=0.5, gt=0)
    """Time that people spend within one cell's width of a cell from which it counts as walked, s: one passage at
    1.2 m/s takes 0.6 s."""
    min_area: float = Field(default=1.0, ge=0)
    """Minimum size of an area where people are asked to walk, m²."""
    max_wall_points: int = Field(default=1400, ge=10)
    """Maximum number of points of the static background in the floor plan: 14 kB."""
    max_minutes: float = Field(default=60.0, gt=0)
    """Longest time to the tolerance that is stated, min: longer extrapolations are guesses."""
    min_decay: float = Field(default=0.2, gt=0, lt=0.5)
    """Least exponent of the decay of standard deviations with the recorded time for which a time to the tolerance
    is stated: with 0.5 noise is averaged; close to zero more of the same does not help."""
    max_clock_difference: float = Field(default=1.0, gt=0)
    """Difference of a scanner's clock from the median of all, s, from which it is named: the calibration measures
    smaller ones."""


class AdviceSettings(StrictModel):
    """The next board pose that an operator is advised to take."""

    max_height_change: float = Field(default=0.6, gt=0)
    """Maximum height of the board's centre above or below the median of its heights until now, m: a person holds
    a board whose centre is at 1 m from the knees to above the head."""
    min_distance: float = Field(default=0.6, gt=0)
    """Minimum distance of the board's centre from every sensor, m: nearer, the robot is in the way."""
    repeat_distance: float = Field(default=0.25, gt=0)
    """Distance from the last suggestion, m, within which no other is made after a capture: more than operators
    miss it by, so that a suggestion whose board sensors did not detect is not repeated."""
    min_angle: float = Field(default=float(np.radians(5)), gt=0)
    """Smallest angle by which the picture asks for a board that is tilted or turned, rad (5°): a person holds it
    no more precisely."""


class LiveSettings(StrictModel):
    """Live capture."""

    advice: AdviceSettings = AdviceSettings()
    connection: ConnectionSettings = ConnectionSettings()
    recorder: RecorderSettings = RecorderSettings()
    network: LiveNetworkSettings = LiveNetworkSettings()
    page: PageSettings = PageSettings()
    ring: MessageRingSettings = MessageRingSettings()
    rest: RestSettings = RestSettings()
    capture: LiveCaptureSettings = LiveCaptureSettings()
    view: ViewSettings = ViewSettings()
    analysis_processes: int = Field(default=3, ge=1)
    """Maximum number of processes that detect; at least one core is left to the recorder and the page."""
