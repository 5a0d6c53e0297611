"""What the operator is shown of a rig's session."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.live.capture_finder import name_sensors
from calgraph.live.capture_taker import CaptureTaker
from calgraph.live.live_captures import count_coverage
from calgraph.live.message_analysis import MessageAnalysis
from calgraph.live.rig_solution import LiveSolution, SensorSolution
from calgraph.live.state import Phase, SensorState, SessionState


def describe_rig_session(
    rig: Rig,
    source: str,
    analysis: MessageAnalysis,
    taker: CaptureTaker,
    solution: LiveSolution | None,
    solutions: int,
    problem: str,
) -> SessionState:
    """The state of a session.

    Args:
        rig: of the session.
        source: name of the source.
        analysis: of its messages.
        taker: of its captures.
        solution: the last one; None before the first.
        solutions: number of solutions so far.
        problem: what keeps the session from working; empty if nothing does.
    """
    solved = {one.name: one for one in solution.sensors} if solution else {}
    done = bool(solution and solution.done)
    problems = taker.finder.find_problems()
    phase, headline = _describe_phase(analysis, taker)
    return SessionState(
        kind="rig",
        phase=phase,
        headline=problem
        or ("All sensors are within tolerance: finish" if done and phase == "ready" else headline),
        source=source,
        automatic=taker.automatic,
        root=rig.root,
        sensors=tuple(
            _describe_sensor(name, rig, analysis, taker, problems, solved.get(name)) for name in rig.sensors
        ),
        captures=len(taker.captures),
        event=taker.event,
        advice=solution.advice if solution else None,
        tolerance_mm=1000 * rig.tolerance.translation,
        tolerance_degrees=rig.tolerance.rotation,
        done=done,
        scene=solutions,
    )


def _describe_phase(analysis: MessageAnalysis, taker: CaptureTaker) -> tuple[Phase, str]:
    unheard = [name for name in analysis.sensors if analysis.timeline.age(name) is None]
    waiting = taker.waiting
    if unheard:
        return "connecting", f"Waiting for messages of {name_sensors(unheard)}"
    if analysis.background_left:
        return "background", f"Stay out of view: {np.ceil(analysis.background_left):.0f} s to learn the room"
    if waiting.problem:
        return "ready", f"No captures are possible: {waiting.problem}"
    if taker.searching:
        return "measuring", "Searching for the board"
    if waiting.phase == "measuring" and (taker.requested or taker.automatic):
        names = name_sensors(waiting.sensors)
        return "measuring", f"Hold still: {names} measuring" if names else "Hold still"
    if taker.requested:
        moving = f" (motion in {name_sensors(waiting.sensors)})" if waiting.sensors else ""
        return "waiting", f"Hold the board still{moving}, or press again to capture while it moves"
    if taker.automatic:
        return "ready", "Hold the board still in a new pose"
    return "ready", "Hold the board still and press the button"


def _describe_sensor(
    name: str,
    rig: Rig,
    analysis: MessageAnalysis,
    taker: CaptureTaker,
    problems: Mapping[str, str],
    solved: SensorSolution | None,
) -> SensorState:
    timeline, activity = analysis.timeline, analysis.sensors[name]
    age = timeline.age(name)
    problem = problems.get(name, "")
    if activity.malformed and not problem:
        problem = f"{activity.malformed} unusable messages: {activity.problem}"
    stddev = None if solved is None or name == rig.root else np.asarray(solved.stddev)
    known = stddev is not None and bool(np.isfinite(stddev).all())
    view = activity.view
    return SensorState(
        name=name,
        kind=rig.sensors[name].kind,
        rate=timeline.rate(name),
        age=age,
        problem=problem,
        sees_board=view.sees_board if view else None,
        reason=activity.explain_view(),
        moving=analysis.rests.is_moving(name),
        captures=sum(name in capture.sensors for capture in taker.captures),
        coverage=count_coverage(name, rig, analysis.detectors.cameras.get(name), taker.captures),
        stddev_mm=1000 * float(stddev[:3].max()) if known and stddev is not None else None,
        stddev_degrees=float(np.degrees(stddev[3:].max())) if known and stddev is not None else None,
        progress=solved.progress if solved else 0.0,
        grade=solved.grade if solved else "",
        picture=activity.pictures,
    )
