"""Reasons that several sensors share, for prints that state each once."""

from calgraph.result.finding import share_clauses


def test_shared_clauses_are_stated_once() -> None:
    stated, shared = share_clauses(
        {
            "a": "late; x is weak; walk more",
            "b": "y is weak; walk more; set clocks",
            "c": "late; walk more",
            "d": "moved; fix it",
        }
    )
    assert stated == {
        "a": "x is weak; see [1] and [2]",
        "b": "y is weak; set clocks; see [2]",
        "c": "see [1] and [2]",
        "d": "moved; fix it",
    }
    assert shared == {"[1]": "late", "[2]": "walk more"}


def test_clauses_of_the_same_sensors_are_one_entry() -> None:
    stated, shared = share_clauses({"a": "late; set clocks; far", "b": "late; set clocks"})
    assert stated == {"a": "far; see [1]", "b": "see [1]"}
    assert shared == {"[1]": "late; set clocks"}


def test_reasons_of_single_sensors_stay_as_they_are() -> None:
    assert share_clauses({"a": "late; far"}) == ({"a": "late; far"}, {})
    assert share_clauses({}) == ({}, {})
