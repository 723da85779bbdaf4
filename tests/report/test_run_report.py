"""The report as a file: what was written is read again, by later versions too."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from verdicts import NAMES, with_verdicts

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.report.run_report import FORMAT, RunReport, read_report, write_report
from jaxsfm.report.summary import summary_lines
from jaxsfm.report.typed_json import OMITTED, OTHERS, Misfit, Range, from_json, to_json

FORMAT_1 = Path(__file__).parent / "report_of_format_1.json"
"""What `jaxsfm demo` wrote before the format had a number."""


@pytest.fixture
def old(tmp_path) -> Path:
    (tmp_path / "report.json").write_bytes(FORMAT_1.read_bytes())
    return tmp_path


def test_a_report_of_the_first_format_is_read_and_loses_nothing(old):
    plain, report = json.loads(FORMAT_1.read_text()), read_report(old)
    assert "format" not in plain and report.format == 1
    for row in plain["pairs"]["each"]:  # nothing could be refuted then
        row["view_graph"]["refuted"] = False
    for model in plain["refinement"]:  # nothing was doubted then
        for done in model["passes"]:
            done["doubtful_views"] = []
            done["shift_px"] = None  # it was not measured then
        model["camera"] = None  # nor was it asked for another one
        model["holds"] = True  # nor whether points hold it together
    assert report.to_json() == plain | {"format": 1, "checks": []}
    assert report.verdict is None
    assert report.models[0].registered == 7 and report.pairs.each[0].status == Status.VERIFIED
    assert report.options.others["mapper"] == "incremental"
    assert "registered       7 of 7 images" in summary_lines(report)


def test_a_written_report_is_read_again(old, tmp_path):
    report = dataclasses.replace(read_report(old), format=FORMAT)
    write_report(tmp_path, report)
    assert read_report(tmp_path) == report
    assert json.loads((tmp_path / "report.json").read_text())["format"] == FORMAT


@pytest.mark.parametrize(
    "change, says",
    [
        ({"format": FORMAT + 1}, "'format' must be at least 1 and less than"),
        ({"seconds": {"mapping": "1"}}, "'seconds.mapping' must be a number; got '1'"),
        ({"models": {}}, "'models' must be a list; got {}"),
        ({"pairs": {}}, "'pairs' must be an object with the key 'tried'"),
    ],
)
def test_a_report_that_cannot_be_read_says_where(old, change, says):
    plain = json.loads(FORMAT_1.read_text()) | change
    (old / "report.json").write_text(json.dumps(plain))
    with pytest.raises(UserError) as error:
        read_report(old)
    assert str(old) in str(error.value) and "report.json" in str(error.value)
    assert says in str(error.value)


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
    count: Annotated[int, Range(0, 10)]
    share: float | None = None
    note: str | None = dataclasses.field(default=None, metadata=OMITTED)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tree:
    status: Status
    kind: Literal["oak", "elm"]
    leaves: list[Leaf]
    by_name: dict[str, Leaf]
    pair: tuple[str, int]
    others: dict[str, object] = dataclasses.field(default_factory=dict, metadata=OTHERS)


names = st.text(max_size=3)
leaves = st.builds(
    Leaf,
    count=st.integers(0, 9),
    share=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    note=st.none() | names,
)
others = st.dictionaries(names.map("other {}".format), st.none() | st.integers(), max_size=2)
trees = st.builds(
    Tree,
    status=st.sampled_from(Status),
    kind=st.sampled_from(["oak", "elm"]),
    leaves=st.lists(leaves, max_size=2),
    by_name=st.dictionaries(names, leaves, max_size=2),
    pair=st.tuples(names, st.integers()),
    others=others,
)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(trees)
def test_any_tree_survives_a_file(tree):
    assert from_json(Tree, json.loads(json.dumps(to_json(tree)))) == tree


def test_what_is_none_is_left_out_only_where_the_field_says_so():
    assert to_json(Leaf(count=1)) == {"count": 1, "share": None}


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
        ({"leaves": [LEAF, {"count": 10}]}, "leaves.1.count"),
        ({"leaves": [{"count": True}]}, "leaves.0.count"),
        ({"leaves": [{"count": 1.0}]}, "leaves.0.count"),
        ({"leaves": [{"share": 1}]}, "leaves.0"),
        ({"leaves": [LEAF | {"share": 10**400}]}, "leaves.0.share"),
        ({"by_name": {"b": None}}, "by_name.b"),
        ({"by_name": [LEAF]}, "by_name"),
        ({"pair": ["a"]}, "pair"),
        ({"pair": ["a", "b"]}, "pair.1"),
    ],
)
def test_a_value_of_another_type_is_named_by_its_place(change, place):
    from_json(Tree, TREE)
    with pytest.raises(Misfit) as misfit:
        from_json(Tree, TREE | change)
    assert misfit.value.place == place


def test_numbers_keep_their_values(old):
    report = RunReport.from_json(json.loads(FORMAT_1.read_text()) | {"seconds": {"mapping": 2}})
    assert report.seconds == {"mapping": 2.0}
