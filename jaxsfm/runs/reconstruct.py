"""A whole run in its work folder: from photos or a video to a COLMAP model and a report."""

import dataclasses
import importlib.metadata
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
from tqdm import tqdm

from jaxsfm.colmap.poses import model_poses, read_poses
from jaxsfm.config import Config
from jaxsfm.errors import UserError, remark
from jaxsfm.io.atomic import Json, write_atomic
from jaxsfm.io.entries import FAILED, FRAMES, STILL, entry
from jaxsfm.io.images import ImageFile, named, orientations
from jaxsfm.io.pair_selection import chosen_pairs, many_frames
from jaxsfm.io.pairs import Pair
from jaxsfm.io.photo_folder import find_videos, masks_of, too_few, with_masks
from jaxsfm.io.rig_config import Rig, incomplete_frames, read_rigs
from jaxsfm.io.still_pattern import StillPattern, find_still_pattern
from jaxsfm.io.video import open_video
from jaxsfm.io.work_folder import lock_folder, open_folder
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.matching.pipeline import open_images
from jaxsfm.matching.retrieval import describe_photos, partner_pairs
from jaxsfm.options import Retrieval
from jaxsfm.report.page import page_after_run
from jaxsfm.report.run_inputs import LowResolution, RunIdentity, SamePixels, UsedWeights
from jaxsfm.report.run_report import RunReport, write_report
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.build_report import StageResults, evaluated, run_report
from jaxsfm.runs.first_words import first_words
from jaxsfm.runs.job import Job, pairs_without, timed
from jaxsfm.runs.panoramas import planned_panoramas
from jaxsfm.runs.run_inputs import cameras_of, read_inputs
from jaxsfm.runs.run_options import RunOptions, check_options
from jaxsfm.runs.run_photos import LostMatcher, RunPhotos
from jaxsfm.runs.run_stages import RunStages
from jaxsfm.runs.time_estimate import tell_time
from jaxsfm.runs.video.frames import frames_folder
from jaxsfm.runs.view_folder import panorama_views
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.check.still_model import with_still_models
from jaxsfm.sfm.refined_stage import Reconstructed

logger = logging.getLogger("jaxsfm")


def run_folder(images: Path, out: Path, *, config: Config, options: RunOptions) -> dict[str, Json]:
    """Reconstruct a folder of photos; returns the content of `out`/report.json.

    `checks` in it is what the photos say of each model, and `RunReport.from_json(...).verdict` is
    the verdict that follows. See `reconstruct_folder`, which returns the report as an object.
    """
    return reconstruct_folder(images, out, config=config, options=options).to_json()


def reconstruct_folder(
    images: Path,
    out: Path,
    *,
    config: Config,
    options: RunOptions,
    rigs: tuple[Rig, ...] = (),
) -> RunReport:
    """Reconstruct a folder of photos; returns the report, also written to `out`/report.json.

    Features, matches and finished stages are kept in `out` as soon as they are there, each under a
    key made of all that it depends on. So the same call continues an interrupted run, and a call
    with other photos or options uses again whatever does not depend on the change. `out`/sparse/0
    is the best model, and `out`/database.db is COLMAP's database.

    Args:
      images: folder of the photos.
      out: folder for the results; it is made if it does not exist.
      rigs: cameras that are mounted together, instead of those in the file `options.rig`.

    Raises:
      UserError: a photo, a file or an option cannot be used. What was computed is kept.
    """
    check_options(options)
    reference = read_poses(options.reference) if options.reference else None
    rigs = read_rigs(options.rig) if options.rig else rigs
    usable, skipped = open_images(images, progress=options.progress)
    _check_enough(images, usable, skipped)
    if options.masks is not None:
        usable, bare = with_masks(usable, options.masks)
        if bare:
            logger.warning("%s: no mask in %s, so all of it is used", named(bare), options.masks)
    plan = planned_panoramas(usable, config, options)
    count = len(usable if plan is None else plan.images)
    options = dataclasses.replace(options, pairs=chosen_pairs(options.pairs, count))
    inputs = read_inputs(usable, plan, skipped, rigs, config, options)
    given, pairs, cameras, panoramas = images, inputs.pairs, inputs.cameras, None
    if plan is not None:
        panoramas = panorama_views(plan, out, progress=options.progress)
        images, rigs = panoramas.folder, (*rigs, panoramas.rig)
        options = dataclasses.replace(options, masks=panoramas.masks)
        usable, lost = open_images(images, progress=options.progress)
        skipped |= lost | panoramas.lost
        if panoramas.masks is not None:
            usable, _ = with_masks(usable, panoramas.masks)
        cameras = cameras_of(usable, rigs, options)
    names = {image.name for image in usable}  # a view of which nothing is used is not there
    pairs = [pair for pair in pairs if names.issuperset(pair)]
    if options.intrinsics is None and cameras.known and options.refine_intrinsics == "auto":
        options = dataclasses.replace(options, refine_intrinsics="no")
    if lacking := incomplete_frames(rigs, names):
        logger.warning("%s: frames without a photo of each camera of their rig", named(lacking))
    selection, weights, relocalizer = inputs.selection, inputs.weights, inputs.relocalizer
    identity = RunIdentity(
        version=importlib.metadata.version("jaxsfm"),
        weights=weights.sha256,
        relocalizer=relocalizer and relocalizer.sha256,
        config=config.matching(),
        seed=options.seed,
        images={image.name: image.sha256 for image in usable},
        orientations=orientations(usable),
        masks=masks_of(usable),
    )
    seconds: dict[str, float] = {}
    with open_folder(out, to_json(identity)) as folder:
        if given.name != FRAMES:  # its photos were chosen from a video
            for words in first_words(given, usable, find_videos(given)):
                logger.info("%s", words)
        job = Job(
            store=folder,
            weights=weights,
            config=config,
            engine=chosen_engine(options.engine),
            execution=options.execution,
            seed=options.seed,
            progress=options.progress,
        )
        still = None if options.masks else _still_pattern(usable, out)
        skipped |= {i.name: why for i in usable if (why := folder.why_unusable(i)) is not None}
        if options.progress:
            by_name = {image.name: image for image in usable if image.name not in skipped}
            first = RunPhotos(
                job=job, identity=identity, images=by_name, pairs=pairs_without(pairs, skipped)
            )
            tell_time(first, selection.retrieval, seconds)
        if selection.retrieval:
            with timed(seconds, "retrieval"):
                tried = [image for image in usable if image.name not in skipped]
                apart = {} if plan is None else plan.panorama_of
                wanted = _Partners(options.retrieval, selection.retrieval, apart)
                found, lost = _retrieve(job, tried, wanted)
                pairs, skipped = sorted({*pairs, *found}), skipped | lost
        by_name = {image.name: image for image in usable if image.name not in skipped}
        photos = RunPhotos(
            job=job, identity=identity, images=by_name, pairs=pairs_without(pairs, skipped)
        )
        matched, lost = photos.match(seconds)
        skipped |= lost
        good = [image for image in usable if image.name not in skipped]
        _check_enough(images, good, skipped)
        cameras.check_fits(good)
        stages = RunStages(
            folder=folder,
            images=good,
            cameras=cameras,
            external=inputs.external,
            config=config,
            options=options,
            measured=inputs.measured,
            seconds=seconds,
        )
        photos = photos.without(lost)
        if config.checked and "upright" not in options.without and not rigs:
            photos, matched = photos.upright(matched, seconds)
            stages = dataclasses.replace(stages, images=[photos.images[i.name] for i in good])
        with folder.publish() as target:
            models = stages.walk(matched, target, LostMatcher(photos, matched.counts))
            low_resolution = None
            if matched.described != config:
                low_resolution = LowResolution(px=matched.described.max_size)
            if low_resolution and _lacks_detail(models.made, good):
                # Nothing that photos could be registered in was made of small photos.
                logger.info("no model was made of small photos; matching them at full size")
                low_resolution = dataclasses.replace(low_resolution, whole=True)
                matched = photos.match_at_full_size(matched.counts, seconds)
                models = stages.walk(matched, target, LostMatcher(photos, matched.counts))
            made = models.made if still is None else with_still_models(models.made, still.still)
            moved = stages.write(made, target)
            placed = None if panoramas is None else panoramas.write_poses(target, made.models)
            report = run_report(
                StageResults(
                    folder=images,
                    identity=photos.identity,
                    usable=good,
                    skipped=skipped,
                    results=matched.counts,
                    handed_on=models.handed_on,
                    external=inputs.external,
                    reconstructed=made,
                    georeference=moved,
                    weights=msgspec.convert(weights.described(config), UsedWeights),
                    low_resolution=low_resolution,
                    same_pixels=still and _in_report(still),
                    panoramas=placed,
                    seconds=seconds,
                ),
                config=config,
                options=options,
            )
            if reference is not None and made.models:
                report = evaluated(report, model_poses(made.models[0]), reference)
            write_report(target, report)
        if not options.keep_features:
            folder.drop_features()
        # The page is written before the lock is released: another run there would replace the files
        # that it shows.
        page_after_run(out if made.models or not (out / "sparse").exists() else out / FAILED)
        return report


def reconstruct_video(video: Path, out: Path, *, config: Config, options: RunOptions) -> RunReport:
    """Reconstruct a video: frames are chosen, and reconstructed as photos (`reconstruct_folder`).

    The frames are chosen once and kept in `out`/frames, which is the run's folder of photos. Frames
    of this video that are there already, for example chosen with another overlap, are used as they
    are.

    Raises:
      UserError: the video or an option cannot be used. What was computed is kept.
    """
    check_options(options)
    with open_video(video):  # what is no video makes no folder
        pass
    with lock_folder(out):
        found = frames_folder(video, out / FRAMES, progress=options.progress)
    how = "have been chosen before" if found.there else "were chosen"
    logger.info("%d frames %s, in %s", len(found.names), how, out / FRAMES)
    pairs = chosen_pairs(options.pairs, len(found.names), many_frames(found.common))
    options = dataclasses.replace(options, pairs=pairs)
    return reconstruct_folder(out / FRAMES, out, config=config, options=options)


def _still_pattern(images: Sequence[ImageFile], out: Path) -> StillPattern | None:
    """What shows at the same pixels in all photos; its mask is written into the work folder.

    It is only told: whoever sees the mask knows whether it is part of the scene.
    """
    found = remark("what stays at the same pixels", lambda: find_still_pattern(images))
    if found is not None:
        write_atomic(entry(out, STILL), found.mask())
        logger.warning("%s (%s)", _in_report(found).in_words(), out / STILL)
    return found


def _in_report(found: StillPattern) -> SamePixels:
    return SamePixels(share=found.share, photos=found.photos)


def _check_enough(folder: Path, images: list[ImageFile], skipped: dict[str, str]) -> None:
    if len(images) < 2:
        raise UserError(too_few(folder, len(images), skipped))


def _lacks_detail(made: Reconstructed, images: Sequence[ImageFile]) -> bool:
    """Whether larger photos may give a model that small ones did not give.

    A model of two photos is none: they say nothing about each other.
    """
    largest = max((model.num_reg_images() for model in made.models), default=0)
    return largest < min(MIN_VIEWS, len(images)) and not made.verification.no_depth


class _Partners(NamedTuple):
    """Which photos are partners of a photo."""

    kind: Retrieval
    k: int
    """Their number."""
    apart: dict[str, str]
    """The panoramas of views. Those of one are no partners."""


def _retrieve(
    job: Job, images: list[ImageFile], wanted: _Partners
) -> tuple[list[Pair], dict[str, str]]:
    """Pairs of each image with k similar ones, and why images have no descriptor."""
    total, quiet = len(images), not job.progress
    with tqdm(total=total, desc="retrieval", unit="image", disable=quiet) as bar:
        found = describe_photos(
            job.weights,
            images,
            kind=wanted.kind,
            store=job.store,
            execution=job.execution,
            on_image=bar.update,
        )
    for image, error in found.lost:
        job.store.record_failure(image, error)
    lost = {image.name: str(error) for image, error in found.lost}
    return partner_pairs(found.vectors, wanted.k, wanted.apart), lost
