"""Parts of the sets of `bench ledger`: which photos they have, and what is made of them."""

import json

import pytest
from test_ledger import SET, TRUTH, judged_rows, write_run, write_set

from jaxsfm.bench import ledger_runs
from jaxsfm.bench.ledger import bench_ledger
from jaxsfm.bench.ledger_runs import LEAST, MOST, NOTHING_AFTER, part_of
from jaxsfm.bench.ledger_sets import SetPhotos
from jaxsfm.bench.model_options import LedgerOptions
from jaxsfm.errors import UserError
from jaxsfm.io.photo_folder import find_images

NAMES = [f"{k:03d}.jpg" for k in range(40)]


@pytest.fixture
def made(monkeypatch):
    """The runs that were asked for, whose models are right."""
    asked = []

    def reconstruct_set(run, folder):
        left = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        photos = [*find_images(run.given.photos)]
        asked.append((photos, {*run.given.truth}, run.options.without, left))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "matches").mkdir(exist_ok=True)
        (folder / "run.json").write_text("{}")
        models = folder / "run-of-its-own"
        write_run(models, [{name: TRUTH[name] for name in photos}])
        for path in models.iterdir():
            path.rename(folder / path.name)
        models.rmdir()

    monkeypatch.setattr(ledger_runs, "reconstruct_set", reconstruct_set)
    return asked


@pytest.mark.parametrize("number", range(30))
def test_a_part_is_photos_near_each_other(number):
    part = part_of(NAMES, number)
    assert LEAST <= len(part) <= MOST and part == sorted({*part}) and {*part} <= {*NAMES}
    first, last = (NAMES.index(part[k]) for k in (0, -1))
    assert last - first < 2 * len(part)
    assert part == part_of(NAMES, number)


def test_parts_differ_in_size_and_place_and_have_gaps():
    parts = [part_of(NAMES, number) for number in range(30)]
    assert len({*map(len, parts)}) > 5 and len({part[0] for part in parts}) > 5
    assert any(NAMES.index(p[-1]) - NAMES.index(p[0]) >= len(p) for p in parts)


@pytest.mark.parametrize("count", [LEAST + 1, 8])
def test_a_part_of_a_small_set_lacks_a_photo_of_it(count):
    assert {len(part_of(NAMES[:count], number)) for number in range(20)} == {*range(LEAST, count)}


def test_each_part_is_judged_by_its_own_photos_and_nothing_follows_its_check(tmp_path, made):
    write_set(tmp_path)
    rows = bench_ledger(
        LedgerOptions(root=tmp_path, out=tmp_path / "out", sets=(SET,), parts=3, seeds=1)
    )["rows"]
    assert [row["seed"] for row in rows] == [0, 1, 2]
    assert [(row["images"], row["right"]) for row in rows] == [(len(p), len(p)) for p, *_ in made]
    assert all({*photos} == truth for photos, truth, *_ in made)
    assert {without for *_, without, _ in made} == {NOTHING_AFTER}
    assert {row["without"] for row in rows} == {"parts"}


def test_matches_are_kept_from_part_to_part_and_results_are_not(tmp_path, made):
    write_set(tmp_path)
    whole = tmp_path / "out" / SET / "seed0" / "run"
    (whole / "matches").mkdir(parents=True)
    (whole / "run.json").write_text(json.dumps({}))
    bench_ledger(LedgerOptions(root=tmp_path, out=tmp_path / "out", sets=(SET,), parts=2))
    assert [left for *_, left in made] == [{"matches", "run.json"}] * 2


def test_a_rendered_scene_has_one_part(tmp_path, made, monkeypatch):
    given = SetPhotos(write_set(tmp_path) / "images", TRUTH)
    monkeypatch.setattr("jaxsfm.bench.ledger_sets.LedgerSet.photos", lambda *_: given)
    options = {"out": tmp_path / "out", "sets": ("ordinary-facade-00",), "parts": 5}
    bench_ledger(LedgerOptions(root=tmp_path, **options))
    assert [photos for photos, *_ in made] == [sorted(TRUTH)]


@pytest.mark.parametrize(("parts", "only"), [(-1, False), (2, True)])
def test_parts_that_cannot_be_made_are_refused(tmp_path, parts, only):
    with pytest.raises(UserError, match="--parts"):
        judged_rows(tmp_path, tmp_path / "out", parts=parts, only_judge=only)
