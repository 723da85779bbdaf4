"""A finished run extended by photos that were added to its folder since.

They are matched with their shortlists alone, placed into the model, whose poses and points stay as
they are, and add points of their own (`jaxsfm.growing`).
Matches are kept as a run's are, so a later reconstruct of the folder goes on from them.
"""

import dataclasses
import json
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pycolmap
from tqdm import tqdm

from jaxsfm.advice import Circumstances
from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.evaluation import evaluate
from jaxsfm.failures import explained
from jaxsfm.growing import Grown, Newcomer, grow
from jaxsfm.host.atomic import write_atomic
from jaxsfm.host.colmap import colour_points, read_models, write_models
from jaxsfm.host.colmap_extend import add_images, add_matches
from jaxsfm.host.images import ImageFile, read_image
from jaxsfm.host.model import build_model
from jaxsfm.host.pairs import Pair, PairCounts, make_pair
from jaxsfm.host.poses import model_poses
from jaxsfm.host.store import SavedMatches
from jaxsfm.host.versions import versions
from jaxsfm.host.viewgraph import Verdict
from jaxsfm.host.workfolder import WorkFolder, open_folder
from jaxsfm.kept import KeptRun, read_run
from jaxsfm.known_run import (
    KnownModel,
    choose_camera,
    known_model,
    reader,
    run_files,
    run_weights,
    view_of,
)
from jaxsfm.localize import LocalizeOptions
from jaxsfm.page.after_run import page_after_run
from jaxsfm.pair_outcomes import PairOutcomes
from jaxsfm.pipeline import open_images
from jaxsfm.reconstruction import pixel_scale
from jaxsfm.report import model_figures, pair_figures
from jaxsfm.run import extract_missing, match_missing
from jaxsfm.run_options import RunOptions


class _New(NamedTuple):
    """What has been added to the folder."""

    images: dict[str, ImageFile]
    skipped: dict[str, str]
    """Photos that cannot be used, and why."""


def extend(run: Path, *, options: LocalizeOptions) -> dict[str, Any] | None:
    """Extend a finished run; returns its new report, or None if there are no new photos.

    `report["extended"]` has a row for every extension: when, which photos were added, which placed.

    Args:
      run: a run's OUT.

    Raises:
      UserError: no finished run with a model, or its photos or weights are not at hand.
    """
    kept = read_run(run, images=options.images, reference=options.reference)
    if kept.model is None:
        raise UserError(f"{run}: this run has no model to extend")
    if kept.photos.folder is None:
        raise UserError(f"{run}: where its photos lie is not known; say it with --images")
    config, weights = kept.config, run_weights(kept, options.network)
    identity = kept.report["identity"]
    if identity["version"] != versions()["jaxsfm"]:
        raise UserError(
            f"{run}: was made by jaxsfm {identity['version']}, this is {versions()['jaxsfm']}; "
            "run reconstruct again"
        )
    usable, skipped = open_images(kept.photos.folder, progress=options.progress)
    old = identity["images"]
    new = {image.name: image for image in usable if image.name not in old}
    if not new:
        return None
    model = known_model(run / "sparse" / "0", config, seed=kept.report["options"]["seed"])
    names = [view.name for view in model.views]
    files = run_files(kept, names) | new
    identity = identity | {"images": old | {name: image.sha256 for name, image in new.items()}}
    run_options = RunOptions(
        seed=model.seed,
        network=options.network,
        execution=options.execution,
        progress=options.progress,
    )
    with open_folder(run, identity) as folder:
        shortlist = options.chosen_shortlist(kept, weights, new)
        shortlists = {
            name: shortlist(image, [n for n in sorted([*names, *new]) if n != name])
            for name, image in new.items()
        }
        pairs = sorted({make_pair(a, b) for a, others in shortlists.items() for b in others})
        missing = [pair for pair in pairs if folder.load_matches(pair) is None]
        undecoded = extract_missing(folder, weights, files, missing, config, run_options)
        if old_lost := undecoded.keys() & set(names):
            raise UserError(undecoded[min(old_lost)])
        new = {name: image for name, image in new.items() if name not in undecoded}
        pairs = [pair for pair in pairs if not undecoded.keys() & set(pair)]
        missing = [pair for pair in missing if not undecoded.keys() & set(pair)]
        for _ in match_missing(folder, weights, files, missing, config, run_options):
            pass
        added = _New(new, {n: skipped[n] for n in skipped if n not in old} | undecoded)
        with folder.publish() as fresh:
            report = _extended(kept, folder, fresh, model, added, pairs, files, options)
            report["identity"] = identity
            text = json.dumps(report, indent=1, default=str)
            write_atomic(fresh / "report.json", text.encode())
        folder.drop_features()
        page_after_run(run)
        return report


def _extended(
    kept: KeptRun,
    folder: WorkFolder,
    fresh: Path,
    model: KnownModel,
    new: _New,
    pairs: list[Pair],
    files: Mapping[str, ImageFile],
    options: LocalizeOptions,
) -> dict[str, Any]:
    """Database and models in `fresh`; the report."""
    home, config = folder.path, model.config
    matches = SavedMatches(folder, pairs)
    chosen = {name: choose_camera(image, model.views, None) for name, image in new.images.items()}
    database = fresh / "database.db"
    shutil.copyfile(home / "database.db", database)
    added = add_images(database, {n: (new.images[n], chosen[n].camera) for n in chosen})
    verified = add_matches(
        database,
        matches,
        seed=model.seed,
        threads=kept.report["options"]["threads"],
        scale=pixel_scale(list(files.values()), config=config),
    )
    newcomers = {
        name: Newcomer(
            dataclasses.replace(
                view_of(image, chosen[name], config),
                image_id=added[name][0],
                camera=added[name][1],
            ),
            chosen[name].own,
            sorted({other for pair in pairs if name in pair for other in pair} - {name}),
        )
        for name, image in new.images.items()
    }
    quiet = not options.progress
    with tqdm(total=len(newcomers), desc="placing", unit="photo", disable=quiet) as bar:

        def on_view() -> None:
            bar.update()

        grown = grow(
            model.views,
            model.tracks,
            newcomers,
            matches,
            reader(files, config),
            refinement=config.refinement,
            seed=model.seed,
            on_view=on_view,
        )
    models = _models(home, database, grown, files, model)
    write_models(models, fresh / "sparse")
    return _report(kept, models, grown, new, matches, verified)


def _models(
    home: Path,
    database: Path,
    grown: Grown,
    files: Mapping[str, ImageFile],
    model: KnownModel,
) -> list[pycolmap.Reconstruction]:
    """The run's models, the best one grown."""
    models = read_models(home / "sparse", database)
    if grown.placed:
        models[0] = build_model(models[0], grown.views, grown.tracks)

        def read(name: str):
            config = model.config
            working = read_image(files[name], max_size=config.max_size, enlarge=config.enlarge)
            return working.rgb, working.scale

        colour_points(models[0], read)
    return models


def _report(
    kept: KeptRun,
    models: list[pycolmap.Reconstruction],
    grown: Grown,
    new: _New,
    matches: SavedMatches,
    verified: Mapping[Pair, int],
) -> dict[str, Any]:
    """The run's report with what is new."""
    report = dict(kept.report)
    counts = {pair: result.counts for pair, result in matches.items()}
    figures = [model_figures(model) for model in models]
    images, pairs = report["images"], report["pairs"]
    good = {pair for pair, each in counts.items() if each.num_inliers}
    rows = [pair_figures(p, c, good, dict(verified), {}) for p, c in counts.items()]
    each = sorted([*pairs["each"], *rows], key=lambda row: row["pair"])
    report |= {
        "images": images
        | {
            "folder": str(kept.photos.folder),
            "found": images["found"] + len(new.images) + len(new.skipped),
            "usable": images["usable"] + len(new.images),
            "skipped": images["skipped"] | new.skipped,
        },
        "pairs": pairs
        | {
            "tried": pairs["tried"] + len(counts),
            "verified": pairs["verified"] + len(good),
            "handed_on": pairs["handed_on"] + len(good),
            "overflowed": pairs["overflowed"] + sum(c.num_dropped > 0 for c in counts.values()),
            "trusted": pairs["trusted"] and pairs["trusted"] + len(verified),
            "each": each,
        },
        "models": figures,
        **explained(
            [each["images"] for each in figures],
            _outcomes(each, kept.config.min_inliers),
            Circumstances(
                config=kept.config,
                pairs=report["options"]["pairs"],
                known_camera=report["options"]["intrinsics"] is not None,
                sizes=_sizes(kept, new),
            ),
        ),
        "extended": [
            *report.get("extended", []),
            {
                "finished": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
                "added": sorted(new.images),
                "placed": sorted(grown.placed),
                "rounds": grown.rounds,
                "pairs": len(counts),
            },
        ],
    }
    for row in report["lost"]:
        if row["image"] in grown.located:
            row["detail"] = grown.located[row["image"]].why or row["detail"]
    if kept.reference is not None:
        try:
            found = evaluate(model_poses(models[0]), kept.reference.poses)
            report["evaluation"] = found.as_dict()
        except UserError as error:
            report["evaluation_failed"] = str(error)
    return report


def _outcomes(rows: list[dict[str, Any]], min_inliers: int) -> PairOutcomes:
    """What a report says of its pairs."""
    named = {(row["pair"][0], row["pair"][1]): row for row in rows}
    verdicts = {pair: row["view_graph"] for pair, row in named.items()}
    return PairOutcomes(
        results={
            pair: PairCounts(
                num_inliers=row["inliers"],
                num_planes=row["planes"],
                num_tentative=row["tentative"],
                num_dropped=0,
                status=Status[row["status"].upper()],
            )
            for pair, row in named.items()
        },
        handed_on={pair for pair, row in named.items() if row["handed_on"]},
        verified={pair: n for pair, row in named.items() if (n := row["colmap_inliers"])},
        verdicts={pair: Verdict(**verdict) for pair, verdict in verdicts.items() if verdict},
        angles={},
        min_inliers=min_inliers,
    )


def _sizes(kept: KeptRun, new: _New) -> dict[str, tuple[int, int]]:
    """Of every usable image that is still there."""
    skipped = kept.report["images"]["skipped"]
    old = kept.report["identity"]["images"].keys() - skipped.keys()
    every = {name: kept.photos.file(name) for name in old} | dict(new.images)
    return {name: image.size for name, image in sorted(every.items()) if image is not None}
