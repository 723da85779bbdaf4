"""`jaxsfm localize` and `jaxsfm extend`: new photos for a finished run."""

import sys
from json import dumps
from pathlib import Path

from jaxsfm.cli.run_commands import Positional, check_writable
from jaxsfm.io.libraries import limit_threads
from jaxsfm.options import EngineChoice, NewPhotosChoice, WeightsChoice


def localize(
    photos: Positional[tuple[Path, ...]],
    *,
    model: Path,
    out: Path | None = None,
    reference: Path | None = None,
    new_photos: NewPhotosChoice,
    network: WeightsChoice,
    engine: EngineChoice,
) -> int:
    """Find where photos were taken, with the models of a finished run, which do not change.

    The exit status is 1 if no photo could be localized.

    For example
        $ jaxsfm localize A.jpg --model OUT --out poses.json

    Args:
      photos: Photos, or folders with photos.
      model: The folder of a finished run.
      out: File.json to write: the poses, the numbers of matches that support them, and their
        expected errors.
      reference: Reference poses of these photos and of the run's photos, as in reconstruct.
        With them, the errors of the poses are printed.
      network: The files of the network's parameters. They must be those of the run.
    """
    check_writable(out, "--out", (".json",))
    limit_threads(new_photos.threads)
    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.runs.localize import localize_photos
    from jaxsfm.runs.localize_report import localize_lines
    from jaxsfm.runs.run_options import LocalizeOptions

    options = LocalizeOptions(
        **vars(new_photos), reference=reference, network=network, engine=engine, progress=True
    )
    result = localize_photos(photos, model, options=options)
    if out is not None:
        write_atomic(out, dumps(result.to_json(), indent=1).encode())
    print("\n".join(localize_lines(result)))
    if not any(row.status == "localized" for row in result.photos):
        print("jaxsfm: no photo could be localized: see above", file=sys.stderr)
        return 1
    return 0


def extend(
    run: Positional[Path],
    *,
    new_photos: NewPhotosChoice,
    network: WeightsChoice,
    engine: EngineChoice,
) -> int:
    """Add photos to the models of a finished run.

    Put the new photos into the folder of the run's photos first. Each gets its place in the model
    that it fits best. Poses and points that are already in the models do not change.

    The exit status is 1 if no new photo found its place.

    For example
        $ jaxsfm extend OUT

    Args:
      run: The folder of a finished run.
      network: The files of the network's parameters. They must be those of the run.
    """
    limit_threads(new_photos.threads)
    from jaxsfm.io.images import shown_name
    from jaxsfm.runs.extend import extend_run
    from jaxsfm.runs.run_options import LocalizeOptions

    options = LocalizeOptions(**vars(new_photos), network=network, engine=engine, progress=True)
    report = extend_run(run, options=options)
    if report is None:
        print(f"no new photos for {run}")
        return 0
    assert report.extended is not None
    last = report.extended[-1]
    placed, without = set(last.placed), set(last.added) - set(last.placed)
    for name in last.skipped:
        print(f"skipped    {report.images.skipped[name]}")
    for photo in report.lost:
        if photo.image in without:
            print(f"lost       {shown_name(photo.image)}: {photo.detail}")
    print(f"placed     {len(last.placed)} of {len(last.added)} new photos in {last.rounds} rounds")
    for k, model in enumerate(report.models):
        if grown := placed.intersection(model.images):
            print(
                f"sparse/{k}   {len(grown)} new photos: {model.registered} images, "
                f"{model.points} points"
            )
    return 0 if last.placed else 1
