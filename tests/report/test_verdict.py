"""The verdict in words: on the screen, and for the page."""

import dataclasses
from pathlib import Path

import pytest
from verdicts import NAMES, OTHER, check_of, with_verdicts

from jaxsfm.report.run_report import read_report
from jaxsfm.report.summary import summary_lines
from jaxsfm.report.verdict import (
    MAX_FINDINGS,
    Finding,
    ModelVerdict,
    model_verdict,
    model_verdicts,
    verdict_lines,
)
from jaxsfm.sfm.check.model_check import Alternative

FORMAT_1 = Path(__file__).parent / "report_of_format_1.json"


@pytest.fixture
def report(tmp_path):
    (tmp_path / "report.json").write_bytes(FORMAT_1.read_bytes())
    return read_report(tmp_path)


def lines(report, *colours) -> list[str]:
    """The lines of the summary that a report has more than one without checks."""
    without = summary_lines(with_verdicts(report, *[None] * len(colours)))
    return [x for x in summary_lines(with_verdicts(report, *colours)) if x not in without]


def only_finding(verdict: ModelVerdict) -> Finding:
    """The one thing that speaks against a model."""
    (reason,) = verdict.reasons
    (finding,) = reason.findings
    return finding


def test_a_model_that_was_not_checked_has_no_line(report):
    assert lines(report, None) == [] and "verdict" not in "\n".join(summary_lines(report))


def test_green_is_one_line_for_any_number_of_models(report):
    assert lines(report, "green") == ["verdict          green: no photo contradicts the model"]
    assert lines(report, "green", None, "green") == [
        "verdict          green: no photo contradicts the models"
    ]


def test_amber_names_the_photo_the_pairs_the_figures_and_what_would_decide(report):
    head, place = lines(report, "amber")
    advice = model_verdict(check_of("amber")).advice
    assert head == (
        "verdict          amber: two models may explain these photos; 1 photo fits into the model "
        "in a second place"
    )
    others = f"{NAMES[1]}, {NAMES[2]}, {NAMES[3]} and 5 more"
    assert place == (
        f"second place     {NAMES[0]}, turned by 90 degrees: the pairs with {others} put it there; "
        "seen from there, it agrees with 120 points of the model and contradicts 3"
    )
    assert advice.startswith(f"look whether {NAMES[0]} stands")
    assert f"add photos taken on the way from {NAMES[0]} to {others}" in advice
    assert "overlap by more than half" in advice and "occurs only once" in advice


def test_another_model_is_amber_and_says_what_it_follows_and_which_photos_move():
    verdict = model_verdict(dataclasses.replace(check_of("green"), alternative=OTHER))
    assert verdict.colour == "amber" and len(verdict.reasons) == 1
    head, other = verdict_lines([verdict])
    advice = verdict.advice
    assert head == "verdict          amber: two models may explain these photos"
    assert other == (
        "other model      alternative/0 is another mapping, which follows the order of the photos' "
        f"names: 2 photos have another place there ({NAMES[2]}, {NAMES[3]})"
    )
    assert f"on the way from {NAMES[2]}, {NAMES[3]} to the other photos" in advice
    assert f"look whether {NAMES[2]} stands where the model has it, and not where" in advice


def test_another_model_without_a_photo_elsewhere_is_matched_too():
    other = dataclasses.replace(OTHER, elsewhere=[])
    verdict = model_verdict(dataclasses.replace(check_of("green"), alternative=other))
    _, found = verdict_lines([verdict])
    advice = verdict.advice
    assert found.endswith("which follows the order of the photos' names")
    assert advice == "look at alternative/0, too, and use the model that is right"


def test_neighbours_that_disagree_are_amber_and_named():
    verdict = model_verdict(dataclasses.replace(check_of("green"), apart=[NAMES[3:5]]))
    head, neighbours = verdict_lines([verdict])
    advice = verdict.advice
    assert head == "verdict          amber: two models may explain these photos"
    assert neighbours == (
        f"neighbours       {NAMES[3]} and {NAMES[4]} follow each other, but their matches do not "
        "agree with the model"
    )
    assert f"on the way from {NAMES[3]} to {NAMES[4]}" in advice
    assert f"look whether {NAMES[4]} stands where the model has it; if" in advice


def test_photos_that_were_split_off_are_amber_and_each_group_is_named():
    groups = [NAMES[:3], NAMES[3:5], *([name] for name in NAMES[5:])]
    verdict = model_verdict(dataclasses.replace(check_of("green"), split_groups=groups))
    head, parts = verdict_lines([verdict])
    advice = verdict.advice
    assert head == "verdict          amber: two models may explain these photos"
    assert parts == (
        "split            these photos were in one model, which something spoke against; each "
        f"group is by itself now: {', '.join(NAMES[:3])}; {NAMES[3]}, {NAMES[4]}; {NAMES[5]}; "
        "and 3 more"
    )
    assert f"on the way from {', '.join(NAMES[:3])} to {NAMES[3]}, {NAMES[4]}" in advice
    assert "look at each model by itself" in advice
    found = only_finding(verdict)
    assert found.images == NAMES[:3] and found.others == NAMES[3:]
    check = dataclasses.replace(check_of("green"), split_groups=groups[:3])
    found = only_finding(model_verdict(check))
    assert found.text.endswith(f"; {NAMES[5]}")


def test_a_part_whose_scale_may_have_drifted_is_amber_and_its_photos_are_named():
    verdict = model_verdict(dataclasses.replace(check_of("green"), scale_drift=NAMES[:2]))
    head, scale = verdict_lines([verdict])
    advice = verdict.advice
    assert head == "verdict          amber: the scale of a part of the model may have drifted"
    assert scale == (
        f"scale            {NAMES[0]}, {NAMES[1]} see their points a hundred times nearer than "
        "other photos do, or nearer still"
    )
    assert "do not trust distances in this model" in advice
    found = only_finding(verdict)
    assert found.images == NAMES[:2] and not found.others
    alone = model_verdict(dataclasses.replace(check_of("green"), scale_drift=NAMES[:1]))
    assert f"{NAMES[0]} sees its points" in only_finding(alone).text


def test_a_model_of_which_the_photos_show_few_points_is_amber():
    verdict = model_verdict(dataclasses.replace(check_of("green"), unconfirmed=True), "sparse/2")
    head, said = verdict_lines([verdict])
    advice = verdict.advice
    assert head == (
        "verdict          amber: the photos do not show most points of the model (sparse/2)"
    )
    assert said.startswith("not refined      too few of its points were found")
    assert "do not use this model before you have looked at it" in advice


def test_a_model_of_still_pixels_is_amber_and_its_mask_is_named():
    verdict = model_verdict(dataclasses.replace(check_of("green"), same_pixels=True))
    head, said = verdict_lines([verdict])
    advice = verdict.advice
    assert head == (
        "verdict          amber: most of the model stays at the same pixels in all photos"
    )
    assert said.startswith("same pixels      more than half of what holds this model")
    assert "--masks" in advice and "still.png" in advice


def test_the_model_that_was_split_off_is_shown_as_one_way_to_join_the_groups():
    whole = Alternative(basis="order", images=8, elsewhere=NAMES[3:], contradicted=9, whole=True)
    groups = [NAMES[:3], NAMES[3:5]]
    check = dataclasses.replace(check_of("green"), split_groups=groups, alternative=whole)
    verdict = model_verdict(check)
    assert verdict_lines([verdict])[1] == (
        "other model      alternative/0 has 8 photos in one model, as it was before it was "
        "split; photos contradict each other at 9 of its points"
    )
    assert f"on the way from {', '.join(NAMES[:3])} to {NAMES[3]}, {NAMES[4]}" in verdict.advice
    assert "look at each model by itself" in verdict.advice and "alternative/0" in verdict.advice


def test_a_photo_that_was_split_off_alone_leaves_the_others_green():
    groups = [NAMES[:3], NAMES[3:4]]
    check = dataclasses.replace(check_of("green"), split_groups=groups)
    assert check.verdict == "green"
    assert dataclasses.replace(check, split_groups=[*groups, NAMES[4:5]]).verdict == "green"
    assert dataclasses.replace(check, split_groups=[*groups, NAMES[4:6]]).verdict == "amber"


def test_a_red_model_points_to_the_other_one():
    other = dataclasses.replace(OTHER, basis="pairs")
    verdict = model_verdict(dataclasses.replace(check_of("red"), alternative=other))
    lines = verdict_lines([verdict])
    assert "another mapping, which follows most of the pairs" in lines[2]
    assert "look whether alternative/0 is the right one" in verdict.advice


def test_red_names_both_groups_and_how_many_points_are_missing(report):
    head, groups = lines(report, "red")
    assert head == "verdict          red: photos contradict each other"
    assert groups.startswith(
        f"contradiction    {NAMES[0]}, {NAMES[1]}, {NAMES[2]} and 1 more against {NAMES[4]}, "
        f"{NAMES[5]}, {NAMES[6]} and 2 more: 312 of 400 points that one group shows are missing in "
        "the other"
    )
    advice = model_verdict(check_of("red")).advice
    assert advice.startswith("do not use this model as it is: add photos")


def test_words_on_several_models_say_which_one(report):
    text = "\n".join(lines(report, "green", None, "red"))
    assert "green: no photo contradicts the model (sparse/0)\n" in text
    assert "red: photos contradict each other (sparse/2)\n" in text
    (alone,) = model_verdicts([(1, check_of("red"))])
    assert alone.headline.endswith("(sparse/1)")


def test_the_strongest_findings_come_first_and_the_others_are_counted():
    check = check_of("amber")
    (place,) = check.pose_ambiguities
    places = [dataclasses.replace(place, image=f"{n}.jpg", agreed=n) for n in (5, 80, 3, 70, 60)]
    verdict = model_verdict(dataclasses.replace(check, pose_ambiguities=places))
    (reason,) = verdict.reasons
    assert [each.images for each in reason.findings[:3]] == [["80.jpg"], ["70.jpg"], ["60.jpg"]]
    assert "from 80.jpg to" in verdict.advice and "5 photos fit" in verdict.headline
    found = [x for x in verdict_lines([verdict]) if x.startswith("second place")]
    assert len(found) == MAX_FINDINGS + 1
    assert found[-1] == "second place     2 more are in report.json"


def test_a_red_model_tells_of_second_places_too():
    places = check_of("amber").pose_ambiguities
    check = dataclasses.replace(check_of("red"), pose_ambiguities=places)
    labels = [line[:17].strip() for line in verdict_lines([model_verdict(check)])]
    assert labels == ["verdict", "contradiction", "second place"]
