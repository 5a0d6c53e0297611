"""Which modules the calibration of a rig imports."""

import subprocess
import sys

_UNUSED = (
    "calgraph.estimation.network", "calgraph.diagnostics.network", "calgraph.tracking", "calgraph.baselines",
    "calgraph.report", "calgraph.simulation", "plotly", "scipy.ndimage", "scipy.stats", "pandas",
)  # fmt: skip


def test_a_rig_is_calibrated_without_modules_of_networks_baselines_and_plots() -> None:
    code = "import sys, calgraph.cli.calibrate, calgraph.rig.pipeline; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = run.stdout.split()
    assert "calgraph.estimation.rig" in imported
    assert [name for name in imported if name.startswith(_UNUSED)] == []
