"""The last three lines of a run: what anybody must understand of it."""

import dataclasses
from pathlib import Path

import pytest
from verdicts import with_verdicts

from jaxsfm.report.closing import closing_lines
from jaxsfm.report.run_report import RunReport, read_report
from jaxsfm.report.run_results import Advice, LostPhoto
from jaxsfm.report.verdict import model_verdicts

FORMAT_1 = Path(__file__).parent / "report_of_format_1.json"


@pytest.fixture
def report(tmp_path) -> RunReport:
    """Of a run that placed all its photos."""
    (tmp_path / "report.json").write_bytes(FORMAT_1.read_bytes())
    (tmp_path / "report.html").write_text("<html>")
    found = read_report(tmp_path)
    best = dataclasses.replace(found.models[0], registered=found.images.usable)
    return dataclasses.replace(found, models=[best], checks=[], lost=[], georeference=None)


def lost(name: str, *help: Advice) -> LostPhoto:
    return LostPhoto(image=name, stage="no pose", detail="", help=list(help))


def without_a_place(report: RunReport, *photos: LostPhoto) -> RunReport:
    """The report of a run that has not placed these photos."""
    best = report.models[0]
    best = dataclasses.replace(best, registered=best.registered - len(photos))
    return dataclasses.replace(report, models=[best], lost=list(photos))


def test_a_green_model_of_all_photos_is_good_and_can_be_used(report, tmp_path):
    good, where, after = closing_lines(with_verdicts(report, "green"), tmp_path)
    n = report.images.usable
    assert good == (
        f"is it good?      yes: all {n} photos have a place in it, and no photo contradicts it"
    )
    assert where.endswith(
        f"{tmp_path / 'report.html'}, in a browser: it shows the model and its photos"
    )
    assert str(tmp_path / "sparse" / "0") in after and "jaxsfm export" in after


@pytest.mark.parametrize("colour, word", [("amber", "perhaps not: "), ("red", "no: ")])
def test_a_doubted_model_is_never_called_good_and_its_advice_is_the_verdicts(
    report, tmp_path, colour, word
):
    doubted = with_verdicts(report, "green", colour)
    good, _, after = closing_lines(doubted, tmp_path)
    verdict = model_verdicts(doubted.checked)[1]
    assert good[17:] == word + verdict.headline.removeprefix(f"{colour}: ")
    assert after[17:] == verdict.advice


def test_the_worst_of_several_models_speaks(report, tmp_path):
    good, _, _ = closing_lines(with_verdicts(report, "amber", "red", "green"), tmp_path)
    assert good.startswith("is it good?      no: ") and good.endswith("(sparse/1)")


def test_missing_photos_are_counted_and_the_advice_helps_most_of_them(report, tmp_path):
    pairs = Advice(option="--pairs exhaustive", reason="only 3 pairs were tried")
    camera = Advice(option="--intrinsics", reason="the focal length was guessed")
    some = without_a_place(
        report, lost("a.jpg", camera), lost("b.jpg", camera, pairs), lost("c.jpg", pairs, pairs)
    )
    good, where, after = closing_lines(with_verdicts(some, "green"), tmp_path)
    assert good[17:].startswith("in part: ")
    assert f"3 of {report.images.usable} photos have no place in it" in good
    assert where.endswith("says why photos are missing")
    assert after[17:] == (
        "run the same command again with --pairs exhaustive "
        "(for b.jpg and 2 more: only 3 pairs were tried)"
    )


def test_where_no_option_helps_photos_do(report, tmp_path):
    why = "no option would help; take photos near it"
    some = without_a_place(report, lost("a.jpg", Advice(option=None, reason=why)))
    good, _, after = closing_lines(with_verdicts(some, "green"), tmp_path)
    assert "1 of" in good and "photos has no place" in good
    assert after[17:] == f"for a.jpg: {why}"


def test_a_run_without_a_model_says_so_and_asks_for_photos(report, tmp_path):
    none = dataclasses.replace(report, models=[], checks=[])
    good, where, after = closing_lines(none, tmp_path)
    assert good == "is it good?      no: there is no model"
    assert "shows the photos and pairs, and says why photos are missing" in where
    assert "take more photos" in after


def test_two_photos_are_not_called_a_good_model(report, tmp_path):
    best = dataclasses.replace(report.models[0], registered=2)
    two = dataclasses.replace(
        report, models=[best], images=dataclasses.replace(report.images, usable=2)
    )
    good, _, after = closing_lines(two, tmp_path)
    assert good[17:] == (
        "nobody knows: two photos cannot contradict each other; it takes 3 to check a model"
    )
    assert "take more photos" in after


def test_without_a_page_the_report_is_named(report, tmp_path):
    (tmp_path / "report.html").unlink()
    _, where, _ = closing_lines(with_verdicts(report, "green"), tmp_path)
    assert str(tmp_path / "report.json") in where
