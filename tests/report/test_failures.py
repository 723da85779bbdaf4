"""Why images were lost: the stage, the numbers, the groups of images and what may help."""

import json
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.config import preset
from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairCounts, component_of, exhaustive_pairs
from jaxsfm.report.lost_photos import explained as explained_report
from jaxsfm.report.lost_photos import without_depth
from jaxsfm.report.pair_outcomes import COLMAP_MIN_INLIERS, photo_groups
from jaxsfm.report.run_inputs import SamePixels
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import Advice, ModelRow, PairRow, PairStatus
from jaxsfm.report.summary import component_lines, help_lines
from jaxsfm.sfm.check.model_check import ModelCheck
from jaxsfm.sfm.limits import TRUST
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt, taken_out
from jaxsfm.sfm.view_graph import Verdict

REPORT = RunReport.from_json(
    json.loads((Path(__file__).parent / "report_of_format_1.json").read_text())
)
"""A finished run, whose pairs, models and refinement are replaced."""
edges = st.lists(st.sampled_from(exhaustive_pairs("abcdefg")), max_size=10)


@settings(max_examples=40, deadline=None)
@given(st.sets(st.sampled_from("abcdefg")), edges)
def test_a_component_is_what_repeated_steps_reach(seeds, edges):
    slow = set(seeds)
    for _ in "abcdefg":
        slow |= {x for pair in edges if slow & set(pair) for x in pair}
    assert component_of(seeds, edges) == slow == component_of(sorted(seeds)[::-1], edges[::-1])


def counts(status: Status, tentative: int, inliers: int = 0) -> PairCounts:
    return PairCounts(
        num_inliers=inliers,
        num_planes=min(inliers, 1),
        num_tentative=tentative,
        num_dropped=0,
        status=status,
    )


def refused_for(reason: str, candidates: int = 0) -> RegistrationAttempt:
    """What registration says of the photo c, which it gives no place."""
    return RegistrationAttempt(
        name="c",
        registered=False,
        octave_px=None,
        candidates=candidates,
        agreed=0,
        error_px=None,
        reason=reason,
    )


def verdict(trusted: bool, error: float | None = 40.0, edge_weight: float = 0.05) -> Verdict:
    return Verdict(trusted=trusted, edge_weight=edge_weight, rotation_error_deg=error)


def pair_rows(results, handed_on, verified, verdicts) -> list[PairRow]:
    return [
        PairRow(
            pair=pair,
            status=PairStatus[each.status.name],
            tentative=each.num_tentative,
            inliers=each.num_inliers,
            planes=each.num_planes,
            handed_on=pair in handed_on,
            colmap_inliers=verified.get(pair, 0),
            view_graph=verdicts.get(pair),
        )
        for pair, each in results.items()
    ]


def explanation(
    names,
    results,
    verified,
    models=(),
    *,
    verdicts=None,
    handed_on=None,
    angles=None,
    config=None,
    pairs="exhaustive",
    known_camera=True,
    side=1600,
    refinement=(),
    checks=(),
) -> RunReport:
    """A report for images of 1600 px with a known camera, all of whose pairs were tried."""
    if handed_on is None:
        handed_on = [pair for pair, each in results.items() if each.num_inliers]
    intrinsics = "K.txt" if known_camera else None
    report = replace(
        REPORT,
        pairs=replace(REPORT.pairs, each=pair_rows(results, handed_on, verified, verdicts or {})),
        options=REPORT.options | {"pairs": pairs, "intrinsics": intrinsics},
        models=[
            ModelRow(
                registered=len(images),
                points=0,
                track_length=0,
                reprojection_error_px=0,
                images=list(images),
            )
            for images in models
        ],
        refinement=refinement,
        checks=list(checks),
    )
    sizes = dict.fromkeys(names, (side, side // 2))
    return explained_report(report, config or preset("default"), sizes, angles or {})


def explained(*args, **changes) -> dict:
    """`explanation` as plain JSON."""
    found = explanation(*args, **changes).to_json()
    assert json.loads(json.dumps(found)) == found
    return found


RESULTS = {
    ("m0", "m1"): counts(Status.VERIFIED, 500, 400),
    ("few", "m0"): counts(Status.TOO_FEW_MATCHES, 3),
    ("few", "m1"): counts(Status.TOO_FEW_MATCHES, 7),
    ("flat", "m0"): counts(Status.NO_PLANE, 90),
    ("few", "flat"): counts(Status.TOO_FEW_MATCHES, 2),
    ("alone", "m0"): counts(Status.VERIFIED, 60, 30),  # COLMAP verifies none of them
    ("island0", "island1"): counts(Status.VERIFIED, 80, 70),
    ("island1", "m0"): counts(Status.NO_PLANE, 33),
    ("m1", "odd"): counts(Status.VERIFIED, 100, 55),
}
VERIFIED = {("m0", "m1"): 390, ("island0", "island1"): 66, ("m1", "odd"): 44}
STAGES = {
    "alone": ("not connected", "30 inliers in its best pair, 0 pairs verified"),
    "few": ("too few matches", "at most 7 tentative"),
    "flat": ("no plane", "90 tentative"),
    "island0": ("not connected", "70 inliers in its best pair, 1 pairs verified"),
    "island1": ("not connected", "none of which leads to the model"),
    "never": ("pairs", "in no pair"),
    "odd": ("no pose", "1 verified pairs with up to 44 inliers"),
}
NAMES = ["m0", "m1", *STAGES]


def rows(found) -> dict[str, dict]:
    return {row["image"]: row for row in found["lost"]}


def options(row) -> list[str | None]:
    return [each["option"] for each in row["help"]]


def test_every_lost_image_names_the_stage_that_lost_it():
    found = explained(NAMES, RESULTS, VERIFIED, [["m0", "m1"]])
    assert [row["image"] for row in found["lost"]] == sorted(STAGES) and found["no_model"] is None
    for name, (stage, detail) in STAGES.items():
        row = rows(found)[name]
        assert row["stage"] == stage and detail in row["detail"], name


def test_without_a_model_no_image_is_called_connected():
    found = rows(explained(NAMES, RESULTS, VERIFIED))
    assert {row["stage"] for row in found.values()} >= {"not connected", "no plane", "pairs"}
    assert found["m0"]["stage"] == "no pose"


def test_registered_images_are_not_lost():
    assert explained(["m0", "m1"], {}, {}, [["m1", "m0"]])["lost"] == []


def test_a_lost_image_has_the_numbers_of_the_pair_that_came_furthest():
    found = rows(explained(NAMES, RESULTS, VERIFIED, [["m0", "m1"]]))
    best = found["few"]["best_pair"]
    assert best["pair"] == ["few", "m1"] and best["tentative"] == 7 and not best["trusted"]
    assert best["missed"] == "7 tentative matches, 26 are needed"
    assert (
        found["odd"]["best_pair"]["colmap_inliers"] == 44 and found["odd"]["best_pair"]["trusted"]
    )
    assert found["never"]["best_pair"] is None
    assert "COLMAP found no geometry that 15" in found["alone"]["best_pair"]["missed"]


def test_pairs_with_photos_that_are_gone_explain_nothing():
    there = [name for name in NAMES if name not in ("alone", "island1")]
    tried = {pair: each for pair, each in RESULTS.items() if set(pair) <= set(there)}
    found = explained(there, RESULTS, VERIFIED, [["m0", "m1"]])
    assert found["lost"] == explained(there, tried, VERIFIED, [["m0", "m1"]])["lost"]
    assert rows(found)["island0"]["stage"] == "pairs"


def test_an_image_of_a_smaller_model_says_which():
    found = rows(explained(NAMES, RESULTS, VERIFIED, [["m0", "m1"], ["island0", "island1"]]))
    assert found["island0"]["model"] == 1 and "sparse/1" in found["island0"]["detail"]
    assert found["odd"]["model"] is None


def test_an_image_of_a_smaller_model_that_trusted_pairs_join_to_the_best_is_told_what_is_between():
    """COLMAP went no further: a pair of other places, or too little in common."""
    tried = {
        ("a", "b"): counts(Status.VERIFIED, 500, 400),
        ("b", "c"): counts(Status.VERIFIED, 90, 60),
        ("c", "d"): counts(Status.VERIFIED, 500, 300),
        **dict.fromkeys([("a", "c"), ("a", "d"), ("b", "d")], counts(Status.TOO_FEW_MATCHES, 1)),
    }
    verified = {("a", "b"): 300, ("b", "c"): 42, ("c", "d"): 200}
    found = rows(explained("abcd", tried, verified, [["a", "b"], ["c", "d"]], known_camera=False))
    assert {row["stage"] for row in found.values()} == {"other model"} and set(found) == {"c", "d"}
    for row in found.values():
        assert "sparse/1" in row["detail"] and row["model"] == 1
        reasons = " ".join(each["reason"] for each in row["help"])
        assert (
            "photos between b - c" in reasons and "42 inliers, which did not join them" in reasons
        )
        assert "--intrinsics" not in options(row)  # they have poses


def test_an_image_that_refinement_took_out_says_what_was_missing():
    tried = {
        ("a", "b"): counts(Status.VERIFIED, 500, 400),
        ("a", "c"): counts(Status.TOO_FEW_MATCHES, 1),
        ("b", "c"): counts(Status.VERIFIED, 90, 60),
    }
    placed = [
        RegistrationAttempt(
            name="a", registered=True, octave_px=None, candidates=9, agreed=1, error_px=None
        ),
        RegistrationAttempt(
            name="c",
            registered=True,
            octave_px=None,
            candidates=2541,
            agreed=12,
            error_px=None,
            held=6,
        ),
    ]
    found = explained(
        "abc",
        tried,
        {("a", "b"): 300, ("b", "c"): 42},
        [["a", "b"]],
        refinement=[None, RefinementFigures(passes=[], registrations=placed)],
    )
    (row,) = found["lost"]
    assert row["image"] == "c" and row["stage"] == "not confirmed"
    for number in ("42 inliers", "12 of the 2541 points"):
        assert number in row["detail"]
    assert "photos between b - c" in row["help"][-1]["reason"]


@pytest.mark.parametrize(
    ("verified", "candidates", "stage"),
    [
        (42, 9, "not confirmed"),
        (42, 0, "no pose"),
        (0, 9, "not confirmed"),
        (0, 0, "not connected"),
    ],
)
def test_an_image_that_registration_refused_says_why(verified, candidates, stage):
    """Without a pose, it is as lost as it was before."""
    tried = {
        ("a", "b"): counts(Status.VERIFIED, 500, 400),
        ("b", "c"): counts(Status.VERIFIED, 90, 60),
    }
    reason = "its matches with its neighbour b do not agree with it"
    figures = RefinementFigures(passes=[], registrations=[refused_for(reason, candidates)])
    found = explained(
        "abc", tried, {("a", "b"): 300, ("b", "c"): verified}, [["a", "b"]], refinement=[figures]
    )
    (row,) = found["lost"]
    assert row["stage"] == stage
    assert row["detail"].endswith(f"; registration found no place that can be trusted: {reason}")


def test_an_image_that_was_split_off_and_then_refused_says_both():
    tried = {("a", "b"): counts(Status.VERIFIED, 500, 400)}
    tried |= {("b", "c"): counts(Status.VERIFIED, 90, 60)}
    refused = refused_for("X")
    told = [["a", "b"], ["c"]]
    (row,) = explained(
        "abc",
        tried,
        dict.fromkeys(tried, 42),
        [["a", "b"]],
        refinement=[RefinementFigures(passes=[], registrations=[refused])],
        checks=[ModelCheck(groups=[], contradictions=[], pose_ambiguities=[], split_groups=told)],
    )["lost"]
    assert row["stage"] == "not confirmed"
    assert "speaks against the model that it was in; registration" in row["detail"]
    assert row["detail"].endswith(": X")


def test_an_image_that_was_taken_out_and_then_refused_says_both():
    """It was taken out of the second model, and what registration says stands in the first one."""
    tried = {("a", "b"): counts(Status.VERIFIED, 500, 400)}
    refused = refused_for("X")
    rows = [[refused], [taken_out("c", 17)]]
    (row,) = explained(
        "abc",
        tried,
        dict.fromkeys(tried, 42),
        [["a", "b"]],
        refinement=[RefinementFigures(passes=[], registrations=placed) for placed in rows],
    )["lost"]
    assert row["stage"] == "not confirmed"
    assert "too few of its 17 points are shown by a third photo" in row["detail"]
    assert row["detail"].endswith("; registration found no place that can be trusted: X")


def test_an_image_that_contradicts_the_model_it_was_in_says_so():
    tried = {("a", "b"): counts(Status.VERIFIED, 500, 400)} | {
        ("b", name): counts(Status.VERIFIED, 90, 60) for name in "cd"
    }
    parts = [["a", "b"], ["c"], ["d"]]
    check = ModelCheck(
        groups=[["a", "b"]], contradictions=[], pose_ambiguities=[], split_groups=parts
    )
    verified = dict.fromkeys(tried, 42)
    found = explained("abcd", tried, verified, [["a", "b"], ["d"]], checks=[check, None])
    first, second = found["lost"]
    assert first["image"] == "c" and first["stage"] == "not confirmed"
    assert first["detail"].endswith("but something speaks against the model that it was in")
    assert second["image"] == "d" and second["stage"] == "other model"  # it is in a model again


# -- groups ----------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(edges, edges, st.randoms(use_true_random=False))
def test_components_part_the_images_and_cross_no_trusted_pair(trusted, tried, random):
    tried = [*trusted, *tried]
    random.shuffle(tried)
    results = dict.fromkeys(tried, counts(Status.VERIFIED, 50, 40))
    found = photo_groups("abcdefg", pair_rows(results, tried, dict.fromkeys(trusted, 30), {}))
    assert sorted(name for group in found for name in group.images) == list("abcdefg")
    assert sum(len(group.inside) for group in found) == len(set(trusted))
    for group in found:
        assert group.images == component_of(group.images, trusted)
        crossing = [row.pair for row in group.crossing]
        assert crossing == sorted(p for p in set(tried) if len(group.images & set(p)) == 1)
        assert not set(crossing) & set(trusted)
    sizes = [(-len(group.images), min(group.images)) for group in found]
    assert sizes == sorted(sizes)


def test_a_group_names_the_pair_that_comes_nearest_to_the_others_and_what_it_lacks():
    found = explained(NAMES, RESULTS, VERIFIED, [["m0", "m1", "odd"]])
    model, island, *single = found["view_graph"]["components"]
    assert model["images"] == ["m0", "m1", "odd"] and model["registered"] == 3
    assert model["pairs"] == 2 and model["nearest"]["pair"] == ["alone", "m0"]
    assert island["images"] == ["island0", "island1"] and island["registered"] == 0
    assert island["nearest"]["pair"] == ["island1", "m0"] and island["nearest"]["component"] == 0
    assert island["nearest"]["missed"] == (
        "33 tentative matches, but no homography agrees with 26 of them"
    )
    assert [each["images"] for each in single] == [["alone"], ["few"], ["flat"], ["never"]]
    for row in found["lost"]:
        assert row["image"] in found["view_graph"]["components"][row["component"]]["images"]
    same = explanation(NAMES, RESULTS, VERIFIED, [["m0", "m1", "odd"]]).view_graph
    lines = component_lines(same)
    assert lines[0].startswith("view graph       2 groups") and "of 3, 2 images; 4" in lines[0]
    assert "island0, island1: the pair nearest to the others is island1 - m0: 33 tent" in lines[1]
    assert len(lines) == 2
    whole = explanation(["m0", "m1"], {("m0", "m1"): RESULTS["m0", "m1"]}, VERIFIED, [["m0", "m1"]])
    assert component_lines(whole.view_graph) == []


def test_an_untrusted_pair_says_by_how_much_it_missed():
    pair = ("a", "b")
    results = {pair: counts(Status.VERIFIED, 60, 30)}
    found = explained("ab", results, {pair: 28}, [["b"]], verdicts={pair: verdict(False, 40.2)})
    missed = found["view_graph"]["components"][0]["nearest"]["missed"]
    for part in (
        "28 inliers",
        "40 deg",
        f"{TRUST.rotation_deg:.0f} deg are allowed",
        "0.050",
        str(TRUST.strong),
    ):
        assert part in missed
    (row,) = found["lost"]
    assert row["stage"] == "not connected" and "--view-graph no" in row["detail"]
    assert options(row) == ["--view-graph no"]
    assert "a - b, show the same place" in row["help"][0]["reason"]
    lost = explained("ab", results, {pair: 28}, verdicts={pair: verdict(False, None)})
    assert "no relative pose" in lost["no_model"]


def test_a_rejected_pair_says_what_contradicts_it_and_nothing_of_its_rotation():
    pair, reason = ("a", "b"), "the photos it joins contradict each other: of 100 points, 30"
    rejected = Verdict(
        trusted=False, rejected=True, edge_weight=0.0, rotation_error_deg=None, reason=reason
    )
    results = {pair: counts(Status.VERIFIED, 60, 30)}
    found = explained("ab", results, {pair: 28}, [["b"]], verdicts={pair: rejected})
    missed = found["view_graph"]["components"][0]["nearest"]["missed"]
    assert missed == f"28 inliers, but {reason}"
    (row,) = found["lost"]
    assert "--view-graph no" not in row["detail"] and "--view-graph no" not in options(row)


def test_the_least_number_of_inliers_is_colmaps():
    assert pycolmap.TwoViewGeometryOptions().min_num_inliers == COLMAP_MIN_INLIERS


# -- what may help: true for the numbers at hand, or not said --------------------------------------

FLAT = {("a", "b"): counts(Status.NO_PLANE, 90), ("m", "n"): counts(Status.VERIFIED, 90, 80)}
FLAT |= {(x, y): counts(Status.TOO_FEW_MATCHES, 1) for x in "ab" for y in "mn"}
OWN = {("m", "n"): 70}
UNVERIFIED = FLAT | {
    ("a", "b"): counts(Status.VERIFIED, 90, 80),
    ("b", "m"): counts(Status.VERIFIED, 50, 40),
}


@pytest.mark.parametrize(
    "changes, expected",
    [
        ({}, [None]),
        ({"side": 3000}, ["--max-size 3000"]),
        ({"side": 5000}, ["--max-size 3200"]),
        ({"side": 640}, ["--preset robust"]),
        ({"side": 640, "config": preset("robust")}, [None]),
        ({"config": preset("paper")}, ["--preset default"]),
        ({"side": 3000, "config": preset("paper")}, ["--preset default"]),
        ({"known_camera": False}, [None]),
    ],
)
def test_without_a_plane_only_what_the_photos_have_more_of_is_advised(changes, expected):
    found = explained("abmn", FLAT, OWN, [["m", "n"]], **changes)
    assert options(rows(found)["a"]) == expected
    *_, last = rows(found)["a"]["help"]
    alone = expected == [None]
    assert last["reason"].startswith("no option would help") == alone
    assert ("between a - b" in last["reason"]) == alone  # came nearest


def test_a_known_camera_is_advised_where_colmap_verified_nothing_for_a_guessed_one():
    groups = {**OWN, ("a", "b"): 60}
    for known in (True, False):
        found = explained("abmn", UNVERIFIED, groups, [["m", "n"]], known_camera=known)
        for name in "ab":
            row = rows(found)[name]
            assert options(row) == ([None] if known else ["--intrinsics"])
            assert ("b - m" in row["help"][-1]["reason"]) == known
    weak = UNVERIFIED | {("b", "m"): counts(Status.NO_PLANE, 14)}
    found = explained("abmn", weak, groups, [["m", "n"]], known_camera=False)
    assert options(rows(found)["a"]) == [None]


@pytest.mark.parametrize(
    "pairs, longer",
    [
        ("exhaustive", "jaxsfm reconstruct"),  # extended since: reconstruct tries the others
        ("pairs.txt", "--pairs exhaustive"),
        ("retrieval:1", "--pairs retrieval:2"),
        ("sequential:1+retrieval:2", "--pairs sequential:2+retrieval:3"),
        ("retrieval:3", "--pairs exhaustive"),
    ],
)
def test_a_longer_shortlist_is_advised_where_pairs_were_not_tried(pairs, longer):
    some = {pair: each for pair, each in FLAT.items() if pair != ("a", "n")}
    row = rows(explained("abmn", some, OWN, [["m", "n"]], pairs=pairs))["a"]
    assert options(row) == [longer]
    assert row["help"][0]["reason"].endswith("2 of its 3 pairs with others were tried")
    tried = rows(explained("abmn", FLAT, OWN, [["m", "n"]], pairs=pairs))["a"]
    assert options(tried) == [None]


def test_pairs_that_best_pairs_left_out_are_named():
    found = explained(
        "abmn",
        UNVERIFIED,
        {**OWN, ("a", "b"): 60},
        [["m", "n"]],
        handed_on=[("a", "b"), ("m", "n")],
    )
    row = rows(found)["b"]
    assert options(row) == ["--best-pairs"]
    assert "b - m, with 40" in row["help"][0]["reason"]


def test_a_connected_image_without_a_pose_needs_its_focal_length_or_photos_near_it():
    others = {(n, "odd"): counts(Status.TOO_FEW_MATCHES, 1) for n in NAMES if n != "odd"}
    for known in (True, False):
        found = explained(NAMES, others | RESULTS, VERIFIED, [["m0", "m1"]], known_camera=known)
        row = rows(found)["odd"]
        assert options(row) == ([None] if known else ["--intrinsics"])
        assert ("m1" in row["help"][-1]["reason"]) == known


def test_photos_from_one_spot_are_told_to_move_and_nothing_else():
    pair = ("a", "b")
    found = explained("ab", {pair: UNVERIFIED[pair]}, {pair: 60}, angles={pair: 0.4})
    for row in rows(found).values():
        assert options(row) == [None] and "0.4 deg at most" in row["help"][0]["reason"]
    found = explained("ab", {pair: UNVERIFIED[pair]}, {pair: 60}, angles={pair: 5.0})
    assert "deg" not in rows(found)["a"]["help"][0]["reason"]


def test_what_gives_no_depth_is_said_once_for_all_photos():
    pair = ("a", "b")
    report = explanation("ab", {pair: UNVERIFIED[pair]}, {pair: 60}, angles={pair: 0.4})
    found = without_depth(report, one_place=True)
    assert found.no_model is not None and "from one place" in found.no_model
    assert "move sideways" in found.no_model
    for photo in found.lost:
        assert photo.help == [Advice(option=None, reason="move sideways between photos")]
    assert without_depth(report, one_place=False) == report
    still = replace(report, same_pixels=SamePixels(share=0.5, photos=9))
    found = without_depth(still, one_place=False)
    assert found.no_model is not None and found.no_model.startswith(str(report.no_model))
    assert "mask what stays" in found.no_model
    for photo, before in zip(found.lost, report.lost, strict=True):
        assert photo.detail == before.detail
        assert photo.help is not None and photo.help[0].option == "--masks"


# -- the one reason --------------------------------------------------------------------------------


def test_without_a_model_the_stage_that_no_pair_got_past_is_the_reason():
    names, verified = "abmn", {("a", "b"): 60, ("m", "n"): 70}

    def reason(results, verified, **changes):
        return explained(names, results, verified, **changes)["no_model"]

    nothing = {pair: counts(Status.TOO_FEW_MATCHES, 5) for pair in FLAT}
    assert "no pair of photos was tried" in reason({}, {})
    assert "none of the 6 pairs tried has matches on a plane" in reason(nothing, {})
    assert "COLMAP verified none of the 3 pairs" in reason(UNVERIFIED, {})
    dropped = dict.fromkeys(verified, verdict(False))
    assert "trusts none of the 2 verified" in reason(UNVERIFIED, verified, verdicts=dropped)
    still = dict.fromkeys(verified, 1.5)
    assert "meet at 1.5 deg at most" in reason(UNVERIFIED, verified, angles=still)
    unknown = dict.fromkeys(verified, 0.0)
    assert "from among 2; the best, m - n, has 70" in reason(UNVERIFIED, verified, angles=unknown)


# -- the last lines and the page -------------------------------------------------------------------


def test_each_option_is_one_line_with_the_images_it_could_help():
    lost = explanation("abmn", FLAT, OWN, [["m", "n"]], side=640).lost
    assert help_lines(lost) == ["may help         --preset robust (a, b): a has only 640 px"]
    (photos,) = help_lines(explanation("abmn", FLAT, OWN, [["m", "n"]]).lost)
    assert photos.startswith("may help         more photos (a, b): no option would help; take ")
