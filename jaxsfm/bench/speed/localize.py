"""Localize every image of a run in a model that was made without it.

    jaxsfm reconstruct PHOTOS --out RUN --intrinsics K.txt --reference SET
    python -m jaxsfm.bench.speed.localize RUN --reference SET --out FOLDER

The matches are those of the run. They are verified once, each pair by itself. Then for each image a
model is made from the pairs without it, in the same way as the model of the run; views that are too
dark for alignment are not placed. Models and rows stay in FOLDER: the same command continues from
there, and any other command is refused.
"""

import argparse
import json
import os
import shutil
import statistics
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("GLOG_minloglevel", "2")  # COLMAP tells of every step

from jaxsfm.colmap.database import drop_pairs, write_database
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views, verify
from jaxsfm.io.atomic import read_json, write_atomic
from jaxsfm.io.images import ImageFile
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches, digest
from jaxsfm.io.versions import versions
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.localize import locate_photo
from jaxsfm.runs.localize_report import LocalizedPhoto, error_against
from jaxsfm.runs.working_model import camera_prior, read_working_model
from jaxsfm.sfm.refine.passes import refine_model
from jaxsfm.sfm.view_graph import trusted_pairs

Row = dict[str, Any]
"""The figures of an image, as `jaxsfm localize` writes them."""
LIMITS = (0.3, 1.0)
"""Largest good errors: units of the reference, and degrees."""


def verified(run: FinishedRun, files: dict[str, ImageFile], scratch: Path) -> Path:
    """A database of all pairs of the run, each verified by itself."""
    database = scratch / "verified.db"
    if database.exists():
        return database
    assert run.model is not None
    known = None
    if run.report.options.intrinsics is not None:  # its file may be gone
        camera = run.model.views[0].camera
        known = Intrinsics(model=camera.model_name, params=tuple(camera.params))
    pairs = [row.pair for row in run.report.pairs.each if row.handed_on]
    partial, options = scratch / "partial.db", map_options(run, files)
    write_database(partial, list(files.values()), SavedMatches(run.matches, pairs), known)
    verification = VerificationOptions(
        seed=options.seed,
        threads=options.threads,
        scale=options.scale,
        relative_poses=run.config.view_graph,
    )
    verify(partial, verification)
    return partial.rename(database)


def map_options(run: FinishedRun, files: dict[str, ImageFile]) -> MapOptions:
    """The mapper's options of the run."""
    options = run.report.options
    refines = options.others["refine_intrinsics"]
    return MapOptions(
        mapper="global" if options.others["mapper"] == "global" else "incremental",
        refine_intrinsics=options.intrinsics is None if refines == "auto" else refines == "yes",
        seed=options.seed,
        threads=options.threads,
        scale=Photos(files.values(), run.config).median_scale(),
    )


def without(
    run: FinishedRun, name: str, files: dict[str, ImageFile], scratch: Path, refined: bool
) -> None:
    """Make the model without an image, in `scratch`/NAME/sparse."""
    folder, options = scratch / name, map_options(run, files)
    database = folder / "database.db"
    shutil.copy(verified(run, files, scratch), database)
    pairs = read_two_views(database)
    dropped = [pair for pair in pairs if name in pair]
    kept = {pair: view for pair, view in pairs.items() if name not in pair}
    if run.config.view_graph:
        verdicts = trusted_pairs({pair: view.geometry for pair, view in kept.items()})
        dropped += [pair for pair, verdict in verdicts.items() if not verdict.trusted]
    drop_pairs(database, dropped)
    models, _ = build_models(database, {p: kept[p] for p in kept.keys() - set(dropped)}, options)
    if refined and run.config.refinement:
        models[0], _ = refine_model(
            models[0],
            Photos(files.values(), run.config).gray,
            refinement=run.config.refinement,
            refine_intrinsics=options.refine_intrinsics,
            threads=options.threads,
        )
    write_models(models[:1], folder / "fresh")
    (folder / "fresh").rename(folder / "sparse")
    database.unlink()


def localized(run: FinishedRun, name: str, files: dict[str, ImageFile], folder: Path) -> Row:
    """Localize an image in the model without it; returns its row of the table."""
    seed = run.report.options.seed
    model, image = read_working_model(folder / "sparse" / "0", run.config, seed=seed), files[name]
    chosen = camera_prior(image, model.views, None)
    names = [view.name for view in model.views]
    pairs = [row.pair for row in run.report.pairs.each if name in row.pair]
    pairs = [pair for pair in pairs if set(pair) - {name} <= set(names)]
    matches = SavedMatches(run.matches, pairs)
    start = time.monotonic()
    found = locate_photo(
        image, chosen, model, names, matches, Photos(files.values(), run.config).gray
    )
    seconds, error = time.monotonic() - start, None
    if found.view is not None and run.reference is not None:
        error = error_against(name, found.view, model.views, run.reference.poses)
    row = LocalizedPhoto(
        photo=name,
        in_run=name,
        shortlist=names,
        matches=sum(result.num_inliers for result in matches.values()),
        source=chosen.source,
        found=found,
        error=error,
    )
    return row.to_json() | {"seconds": seconds, "registered": len(names)}


def line(row: Row) -> str:
    """A row of the table as text."""
    error, expected = row.get("error"), row["confidence"]
    if not error:
        return f"{row['photo']:12s} {row['status']:9s} {row['why']}"
    return (
        f"{row['photo']:12s} {row['status']:9s} {error['position']:8.4f} "
        f"{error['rotation_deg']:8.4f}  expected {expected['centre_error'] or 0:8.4f} units "
        f"{expected['rotation_error_deg'] or 0:7.4f} deg  "
        f"{row['inliers']:5d} of {row['on_surface']:5d} matches  "
        f"{row['agreed']:5d} of {row['candidates']:5d} points  {row['seconds']:.0f} s"
    )


def check_same(folder: Path, key: dict[str, object]) -> None:
    """End the program if the content of `folder` was made from something else."""
    path = folder / "key.json"
    if path.exists():
        old = read_json(path)
        kept = old if isinstance(old, dict) else {}
        if changed := sorted(name for name in key if kept.get(name) != key[name]):
            sys.exit(f"--out {folder}: was made with another {changed[0]}; choose another folder")
    elif folder.exists() and any(folder.iterdir()):
        sys.exit(f"--out {folder}: not empty, and not made by this command; choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(key, indent=1).encode())


def main() -> int:
    """Print the table; returns 1 if more than one image is outside `LIMITS`."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--unrefined", action="store_true", help="models as the mapper made them")
    parser.add_argument("--only", nargs="*", help="these images alone")
    args = parser.parse_args()
    run = read_run(args.run, reference=args.reference)
    assert run.model is not None
    names = args.only or sorted(view.name for view in run.model.views)
    files = {}
    for view in run.model.views:
        found = run.photos.file(view.name)
        assert found is not None, f"{view.name} is gone"
        files[view.name] = found
    key = {
        "run": digest(to_json(run.report.identity), to_json(run.report.options)),
        "reference": str(args.reference.absolute()),
        "version": versions(),
        "unrefined": args.unrefined,
    }
    check_same(args.out, key)
    rows = []
    for name in names:
        folder = args.out / name
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "sparse").exists():
            without(run, name, files, args.out, not args.unrefined)
        if not (folder / "row.json").exists():
            row = localized(run, name, files, folder)
            write_atomic(folder / "row.json", json.dumps(row, indent=1).encode())
        rows.append(json.loads((folder / "row.json").read_text()))
        print(line(rows[-1]), flush=True)
    errors = [row["error"] for row in rows if row.get("error")]
    good = sum(e["position"] <= LIMITS[0] and e["rotation_deg"] <= LIMITS[1] for e in errors)
    print(
        f"{good} of {len(rows)} within {LIMITS[0]} and {LIMITS[1]} deg; median "
        f"{statistics.median(e['position'] for e in errors):.4f}, "
        f"{statistics.median(e['rotation_deg'] for e in errors):.4f} deg"
    )
    return 0 if good >= len(rows) - 1 else 1


if __name__ == "__main__":
    sys.exit(main())
