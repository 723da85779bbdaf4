"""The report as a page: complete, harmless, small, and never in a run's way."""

import dataclasses
import html
import json
import logging
import re
import shutil

import numpy as np
import pytest
from kept_runs import HOSTILE, change_report, renamed
from verdicts import NAMES, check_of, with_verdicts

from jaxsfm.cli.main import main
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.colmap.poses import read_poses
from jaxsfm.core.types import Status
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.page import figures, write
from jaxsfm.report.page.pairs import pair_table, state
from jaxsfm.report.page.write import figures3, page
from jaxsfm.report.run_results import LostPhoto, PairRow
from jaxsfm.report.scene import shown_scene
from jaxsfm.report.verdict import model_verdicts
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.view_graph import Verdict

SECTIONS = ("the-model", "photos", "pairs", "matches", "run", "next")
FIGURES = ("model", "reprojection")
LOADS = re.compile(
    r"<[^>]*\s(?:src|href|srcset|poster|data)\s*=\s*(?![\"']?(?:data:|#))[^\s>]", re.I
)
SCRIPT = re.compile(r"<script[^>]*>.*?</script>", re.S)


def without_scripts(text: str) -> str:
    return SCRIPT.sub("", text)


@pytest.fixture(scope="module")
def text(plain) -> str:
    return (plain[0] / "report.html").read_text()


def row(a: str, b: str, inliers=100, verified=80, edge_weight=0.5, trusted=True) -> PairRow:
    verdict = Verdict(
        trusted=trusted,
        edge_weight=edge_weight,
        rotation_error_deg=1.0,
        reason="" if trusted else "it is off",
    )
    return PairRow(
        pair=(a, b),
        status=Status.VERIFIED,
        tentative=2 * inliers,
        inliers=inliers,
        planes=3,
        handed_on=inliers > 0,
        colmap_inliers=verified,
        view_graph=verdict if verified else None,
    )


# -- what is in it ------------------------------------------------------------------------------


def test_every_run_leaves_a_page_with_all_parts(text, plain):
    for section in SECTIONS:
        assert f'<section id="{section}">' in text, section
    for figure in FIGURES:
        assert f'data-for="{figure}"' in text, figure
    assert "All 3 photos are in one model." in text
    assert f"{plain[1]['models'][0]['reprojection_error_px']:.2f} px" in text
    for name in ("view0.png", "view1_night.png", "view2.png", "pycolmap", "max_planes"):
        assert name in text, name


def test_every_figure_and_picture_is_described(text):
    body = without_scripts(text)
    assert body.count("<figure") == body.count("<figcaption") >= 5
    for tag in re.findall(r"<img[^>]*>", body):
        assert re.search(r'alt="[^"]+', tag)
    for tag in re.findall(r"<(?:svg|div)[^>]*role=\"img\"[^>]*>", body):
        assert re.search(r'aria-label="[^"]+', tag)


def test_the_page_loads_nothing_from_outside(text):
    body = without_scripts(text)
    assert LOADS.search(body) is None and "@import" not in body and "url(" not in body
    assert not re.search(r"<script[^>]*\ssrc", text) and "<iframe" not in body
    assert LOADS.search('<img alt="" src="http://x/y.png">') and LOADS.search("<link href=a.css>")


def test_the_command_adds_the_errors_against_a_reference(plain, scene, tmp_path, capsys):
    out = tmp_path / "with.html"
    args = ["--reference", str(scene / "reference"), "--out", str(out)]
    assert main(["report", str(plain[0]), *args]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    text = out.read_text()
    assert 'id="errors"' in text and 'data-for="positions"' in text
    assert "Against the reference the cameras are off by" in text
    assert 'id="errors"' not in (plain[0] / "report.html").read_text()


def test_shown_cameras_differ_from_the_reference_by_the_evaluated_errors(plain, scene):
    run = read_run(plain[0], reference=scene / "reference")
    shown = shown_scene(run)
    truth = {camera.name: camera for camera in shown.reference}
    assert run.report.evaluation is not None
    errors = run.report.evaluation.images
    assert len(shown.cameras) == len(truth) == 3
    for camera in shown.cameras:
        other = truth[camera.name]
        off = np.linalg.norm(camera.pose.centre - other.pose.centre)
        assert off == pytest.approx(errors[camera.name].position, abs=1e-9)
        # Both look at the same things: frusta point the same way.
        ahead = [c.corners.mean(0) / np.linalg.norm(c.corners.mean(0)) for c in (camera, other)]
        assert ahead[0] @ ahead[1] > 0.99 and camera.corners.mean(0) @ camera.pose.rotation[2] > 0
    # The room's cameras are upright (y down), so its floor is below them and z is up.
    reference = read_poses(scene / "reference")
    low = min(c.pose.centre[2] for c in shown.reference)
    heights = {c.name: c.pose.centre[2] - low for c in shown.reference}
    order = sorted(heights, key=heights.__getitem__)
    assert order == sorted(reference, key=lambda name: -reference[name].centre[1])


# -- names, limits, gaps ------------------------------------------------------------------------


def test_names_from_files_are_only_ever_text(plain, scene, tmp_path):
    out, _ = renamed(plain[0], scene / "images", tmp_path, "view0.png", HOSTILE)
    assert main(["report", str(out)]) == 0
    text = (out / "report.html").read_text()
    assert HOSTILE not in text and "<img src=x" not in text
    assert text.count(html.escape(HOSTILE, quote=True).replace("&#x27;", "&#39;")) > 5
    for source in re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.S):
        assert "<" not in source
        json.loads(source)


def many(n: int, lost: int) -> list[PairRow]:
    names = [f"s/{k:04d}.jpg" for k in range(n - lost)]
    near = lambda a, b: 3000 // (b - a) if b - a < 40 else 30  # noqa: E731
    return [
        row(names[a], names[b], near(a, b), near(a, b) // 2, 1 / (b - a), trusted=b - a < 40)
        for a in range(len(names))
        for b in range(a + 1, len(names))
    ]


def test_a_large_run_has_a_small_page_that_says_what_is_left_out(plain):
    n, lost = 400, 70
    rows = many(n, lost)
    run = read_run(plain[0])
    missing = [
        LostPhoto(image=f"s/{k:04d}.jpg", stage="pairs", detail=f"gone {k}")
        for k in range(n - lost, n)
    ]
    names = [f"s/{k:04d}.jpg" for k in range(330)]
    report = dataclasses.replace(
        run.report,
        pairs=dataclasses.replace(run.report.pairs, each=rows),
        models=[dataclasses.replace(run.report.models[0], images=names)],
        lost=missing,
    )
    text = page(dataclasses.replace(run, report=report))
    small = len((plain[0] / "report.html").read_text())
    assert len(text) < small + 1_000_000
    body = without_scripts(text)
    assert all(f"gone {k}" in body.lower() for k in range(n - lost, n))  # every lost image and why
    assert "10 more lost photos" in body and "The 330 photos with the smallest errors" in body
    odd = sum(state(r) == "not trusted" for r in rows)
    assert f"{odd - 15} more are in report.json" in body


def test_points_beyond_the_limit_are_drawn_in_part_and_the_page_says_so(plain, monkeypatch):
    scene = shown_scene(read_run(plain[0]))
    n = len(scene.points)
    whole = figures.model_figure(scene)
    monkeypatch.setattr(figures, "MAX_POINTS", n // 2)
    part = figures.model_figure(scene)
    assert f"{n // 2} of {n} points are drawn" in part.note
    assert "points are drawn" not in whole.note
    assert len(json.loads(part.spec)["data"][0]["marker"]["color"]) == n // 2


@pytest.mark.parametrize("what", ["photos", "matches", "changed"])
def test_a_page_without_photos_or_matches_has_all_the_rest(plain, scene, tmp_path, what):
    out, images = tmp_path / "run", tmp_path / "images"
    shutil.copytree(plain[0], out)
    shutil.copytree(scene / "images", images)
    if what == "matches":
        shutil.rmtree(out / "matches")
    for path in images.iterdir():
        if what == "photos":
            path.unlink()
        elif what == "changed":  # another photo under the same name would be a lie
            path.write_bytes(path.read_bytes() + b"\0")
    assert main(["report", str(out), "--images", str(images)]) == 0
    body = without_scripts((out / "report.html").read_text())
    assert 'id="matches"' not in body
    assert ("<img" in body) == (what == "matches")
    assert "All 3 photos are in one model." in body and 'id="model"' in body


def test_a_run_without_a_model_says_why_each_photo_was_lost(plain, tmp_path):
    def lose(report):
        names = report["models"][0]["images"]
        report.update(models=[], refinement=[], mapping=[])
        report["lost"] = [
            {"image": name, "stage": "no plane", "detail": f"<{k}> matches"}
            for k, name in enumerate(names)
        ]
        del report["versions"], report["finished"], report["images"]["folder"]  # an older run
        del report["no_model"], report["view_graph"]

    out = tmp_path / "run"
    shutil.copytree(plain[0], out)
    change_report(out, lose)
    assert main(["report", str(out)]) == 0
    body = without_scripts((out / "report.html").read_text())
    assert "No model could be built." in body and 'id="the-model"' not in body
    for k in range(3):
        assert f"<b>Lost: no plane.</b> &lt;{k}&gt; matches" in body


def test_a_run_in_parts_says_what_parts_them_and_what_may_help(plain, tmp_path):
    def part(report):
        a, b, c = report["models"][0]["images"]
        near = {"pair": [b, HOSTILE], "missed": "7 matches, 26 are needed"}
        groups = [
            {"images": [a, b], "pairs": 1, "registered": 2, "nearest": near},
            {"images": [c, HOSTILE], "pairs": 1, "registered": 0, "nearest": near},
        ]
        report["view_graph"]["components"] = groups
        why = {"stage": "not connected", "detail": "few"}
        found = [
            {"option": "--some <option>", "reason": "small"},
            {"option": None, "reason": "far"},
        ]
        report["lost"] = [{"image": HOSTILE, **why, "help": found}]

    out = tmp_path / "run"
    shutil.copytree(plain[0], out)
    change_report(out, part)
    assert main(["report", str(out)]) == 0
    body = without_scripts((out / "report.html").read_text())
    assert "<li>View graph: 2 groups of 2, 2 images; no trusted pair joins two groups.</li>" in body
    assert "7 matches, 26 are needed.</li>" in body and HOSTILE not in body
    assert "<li><code>--some &lt;option&gt;</code>: small</li><li>far</li>" in body
    change_report(out, lambda report: report.update(models=[], no_model="nothing <fits>"))
    assert main(["report", str(out)]) == 0
    assert "<p>Nothing &lt;fits&gt;.</p>" in (out / "report.html").read_text()


@pytest.mark.parametrize("colour", ["green", "amber", "red"])
def test_the_page_says_the_verdict_with_all_its_photos(plain, colour):
    run = read_run(plain[0])
    unchecked = dataclasses.replace(run, report=with_verdicts(run.report, None))
    assert 'id="verdict"' not in page(unchecked)
    report = with_verdicts(run.report, colour)
    body = without_scripts(page(dataclasses.replace(run, report=report)))
    (verdict,) = model_verdicts(report.checked)
    head, _, rest = body.partition('id="outcome"')
    assert f"Verdict {verdict.headline}." in head and rest
    assert (f"<b>What next:</b> {verdict.advice}." in head) == (colour != "green")
    for name in NAMES:
        assert (name in head) == (colour != "green"), name
    assert len(verdict.reasons) == (colour != "green")
    for label, findings in verdict.reasons:
        assert f"<h3>{label.capitalize()}</h3>" in head
        for found in findings:
            assert f"<li>{found.text}." in head


def test_a_page_of_a_doubtful_model_has_no_green_outcome(plain):
    run = read_run(plain[0])
    for colour, word in (("green", "good"), ("amber", "partial"), ("red", "partial")):
        report = with_verdicts(run.report, colour)
        text = page(dataclasses.replace(run, report=report))
        assert f'class="outcome {word}"' in text


def test_the_page_names_the_camera_that_the_photos_speak_for(plain):
    run = read_run(plain[0])
    assert 'id="camera"' not in page(run)
    camera = OtherCamera(model="PINHOLE", params=[5, 5, 3, 2], distance_px=4, halves_px=0.5)
    figures = RefinementFigures(passes=[], registrations=[], camera=camera)
    report = dataclasses.replace(run.report, refinement=[figures])
    body = without_scripts(page(dataclasses.replace(run, report=report)))
    assert f"<b>Camera:</b> {camera.in_words()}." in body


@pytest.mark.parametrize(
    ("doubt", "label"),
    [
        ({"unconfirmed": True}, "Not refined"),
        ({"scale_drift": NAMES[:2]}, "Scale"),
        ({"same_pixels": True}, "Same pixels"),
    ],
)
def test_the_page_says_what_speaks_against_a_model_as_a_whole(plain, doubt, label):
    run = read_run(plain[0])
    check = dataclasses.replace(check_of("green"), **doubt)
    report = dataclasses.replace(run.report, checks=[check])
    (verdict,) = model_verdicts(report.checked)
    (reason,) = verdict.reasons
    body = without_scripts(page(dataclasses.replace(run, report=report)))
    assert f"<h3>{label}</h3>" in body and f"<li>{reason.findings[0].text}." in body


def test_names_in_a_verdict_are_only_ever_text(plain):
    run = read_run(plain[0])
    check = check_of("amber")
    place = dataclasses.replace(check.pose_ambiguities[0], image=HOSTILE, pairs=[HOSTILE] * 5)
    check = dataclasses.replace(check, pose_ambiguities=[place])
    text = page(dataclasses.replace(run, report=dataclasses.replace(run.report, checks=[check])))
    assert (
        HOSTILE not in text and html.escape(HOSTILE, quote=True).replace("&#x27;", "&#39;") in text
    )


def test_a_long_verdict_says_what_is_left_out(plain):
    run = read_run(plain[0])
    check = check_of("red")
    many = dataclasses.replace(check, contradictions=check.contradictions * 40)
    text = page(dataclasses.replace(run, report=dataclasses.replace(run.report, checks=[many])))
    assert "35 more are in report.json." in text


# -- never in a run's way -----------------------------------------------------------------------


def test_a_page_that_fails_costs_one_line_and_nothing_else(
    scene, tmp_path, monkeypatch, capsys, plain
):
    def broken(*args, **kwargs):
        raise MemoryError("no room")

    out = tmp_path / "run"
    shutil.copytree(plain[0], out)  # matched already: only mapped again
    monkeypatch.setattr(write, "write_page", broken)
    args = ["--intrinsics", str(scene / "K.txt"), "--threads", "1", "--refine", "0"]
    assert main(["reconstruct", str(scene / "images"), "--out", str(out), *args]) == 0
    lines = [x for x in capsys.readouterr().err.splitlines() if "report.html" in x]
    assert len(lines) == 1 and "was not written (no room)" in lines[0]
    assert json.loads((out / "report.json").read_text())["models"]
    assert not (out / "report.html").exists()  # the old page told of the old model


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["{tmp}"], "no finished run here"),
        (["{run}", "--images", "{tmp}/none"], "--images .*: no such folder"),
        (["{run}", "--reference", "{tmp}/none"], "--reference .*: no such folder"),
        (["{run}", "--out", "{tmp}/page.pdf"], "--out .*: the name must end in .html"),
        (["{damaged}"], "no finished run here"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(plain, tmp_path, capsys, args, says):
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "report.json").write_text('{"pairs": ')
    places = {"tmp": tmp_path, "run": plain[0], "damaged": damaged}
    assert main(["report", *(arg.format(**places) for arg in args)]) == 2
    assert re.search(says, capsys.readouterr().err)


def test_reference_poses_that_are_gone_are_a_warning(plain, tmp_path, caplog):
    out = tmp_path / "run"
    shutil.copytree(plain[0], out)
    change_report(out, lambda report: report["options"].update(reference=str(tmp_path / "gone")))
    with caplog.at_level(logging.WARNING):
        assert read_run(out).reference is None
    assert "reference poses of the run are not shown" in caplog.text


# -- parts --------------------------------------------------------------------------------------


def test_states_follow_a_pair_through_the_pipeline():
    rows = [
        row("a", "b"),
        row("a", "b", trusted=False),
        row("a", "b", verified=0),
        dataclasses.replace(row("a", "b"), handed_on=False),
        row("a", "b", inliers=0, verified=0),
    ]
    names = ["used", "not trusted", "not verified", "not chosen", "no plane"]
    assert [state(r) for r in rows] == names
    assert state(dataclasses.replace(row("a", "b"), view_graph=None)) == "used"
    table = pair_table([*rows, *rows[1:3]])
    assert [(n, name) for n, name, _ in table.counts] == list(
        zip([1, 2, 2, 1, 1], names, strict=True)
    )
    assert [why for _, why in table.refused][:2] == ["not trusted: it is off"] * 2
    assert table.refused[2][1].startswith("not verified: it has matches, but COLMAP")


def test_far_points_are_left_out_and_counted(plain):
    run = read_run(plain[0])
    assert run.model is not None
    points = run.model.tracks.points.copy()
    few = len(points) // 200
    points[:few] += 1e4
    tracks = run.model.tracks._replace(points=points)
    shown = shown_scene(dataclasses.replace(run, model=run.model.with_tracks(tracks)))
    near = shown_scene(run)
    assert shown.far == near.far + few
    assert len(shown.points) + shown.far == len(points) and np.abs(shown.points).max() < 1e3


def test_a_scene_far_from_its_origin_is_shown_around_zero(plain, scene):
    run = read_run(plain[0], reference=scene / "reference")
    assert run.reference is not None
    moved = Similarity(1.0, np.eye(3), np.asarray([4.5e5, 5.2e6, 300.0]))
    far = dataclasses.replace(run, reference=run.reference._replace(similarity=moved))
    assert np.abs(shown_scene(far).points).max() < 1e3


def test_small_and_large_errors_are_written_out():
    values = (5.2345e-05, 0.02312, 0.0, 1.0, 12345.6)
    assert [figures3(v) for v in values] == ["0.0000523", "0.0231", "0", "1", "12300"]
