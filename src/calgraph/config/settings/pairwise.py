"""Settings of relative poses of two sensors."""

from calgraph.config.strict_model import StrictModel


class BoardPairSettings(StrictModel):
    """Two sensors that detect one board."""


class ScannerPairSettings(StrictModel):
    """Two scanners that track the same people."""


class PairwiseSettings(StrictModel):
    """Relative poses of two sensors."""

    board: BoardPairSettings = BoardPairSettings()
    scanners: ScannerPairSettings = ScannerPairSettings()
