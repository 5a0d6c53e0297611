"""``calgraph inspect``: the topics of a recording, and anomalies."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from calgraph.cli.common_options import OneRecording
from calgraph.cli.console import console, make_table
from calgraph.cli.init import find_background, find_mode
from calgraph.cli.printing import print_budget, print_calibration, print_pair_budget, print_provenance
from calgraph.cli.progress import progress_bars
from calgraph.cli.setting_options import SetOption, parse_limits
from calgraph.config import explain_unused
from calgraph.errors import RecordingError
from calgraph.io.text_writing import format_json
from calgraph.recording import (
    Inspection,
    TopicReport,
    correct_stamps,
    find_topics,
    inspect_recording,
    open_recording,
)
from calgraph.result import Calibration, ErrorBudget, load_calibration, load_pair_budget, to_json
from calgraph.rig.captures.capture_mode import RecognizedMode
from calgraph.sensors.kinds import KINDS


def inspect(
    recording: OneRecording,
    overrides: SetOption = None,
    pair: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="A B",
            help="Of a result: only what the uncertainty of sensor B relative to sensor A comes from.",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Show the topics of a recording, or how a result was computed.

    Of a recording: counts, rates, gaps, frames, clocks, and anomalies. Of a result, the folder that calibrate
    wrote: version, command, inputs, poses, and what their uncertainty comes from.

    Exit code 2: the recording is damaged; the readable part is shown.
    """
    result = Path(recording) / "calibration.yaml"
    if pair:
        show_pair(Path(recording), *pair, json=json)
        return
    if result.is_file():
        show_result(load_calibration(result), json=json)
        return
    with open_recording(recording, parse_limits(overrides, alone=True)) as opened, progress_bars() as progress:
        inspection = inspect_recording(opened, partial(progress, "reading"))
        topics = () if inspection.damage else find_topics(opened)
        unused = explain_unused(topics)
        by_one_clock = correct_stamps(opened, inspection.clock_offsets)
        mode = find_mode(by_one_clock, topics, find_background(by_one_clock, topics, ()))
    if json:
        captures = {"captures": {"mode": mode.mode, "reason": mode.reason} if mode else None, "unused": unused}
        typer.echo(format_json({"recording": recording, **asdict(inspection), **captures}))
    else:
        _print(recording, inspection, mode, unused)
    if inspection.damage:
        raise RecordingError(inspection.damage)


def show_result(calibration: Calibration, *, json: bool) -> None:
    """Prints how a calibration was computed, and its poses."""
    if json:
        typer.echo(to_json(calibration))
        return
    if calibration.provenance:
        print_provenance(calibration.provenance)
    print_calibration(calibration)
    print_budget(calibration)


def show_pair(result: Path, a: str, b: str, *, json: bool) -> None:
    """Prints what the errors of the pose of sensor b relative to sensor a come from, of a folder of results."""
    calibration = load_calibration(result)
    sources, covariance = load_pair_budget(result / "budget.csv", calibration, a, b)
    budget = ErrorBudget.of_poses(sources, covariance, [calibration.transform(a, b)])
    if not json:
        print_pair_budget(budget, a, calibration[b])
        return
    parts = [
        {"source": source.kind, "of": source.of, "stddev": stddev, "covariance": covariance}
        for source, stddev, covariance in zip(sources, budget.stddev[:, 0], covariance, strict=True)
    ]
    typer.echo(format_json({"pair": [a, b], "budget": parts}))


def _print(recording: str, inspection: Inspection, mode: RecognizedMode | None, unused: Mapping[str, str]) -> None:
    output = console()
    duration = f"{inspection.duration:.1f} s, " if any(topic.timing for topic in inspection.topics) else ""
    title = f"{recording}: {duration}{sum(t.count for t in inspection.topics)} messages"
    output.print(f"[bold]{escape(title)}[/]")
    times = ("Hz", "jitter\nms", "gap\ns", "start\ns", "delay\nms") if duration else ()
    rows = ((escape(topic.name), str(topic.count), *_times(topic)) for topic in inspection.topics)
    output.print(make_table(["topic"], ("count", *times), rows, gap=2))
    if duration:
        output.print("gap: longest time between stamps; delay: median arrival minus stamp")
    for topic in inspection.topics:
        output.print(f"[bold]{escape(topic.name)}[/]: {escape(_describe(topic, unused.get(topic.name, '')))}")
    if mode:
        output.print(f"captures: {escape(f'{mode.mode}: {mode.reason}')}")
    findings = [(topic.name, finding) for topic in inspection.topics for finding in topic.findings]
    for name, finding in findings:
        output.print(f"[yellow]![/] {escape(f'{name}: {finding}')}")
    for notice in inspection.notices:
        output.print(f"[yellow]![/] {escape(notice)}")
    if not (findings or inspection.notices or inspection.damage):
        output.print("No anomalies were found.")


def _describe(topic: TopicReport, unused: str) -> str:
    """Type, kind, frame and content of the first message; the whole type of topics that are not used, and why."""
    frame = f"frame {topic.frame_id}" if topic.frame_id else ""
    shown_type = topic.type if unused else topic.type.rpartition("/")[2]
    kind = topic.kind if topic.kind in KINDS else ""
    numbers = "poses {} to {}".format(*topic.pose_numbers) if topic.pose_numbers else ""
    # Anomalies are printed below.
    why = f"not used: {unused}" if unused and unused not in topic.findings else ""
    return ", ".join(
        dict.fromkeys(text for text in (shown_type, kind, frame, topic.content, numbers, why) if text)
    )


def _times(topic: TopicReport) -> Sequence[str]:
    timing = topic.timing
    if timing is None:
        return ()
    return (
        _number(timing.rate, 2),
        _number(timing.jitter, 1, 1000),
        _number(timing.longest_gap, 2),
        _number(timing.start, 2),
        _number(timing.delay[1], 1, 1000),
    )


def _number(value: float | None, digits: int, scale: float = 1) -> str:
    return "" if value is None else f"{scale * value:.{digits}f}"
