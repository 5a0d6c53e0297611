"""All settings, stage by stage: the key ``settings`` of rig.yaml."""

from calgraph.config.settings.baselines import BaselineSettings
from calgraph.config.settings.captures import CaptureSettings
from calgraph.config.settings.dask import DaskSettings
from calgraph.config.settings.detection import DetectionSettings
from calgraph.config.settings.diagnostics import DiagnosticsSettings
from calgraph.config.settings.estimation import EstimationSettings
from calgraph.config.settings.graph import GraphSettings
from calgraph.config.settings.limits import LimitSettings
from calgraph.config.settings.live import LiveSettings
from calgraph.config.settings.pairwise import PairwiseSettings
from calgraph.config.settings.published import PublishedSettings
from calgraph.config.settings.tracking import TrackingSettings
from calgraph.config.strict_model import StrictModel


class Settings(StrictModel):
    """The numbers that influence a result, stage by stage."""

    captures: CaptureSettings = CaptureSettings()
    detection: DetectionSettings = DetectionSettings()
    tracking: TrackingSettings = TrackingSettings()
    pairwise: PairwiseSettings = PairwiseSettings()
    graph: GraphSettings = GraphSettings()
    estimation: EstimationSettings = EstimationSettings()
    published: PublishedSettings = PublishedSettings()
    baselines: BaselineSettings = BaselineSettings()
    diagnostics: DiagnosticsSettings = DiagnosticsSettings()
    limits: LimitSettings = LimitSettings()
    cluster: DaskSettings = DaskSettings()
    live: LiveSettings = LiveSettings()
