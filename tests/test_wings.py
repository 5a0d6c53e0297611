"""Which modules a wing imports: those of the other wing, of reports and of the papers' estimators are left out."""

import subprocess
import sys

import pytest

UNUSED = ("calgraph.report", "calgraph.simulation", "plotly", "scipy.ndimage", "scipy.stats", "pandas")


def import_alone(modules: str) -> list[str]:
    """The modules that a new process has after importing some."""
    code = f"import sys, {modules}; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.split()


@pytest.mark.parametrize(("wing", "others"), [("rig", ("network", "drive")), ("network", ("rig", "drive"))])
def test_a_wing_is_used_without_the_others(wing: str, others: tuple[str, str]) -> None:
    imported = import_alone(f"calgraph.{wing}, calgraph.{wing}.pipeline, calgraph.calibration.dispatch")
    assert f"calgraph.{wing}.checks" in imported
    unused = (*(f"calgraph.{other}" for other in others), f"calgraph.{wing}.published")
    assert [name for name in imported if f"{name}.".startswith(tuple(f"{one}." for one in unused))] == []


def test_a_rig_is_calibrated_without_modules_of_plots_and_tables() -> None:
    imported = import_alone("calgraph.cli.calibrate, calgraph.rig.pipeline")
    assert [name for name in imported if name.startswith(UNUSED)] == []
