"""The report: one self-contained page with the verdicts first, robust to any text and number."""

import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from calgraph.config import Rig, Tolerance
from calgraph.errors import InputError
from calgraph.report import write_report
from calgraph.report.page import render_report
from calgraph.result import (
    BoardOutline,
    Calibration,
    CaptureRow,
    Edge,
    FitError,
    HeldOutError,
    InputFile,
    Pictures,
    Provenance,
    Suggestion,
    Verdict,
)

VOID = {"meta", "br", "input", "link", "img"}


class Page(HTMLParser):
    """The parsed page: elements with their attributes, and the text outside of scripts."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.mismatches: list[str] = []
        self.figures: dict[str, dict[str, Any]] = {}
        # Megabytes of one script, which a browser does not look into for elements either.
        self.feed(html.replace(get_plotlyjs(), ""))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.mismatches.append(tag)

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            name = self.elements[-1][1].get("data-for")
            if name is not None:
                self.figures[name] = json.loads(data)
        elif self.open and self.open[-1] != "style":
            self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    def count(self, tag: str, css: str) -> int:
        return sum(t == tag and css in (a.get("class") or "").split() for t, a in self.elements)


@pytest.fixture
def page(calibration: Calibration, rig: Rig) -> Page:
    return Page(render_report(calibration, rig))


def test_the_file_is_written_whole_and_below_6_mb(calibration: Calibration, rig: Rig, tmp_path: Path) -> None:
    write_report(calibration, rig, tmp_path / "report.html")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").stat().st_size < 6e6


def test_a_missing_folder_is_named(calibration: Calibration, rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its folder does not exist"):
        write_report(calibration, rig, tmp_path / "none" / "report.html")


def test_nothing_is_loaded_from_elsewhere(page: Page) -> None:
    loading = {"src", "href", "xlink:href", "srcset", "data", "action"}
    addresses = [v for _, attributes in page.elements for k, v in attributes.items() if k in loading]
    assert all(address is not None and address.startswith("#") for address in addresses)


def test_styles_load_nothing(calibration: Calibration, rig: Rig) -> None:
    head, _, _ = render_report(calibration, rig).partition("</head>")
    (style,) = re.findall(r"<style>(.*?)</style>", head, flags=re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style


def test_plotly_is_in_the_page_once(calibration: Calibration, rig: Rig) -> None:
    assert len(re.findall(r"\* plotly\.js v", render_report(calibration, rig))) == 1


@pytest.mark.parametrize("which", ["calibration", "ugly", "bare"])
def test_elements_are_nested_well(which: str, rig: Rig, request: pytest.FixtureRequest) -> None:
    page = Page(render_report(request.getfixturevalue(which), rig))
    assert (page.mismatches, page.open) == ([], [])


def test_every_link_within_the_page_has_its_target(page: Page) -> None:
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    assert {a["href"] for t, a in page.elements if t == "a"} <= {f"#{name}" for name in ids}


def test_every_figure_has_its_place(page: Page) -> None:
    ids = {a.get("id") for _, a in page.elements}
    assert set(page.figures) <= ids
    assert {"rig", "captures", "residuals-0", "residuals-2"} <= set(page.figures)


def test_the_headline_summarizes_the_grades(page: Page) -> None:
    assert "3 of 4 sensors are calibrated well: 1 weak." in page.words


def test_the_page_states_the_tolerance(calibration: Calibration, rig: Rig, page: Page) -> None:
    assert "within the tolerance of 10 mm and 0.3°" in page.words
    coarse = rig.model_copy(update={"tolerance": Tolerance(translation=0.05, rotation=2)})
    assert "95 %, the error of the pose along and about each axis is within the tolerance of 50 mm and 2°" in (
        render_report(calibration, coarse)
    )


def test_the_headline_of_a_good_result(calibration: Calibration, rig: Rig) -> None:
    good = tuple(dataclasses.replace(s, verdict=Verdict("good")) for s in calibration.sensors)
    html = render_report(dataclasses.replace(calibration, sensors=good), rig)
    assert "<h1>Every sensor is calibrated well.</h1>" in html


def test_sensors_that_need_attention_come_first(page: Page) -> None:
    cards = page.words[: page.words.index("Sensor graph An edge")]
    assert cards.index("laser_low") < cards.index("camera")
    assert "Height (z) is known to ± 80 mm only: hold the board leaning" in cards


def test_cards_state_the_worst_deviation(page: Page) -> None:
    assert "σ of the pose 80 mm, 0.99° captures used" in page.words


def test_cards_state_the_residual_in_the_unit_of_the_sensor(calibration: Calibration, rig: Rig) -> None:
    fit = {"camera": FitError(320, "px", 0.412), "laser": FitError(900, "m", 0.0078)}
    held_out = {
        "camera": HeldOutError(20, "px", 0.53, 0.4, 1.1),
        "laser": HeldOutError(20, "m", 0.0091, 0.005, 1.0),
    }
    evidence = dataclasses.replace(calibration.evidence, fit=fit, cross_validation=held_out)
    words = Page(render_report(dataclasses.replace(calibration, evidence=evidence), rig)).words
    assert "reprojection error 0.41 px RMS on held-out captures 0.53 px RMS captures used" in words
    assert "distance from the board 7.8 mm RMS on held-out captures 9.1 mm RMS captures used" in words
    assert "corners used 320" in words
    assert "beams used 900" in words
    # Cross-validation: fitted beside held out.
    assert "camera 20 0.41 px 0.53 px 0.40 px" in words


def test_the_headline_of_a_single_sensor_is_its_grade(calibration: Calibration, rig: Rig) -> None:
    root, camera = calibration.sensors[:2]
    weak = dataclasses.replace(camera, verdict=Verdict("weak", "x is loose"))
    pair = dataclasses.replace(
        calibration, sensors=(root, weak), joint_covariance=calibration.joint_covariance[:12, :12]
    )
    assert "<h1>The sensor is weak.</h1>" in render_report(pair, rig)


def test_the_graph_of_few_sensors_is_low(calibration: Calibration, rig: Rig) -> None:
    pair = dataclasses.replace(
        calibration, sensors=calibration.sensors[:2], joint_covariance=calibration.joint_covariance[:12, :12]
    )
    size = re.compile(r'class="graph[^"]*" viewBox="0 0 1040 (\d+)"')
    heights = [size.findall(render_report(one, rig)) for one in (calibration, pair)]
    assert heights == [["440"], ["180"]]


def test_the_first_lines_name_the_poses_that_can_be_used(page: Page) -> None:
    lead = "Do not rely on laser_low . Its card states why, and what to do next. Only camera"
    assert lead in page.words
    assert page.words.index(lead) < page.words.index("root lidar")


def test_the_first_lines_of_a_good_result_name_the_next_step(calibration: Calibration, rig: Rig) -> None:
    good = tuple(dataclasses.replace(s, verdict=Verdict("good")) for s in calibration.sensors)
    words = Page(render_report(dataclasses.replace(calibration, sensors=good), rig)).words
    assert "All poses can be used. Next: calgraph export" in words


def test_the_first_lines_count_many_sensors(calibration: Calibration, rig: Rig) -> None:
    lost = {f"sonar_{k}": "detected no board" for k in range(9)}
    evidence = dataclasses.replace(calibration.evidence, unconnected=lost)
    words = Page(render_report(dataclasses.replace(calibration, evidence=evidence), rig)).words
    assert "Do not rely on 10 sensors . Their cards state why" in words


def test_a_remark_that_is_on_a_card_is_not_repeated(calibration: Calibration, rig: Rig) -> None:
    reason = next(s.verdict.reason for s in calibration.sensors if s.name == "laser_low")
    evidence = dataclasses.replace(calibration.evidence, remarks=(reason, "the clock jumped"))
    words = Page(render_report(dataclasses.replace(calibration, evidence=evidence), rig)).words
    assert "Remarks the clock jumped" in words
    assert words.count(reason[10:]) == 1


def test_unconnected_sensors_get_a_card_with_their_reason(calibration: Calibration, rig: Rig) -> None:
    lost = dataclasses.replace(
        calibration, evidence=dataclasses.replace(calibration.evidence, unconnected={"sonar": "detected no board"})
    )
    page = Page(render_report(lost, rig))
    assert "sonar ✕ not calibrated Detected no board" in page.words
    assert "1 not calibrated." in page.words


@pytest.mark.parametrize(
    ("reason", "advice"),
    [
        (
            "detected the board in none of 48 captures, mostly because: no tag found",
            "Check the target in rig.yaml",
        ),
        ("detected the board in 2 captures, but lidar: 3 are needed", "Record more captures in which both it"),
        (
            "detected the board in 2 captures, but …; the root lidar detected it in none",
            "Nothing can be connected",
        ),
    ],
)
def test_advice_for_an_unconnected_sensor_follows_its_reason(
    calibration: Calibration, rig: Rig, reason: str, advice: str
) -> None:
    evidence = dataclasses.replace(calibration.evidence, unconnected={"sonar": reason})
    page = Page(render_report(dataclasses.replace(calibration, evidence=evidence), rig))
    assert f"{reason[1:]}. {advice}" in page.words


def test_sensors_without_a_pose_for_the_same_reason_share_a_card(calibration: Calibration, rig: Rig) -> None:
    lost = {"sonar": "detected no board", "radar": "has no messages", "lamp": "detected no board"}
    evidence = dataclasses.replace(calibration.evidence, unconnected=lost)
    page = Page(render_report(dataclasses.replace(calibration, evidence=evidence), rig))
    assert "sonar, lamp ✕ not calibrated Detected no board" in page.words
    assert page.count("article", "lost") == 2


def test_next_captures_are_collapsed_where_all_poses_are_good(calibration: Calibration, rig: Rig) -> None:
    """They reduce the uncertainty of poses, and do not connect a sensor that has none."""
    step = Suggestion("hold it there", "laser", "x", "m", 0.01, 0.005, np.eye(4))
    evidence = dataclasses.replace(calibration.evidence, suggestions=(step,), unconnected={"sonar": "no board"})
    weak = dataclasses.replace(calibration, evidence=evidence)
    good = tuple(dataclasses.replace(s, verdict=Verdict("good")) for s in calibration.sensors)
    shown = render_report(weak, rig)
    assert "<h3>Next captures</h3>" in shown
    assert "view of laser" in Page(shown).words
    assert "<h3>Next captures</h3>" not in render_report(dataclasses.replace(weak, sensors=good), rig)


def test_remarks_follow_the_verdicts(calibration: Calibration, rig: Rig) -> None:
    remarked = dataclasses.replace(
        calibration,
        evidence=dataclasses.replace(
            calibration.evidence, remarks=("board edges in scans of lidar are <40 mm inside",)
        ),
    )
    words = Page(render_report(remarked, rig)).words
    assert (
        "Remarks board edges in scans of lidar are <40 mm inside" in words[: words.index("Sensor graph An edge")]
    )
    assert "Remarks" not in Page(render_report(calibration, rig)).words


def test_a_verdict_without_reason_has_advice(calibration: Calibration, rig: Rig) -> None:
    sensors = (calibration.sensors[0], dataclasses.replace(calibration["laser"], verdict=Verdict("unobservable")))
    joint = calibration.joint_covariance[:12, :12]
    page = Page(render_report(dataclasses.replace(calibration, sensors=sensors, joint_covariance=joint), rig))
    assert "Do not use this pose. Record captures in which the board is tilted" in page.words


def test_the_pose_table_has_positions_rotations_and_deviations(page: Page) -> None:
    assert (
        "0.2100 ± 1.6 mm 0.0600 ± 1.6 mm −0.1200 ± 1.6 mm −90.000° 0.000° −90.000° x 0.034° y 0.034° z 0.034°"
        in page.words
    )


def test_the_pose_table_has_the_clock_offset(page: Page) -> None:
    assert "12.30 ms ± 0.40 ms" in page.words


def test_without_clock_offsets_there_is_no_column_of_them(calibration: Calibration, rig: Rig) -> None:
    synchronous = tuple(dataclasses.replace(s, clock_offset=None) for s in calibration.sensors)
    page = Page(render_report(dataclasses.replace(calibration, sensors=synchronous), rig))
    assert "clock offset" not in page.words


def test_tree_edges_are_bold_and_failed_ones_dashed(page: Page) -> None:
    assert (page.count("line", "tree"), page.count("line", "other"), page.count("line", "failed")) == (4, 2, 1)


def test_edges_carry_captures_and_residuals(calibration: Calibration, rig: Rig) -> None:
    edge = Edge("lidar", "camera", 41, 40, True, np.full(40, 0.0039))
    page = Page(
        render_report(
            dataclasses.replace(calibration, evidence=dataclasses.replace(calibration.evidence, edges=(edge,))),
            rig,
        )
    )
    assert "40 of 41 · RMS 3.9 mm" in page.words


def test_unused_pairs_have_a_reason(page: Page) -> None:
    assert "camera – laser_low 3 0 – needs 5 captures, has 3" in page.words


def test_histograms_hold_every_residual(page: Page, calibration: Calibration) -> None:
    for i, values in enumerate(calibration.evidence.residuals.values()):
        assert sum(page.figures[f"residuals-{i}"]["data"][0]["y"]) == values.size


def test_histograms_report_excluded_residuals(ugly: Calibration, rig: Rig) -> None:
    page = Page(render_report(ugly, rig))
    assert "3 residuals · RMS 520 · 1 beyond ±5, in the outer bars · 1 not finite, left out" in page.words


def test_a_result_read_back_shows_its_rms(calibration: Calibration, rig: Rig) -> None:
    read_back = dataclasses.replace(
        calibration,
        evidence=dataclasses.replace(calibration.evidence, residuals={}, residual_rms={"plane-plane": 1.034}),
    )
    page = Page(render_report(read_back, rig))
    assert "Only the root mean squares of the residuals are available: plane-plane 1.03." in page.words


def test_the_matrix_has_a_cell_for_each_sensor_and_capture(page: Page, calibration: Calibration) -> None:
    cells = np.array(page.figures["captures"]["data"][0]["z"])
    assert cells.shape == (5, 48)
    assert np.sum(cells == 2) == sum(row.used for row in calibration.evidence.captures)


def test_the_matrix_shows_reasons_on_hover(page: Page, calibration: Calibration) -> None:
    row = next(row for row in calibration.evidence.captures if row.sensor == "laser" and not row.used)
    words = page.figures["captures"]["data"][0]["text"][3][row.capture]
    assert (
        words
        == f"<b>laser</b>, capture {row.capture}, {row.start:.1f} – {row.end:.1f} s<br>not used: {row.reason}"
    )


def test_the_table_lists_every_row(page: Page, calibration: Calibration) -> None:
    rows = [a for t, a in page.elements if t == "tr" and "data-outcome" in a]
    assert len(rows) == len(calibration.evidence.captures)
    assert sum(a["data-outcome"] == "used" for a in rows) == sum(row.used for row in calibration.evidence.captures)


def test_the_most_frequent_reasons_are_counted(calibration: Calibration, rig: Rig) -> None:
    """Those that differ in numbers only are one."""
    rows = [CaptureRow(100 + i, 0.0, 1.0, "laser", i == 0, f"too short: 0.{i} m" if i else "") for i in range(4)]
    page = Page(
        render_report(
            dataclasses.replace(
                calibration, evidence=dataclasses.replace(calibration.evidence, captures=tuple(rows))
            ),
            rig,
        )
    )
    assert "laser 1 of 4 too short: … m (3)" in page.words


def test_a_board_out_of_view_is_no_rejection(calibration: Calibration, rig: Rig) -> None:
    """Behind the camera, which faces x, and above the laser."""
    corners = np.array([[-2.0, y, z] for y, z in ((-0.5, 0), (0.5, 0), (0.5, 0.8), (-0.5, 0.8))])
    rows = [CaptureRow(0, 0.0, 1.0, name, False, "no tag found") for name in ("camera", "camera_rear", "laser")]
    page = Page(
        render_report(
            dataclasses.replace(
                calibration,
                evidence=dataclasses.replace(calibration.evidence, captures=tuple(rows)),
                pictures=Pictures(board_outlines=(BoardOutline(0, corners),)),
            ),
            rig,
        )
    )
    matrix = page.figures["captures"]["data"][0]
    assert [matrix["z"][matrix["y"].index(row.sensor)][0] for row in rows] == [0, 1, 0]
    assert "camera 0 of 1 the board was not in its view (1) camera_rear 0 of 1 no tag found (1)" in page.words


def test_the_header_names_rig_recording_and_date(calibration: Calibration, rig: Rig) -> None:
    files = (
        InputFile("robot/rig.yaml", "a" * 64, "rig"),
        InputFile("robot/take_1", "b" * 64, "recording"),
        InputFile("robot/take_2", "c" * 64, "recording"),
        InputFile("robot/cad.urdf", "d" * 64, "prior"),
    )
    header = read_header(files, calibration, rig)
    recordings = "recording robot/take_1, robot/take_2 , 37 s from 2023-11-14 22:13:20 UTC"
    assert f"rig robot/rig.yaml · {recordings} · prior robot/cad.urdf · calibrated 2026-11-29" in header


def test_inputs_of_earlier_versions_have_no_kinds(calibration: Calibration, rig: Rig) -> None:
    files = (InputFile("robot/rig.yaml", "a" * 64), InputFile("robot/take_1", "b" * 64))
    header = read_header(files, calibration, rig)
    assert "rig robot/rig.yaml · recording robot/take_1 , 37 s from 2023-11-14 22:13:20 UTC" in header


def read_header(files: tuple[InputFile, ...], calibration: Calibration, rig: Rig) -> str:
    made = Provenance("0.3", "2026-11-29T13:00:00+00:00", "calgraph calibrate", files, 1.7e9, 37.4, 800)
    words = Page(render_report(dataclasses.replace(calibration, provenance=made), rig)).words
    return words[: words.index("Verdict")]


def test_the_root_has_a_card(page: Page) -> None:
    assert "lidar 3-D LiDAR ◎ root pose is the reference captures used" in page.words


@pytest.mark.parametrize("part", ["captures", "edges", "board_outlines"])
def test_parts_may_be_missing(calibration: Calibration, rig: Rig, part: str) -> None:
    if part == "board_outlines":
        without = dataclasses.replace(calibration, pictures=Pictures())
    else:
        evidence = dataclasses.replace(calibration.evidence, **{part: ()})  # type: ignore[arg-type]
        without = dataclasses.replace(calibration, evidence=evidence)
    assert "Verdict" in Page(render_report(without, rig)).words


def test_a_root_alone_is_a_page(bare: Calibration, rig: Rig) -> None:
    words = Page(render_report(bare, rig)).words
    assert "There is nothing to calibrate" in words
    assert "There are no captures" in words
    assert "No two sensors detected the board" in words


def test_text_with_markup_is_shown_and_not_run(ugly: Calibration, rig: Rig, bare: Calibration) -> None:
    evil = Page(render_report(ugly, rig))
    scripts = sum(tag == "script" for tag, _ in evil.elements) - len(evil.figures)
    assert scripts == sum(tag == "script" for tag, _ in Page(render_report(bare, rig)).elements) - 1
    assert '<script>alert("1")</script> & <b>ümläut</b> 前 $root </style>' in evil.words


def test_plotly_gets_markup_escaped(ugly: Calibration, rig: Rig) -> None:
    matrix = Page(render_report(ugly, rig)).figures["captures"]["data"][0]
    assert matrix["y"][1].startswith("&lt;script&gt;alert")
    assert "<script" not in json.dumps(matrix)


def test_non_finite_numbers_are_shown_as_such(ugly: Calibration, rig: Rig) -> None:
    words = Page(render_report(ugly, rig)).words
    assert "± 1000 m" in words
    assert "± ∞" in words
    assert "± ?" in words
    assert "> 180°" in words
