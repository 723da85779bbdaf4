"""The report as a file: what was written is read again, by later versions too."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from verdicts import NAMES, with_verdicts

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.report.old_names import RENAMED, with_new_names
from jaxsfm.report.run_inputs import LowResolution
from jaxsfm.report.run_report import FORMAT, RunReport, read_part, read_report, write_report
from jaxsfm.report.run_results import PairStatus, ViewGraph
from jaxsfm.report.summary import summary_lines
from jaxsfm.report.typed_json import OMITTED, Count, Number, to_json

FORMAT_1 = Path(__file__).parent / "report_of_format_1.json"
"""What `jaxsfm demo` wrote before the format had a number."""
OPTIONS = json.loads(FORMAT_1.read_text())["options"]


@pytest.fixture
def old(tmp_path) -> Path:
    (tmp_path / "report.json").write_bytes(FORMAT_1.read_bytes())
    return tmp_path


def test_a_report_of_the_first_format_is_read_and_loses_nothing(old):
    plain: Any = with_new_names(json.loads(FORMAT_1.read_text()))
    report = read_report(old)
    assert "format" not in plain and report.format == 1
    for row in plain["pairs"]["each"]:  # nothing could be rejected then
        row["view_graph"]["rejected"] = False
    for model in plain["refinement"]:  # nothing was doubted then
        for done in model["passes"]:
            done["doubtful_views"] = []
            done["shift_px"] = None  # it was not measured then
        model["camera"] = None  # nor was it asked for another one
        model["holds"] = True  # nor whether points hold it together
    assert report.to_json() == plain | {"format": 1, "checks": []}
    assert report.verdict is None
    assert report.models[0].registered == 7 and report.pairs.each[0].status == PairStatus.VERIFIED
    assert report.options["mapper"] == "incremental"
    assert "registered       7 of 7 images" in summary_lines(report)


def under_old_names(report: Any) -> Any:
    """A report as format 2 named its keys."""

    def back(value: Any, path: tuple[str, ...], old: str, new: str) -> None:
        for key in path:
            if key == "*":
                for each in value:
                    back(each, path[path.index("*") + 1 :], old, new)
                return
            value = (value or {}).get(key)
            if value is None:
                return
        if value and new in value:
            value[old] = value.pop(new)

    for path, new in reversed(RENAMED):
        back(report, path[:-1], path[-1], new)
    return report | {"format": 2}


def test_a_report_of_the_second_format_is_read_under_its_names(old, tmp_path):
    report = with_verdicts(read_report(old), "amber", "red")
    report = dataclasses.replace(report, format=2, low_resolution=LowResolution(px=800))
    plain = under_old_names(json.loads(json.dumps(report.to_json())))
    assert (
        plain["looks"] == {"first_px": 800, "whole": False} and "told_apart" in plain["checks"][0]
    )
    assert "strength" in plain["pairs"]["each"][0]["view_graph"]
    (tmp_path / "report.json").write_text(json.dumps(plain))
    assert read_report(tmp_path) == report
    assert under_old_names(report.to_json()) == plain  # what was given stays as it is


def test_a_report_of_this_format_is_not_searched_for_old_names():
    report = {"format": FORMAT, "looks": {"first_px": 800}}
    assert with_new_names(report) is report
    assert with_new_names(report | {"format": 2}) == {"format": 2, "low_resolution": {"px": 800}}


def test_a_new_name_counts_before_an_old_one():
    both = {"checks": [{"shrunk": ["a"], "scale_drift": ["b"]}, None, {"shrunk": ["c"]}], "lost": 3}
    assert with_new_names(both) == {
        "checks": [both["checks"][0], None, {"scale_drift": ["c"]}],  # type: ignore[index]
        "lost": 3,
    }


def test_a_written_report_is_read_again(old, tmp_path):
    report = dataclasses.replace(read_report(old), format=FORMAT)
    write_report(tmp_path, report)
    assert read_report(tmp_path) == report
    assert json.loads((tmp_path / "report.json").read_text())["format"] == FORMAT


@pytest.mark.parametrize(
    "change, says",
    [
        ({"format": FORMAT + 1}, f"(Expected `int` <= {FORMAT} - at `$.format`)"),
        ({"seconds": {"mapping": "1"}}, "(Expected `float`, got `str` - at `$.seconds[...]`)"),
        ({"models": {}}, "(Expected `array`, got `object` - at `$.models`)"),
        ({"pairs": {}}, "(Object missing required field `tried` - at `$.pairs`)"),
        ({"options": {}}, "(Object missing required field `config` - at `$.options`)"),
        (
            {"options": OPTIONS | {"config": {"max_size": 0, "enlarge": 1.0}}},
            "(Expected `int` >= 1 - at `$.options.config.max_size`)",
        ),
    ],
)
def test_a_report_that_cannot_be_read_says_where(old, change, says):
    plain = json.loads(FORMAT_1.read_text()) | change
    (old / "report.json").write_text(json.dumps(plain))
    with pytest.raises(UserError) as error:
        read_report(old)
    start = f"{old}: report.json is damaged, or of another version of jaxsfm "
    assert str(error.value) == start + says


def test_a_part_of_a_report_is_read_whatever_the_rest_is(tmp_path):
    file = tmp_path / "report.json"
    file.write_text('{"version": 1, "view_graph": {"components": []}, "models": [{}]}')
    assert read_part(tmp_path, ViewGraph, "view_graph") == ViewGraph()
    for keys, says in [
        (("low_resolution",), "the key 'low_resolution' is missing"),
        (("models", "first"), "the key 'first' is missing"),
        (("version",), "Expected `object`, got `int`"),
    ]:
        with pytest.raises(UserError) as error:
            read_part(tmp_path, ViewGraph, *keys)
        assert str(error.value).endswith(f"of another version of jaxsfm ({says})")


def test_names_that_are_not_utf8_and_numbers_that_are_not_finite_are_written_and_read(
    old, tmp_path
):
    report = read_report(old)
    images = dataclasses.replace(report.images, skipped={"a\udcff.jpg": "the name is not UTF-8"})
    (judged, *_) = (row for row in report.pairs.each if row.view_graph is not None)
    verdict = dataclasses.replace(judged.view_graph, edge_weight=math.inf)
    row = dataclasses.replace(judged, view_graph=verdict)
    pairs = dataclasses.replace(report.pairs, each=[row])
    report = dataclasses.replace(report, images=images, pairs=pairs)
    write_report(tmp_path, report)
    assert read_report(tmp_path) == report


# -- the verdict -----------------------------------------------------------------------------------


def test_checks_are_written_and_read_again(old, tmp_path):
    report = with_verdicts(read_report(old), "red", None, "amber")
    write_report(tmp_path, report)
    assert read_report(tmp_path) == report
    plain = json.loads((tmp_path / "report.json").read_text())["checks"]
    assert plain[0]["contradictions"][0]["images"] == NAMES[:4] and plain[1] is None


@pytest.mark.parametrize(
    "colours, worst",
    [
        ((), None),
        ((None,), None),
        (("green",), "green"),
        (("green", None, "amber"), "amber"),
        (("amber", "red", "green"), "red"),
    ],
)
def test_the_verdict_of_a_run_is_the_worst_of_its_models(old, colours, worst):
    report = with_verdicts(read_report(old), *colours)
    assert report.verdict == with_verdicts(report, *reversed(colours)).verdict == worst


def test_models_of_two_photos_have_no_verdict(old):
    report = with_verdicts(read_report(old), "green", "red")
    few = [report.models[0], dataclasses.replace(report.models[1], registered=2)]
    assert report.verdict == "red"
    assert dataclasses.replace(report, models=few).verdict == "green"


# -- dataclasses as JSON ---------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaf:
    count: Annotated[int, msgspec.Meta(ge=0, lt=10)]
    share: float | None = None
    note: str | None = dataclasses.field(default=None, metadata=OMITTED)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tree:
    status: PairStatus
    kind: Literal["oak", "elm"]
    leaves: list[Leaf]
    by_name: dict[str, Leaf]
    pair: tuple[str, int]
    number: Number = 0.0
    total: Count = 0


names = st.text(max_size=3)
leaves = st.builds(
    Leaf,
    count=st.integers(0, 9),
    share=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    note=st.none() | names,
)
trees = st.builds(
    Tree,
    status=st.sampled_from(PairStatus),
    kind=st.sampled_from(["oak", "elm"]),
    leaves=st.lists(leaves, max_size=2),
    by_name=st.dictionaries(names, leaves, max_size=2),
    pair=st.tuples(names, st.integers()),
)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(trees)
def test_any_tree_survives_a_file(tree):
    assert msgspec.convert(json.loads(json.dumps(to_json(tree))), Tree) == tree


def test_what_is_none_is_left_out_only_where_the_field_says_so():
    assert to_json(Leaf(count=1)) == {"count": 1, "share": None}


def test_the_outcomes_of_pairs_are_those_of_the_core():
    assert [each.name for each in PairStatus] == [each.name for each in Status]
    assert [each.value for each in PairStatus] == [each.name.lower() for each in Status]


LEAF = {"count": 1, "share": 0.5}
TREE = {"status": "verified", "kind": "oak", "leaves": [LEAF], "by_name": {"a": LEAF}}
TREE |= {"pair": ["a", 1]}


@pytest.mark.parametrize(
    "change, place",
    [
        ({"status": "VERIFIED"}, "status"),
        ({"status": 0}, "status"),
        ({"kind": "fir"}, "kind"),
        ({"kind": ["oak"]}, "kind"),
        ({"leaves": [LEAF, {"count": 10}]}, "leaves[1].count"),
        ({"leaves": [{"count": True}]}, "leaves[0].count"),
        ({"leaves": [{"count": 1.0}]}, "leaves[0].count"),
        ({"leaves": [{"count": "1"}]}, "leaves[0].count"),
        ({"leaves": [{"share": 1}]}, "leaves[0]"),
        ({"leaves": [LEAF | {"share": 10**400}]}, "leaves[0].share"),
        ({"leaves": [LEAF | {"share": True}]}, "leaves[0].share"),
        ({"by_name": {"b": None}}, "by_name[...]"),
        ({"by_name": [LEAF]}, "by_name"),
        ({"pair": ["a"]}, "pair"),
        ({"pair": ["a", "b"]}, "pair[1]"),
        ({"number": math.nan}, "number"),
        ({"number": math.inf}, "number"),
        ({"number": 1e30}, "number"),
        ({"number": -1.1e30}, "number"),
        ({"number": "1"}, "number"),
        ({"total": -1}, "total"),
        ({"total": 2**53}, "total"),
    ],
)
def test_a_value_of_another_type_is_named_by_its_place(change, place):
    msgspec.convert(TREE, Tree)
    with pytest.raises(msgspec.ValidationError) as error:
        msgspec.convert(TREE | change, Tree)
    assert str(error.value).endswith(f"at `$.{place}`")


def test_numbers_keep_their_values():
    report = RunReport.from_json(json.loads(FORMAT_1.read_text()) | {"seconds": {"mapping": 2}})
    assert report.seconds == {"mapping": 2.0}
