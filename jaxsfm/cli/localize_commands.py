"""`jaxsfm localize` and `jaxsfm extend`: more photos for a finished run."""

import sys
from json import dumps
from pathlib import Path

from jaxsfm.cli.run_commands import Positional, check_writable
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice


def localize(
    photos: Positional[tuple[Path, ...]],
    *,
    model: Path,
    out: Path | None = None,
    images: Path | None = None,
    intrinsics: str | None = None,
    reference: Path | None = None,
    shortlist: int = 20,
    keep_features: bool = False,
    network: WeightsChoice = USUAL_WEIGHTS,
) -> int:
    """Where photos were taken, in the model of a finished run, which stays as it is.

    Ends with 1 if no photo could be localized.

    For example
        $ jaxsfm localize A.jpg --model OUT --out poses.json

    Args:
      photos: Photos, or folders of them.
      model: A run's folder.
      out: File.json for poses, what they rest on and their expected errors.
      images: Folder with the run's photos; default: where the run found them.
      intrinsics: Of the photos, as in reconstruct; default: the run's camera, if exactly one of
        this size is that of several photos, else one per photo, whose focal length is estimated.
      reference: Reference poses (Strecha .camera files or a COLMAP model) of these photos and of
        the run's: errors are told.
      shortlist: How many of the run's photos, the most similar ones, a photo is matched with.
      keep_features: Leave the features of those in the run's folder (25 MB for a photo of
        1536 x 1024): the next call has them at hand.
      network: The network's parameters; they must be the run's.
    """
    check_writable(out, "--out", (".json",))
    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.runs.localize import LocalizeOptions, localize_photos
    from jaxsfm.runs.localize_report import localize_lines

    options = LocalizeOptions(
        images=images,
        intrinsics=intrinsics,
        reference=reference,
        shortlist=shortlist,
        keep_features=keep_features,
        network=network,
        progress=True,
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
    images: Path | None = None,
    intrinsics: str | None = None,
    shortlist: int = 20,
    keep_features: bool = False,
    network: WeightsChoice = USUAL_WEIGHTS,
) -> int:
    """Put photos that were added to a finished run's folder since into its model.

    Poses and points that are there stay as they are. Ends with 1 if no new photo found its place.

    For example
        $ jaxsfm extend OUT

    Args:
      run: A run's folder.
      images: Folder with the photos, old and new; default: where the run found them.
      intrinsics: Of the new photos, as in localize.
      shortlist: How many others, the most similar ones, a new photo is matched with.
      keep_features: Do not delete the folder's features in the end; see localize.
      network: The network's parameters; they must be the run's.
    """
    from jaxsfm.io.images import shown_name
    from jaxsfm.runs.extend import extend_run
    from jaxsfm.runs.localize import LocalizeOptions

    options = LocalizeOptions(
        images=images,
        intrinsics=intrinsics,
        shortlist=shortlist,
        keep_features=keep_features,
        network=network,
        progress=True,
    )
    report = extend_run(run, options=options)
    if report is None:
        print(f"no new photos for {run}")
        return 0
    assert report.extended is not None
    last, model = report.extended[-1], report.models[0]
    for name in last.skipped:
        print(f"skipped    {report.images.skipped[name]}")
    for photo in report.lost:
        if photo.image in last.added:
            print(f"lost       {shown_name(photo.image)}: {photo.detail}")
    print(
        f"placed     {len(last.placed)} of {len(last.added)} new photos in "
        f"{last.rounds} rounds: {model.registered} images, {model.points} points"
    )
    return 0 if last.placed else 1
