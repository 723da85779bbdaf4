"""The one place that talks to COLMAP (pycolmap 4.2): database, verification, mapping.

Everything is checked here first: a match index out of range ends the process in native code, and
unset options fail silently. Pixels get their +0.5 here and nowhere else.

zlib and cv2 are imported before pycolmap on purpose: pycolmap 4.2.1 brings a zlib of its own, and
where it is loaded first every later deflate (zlib.compress, PNG by OpenCV or Pillow) corrupts the
heap (measured). `import jaxsfm` loads zlib. Pillow's PNG encoder can fail even so; it is not used.
"""

import dataclasses
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal

import cv2  # noqa: F401  must precede pycolmap, see above
import numpy as np
import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.host import interrupt
from jaxsfm.host.images import ImageError, ImageFile, shown_name
from jaxsfm.host.intrinsics import Intrinsics
from jaxsfm.host.pairs import Pair, PairResult, describe

pycolmap.logging.minloglevel = 3

THREAD = "jaxsfm-colmap"
"""Name of the thread COLMAP runs in."""
Mapper = Literal["incremental", "global"]
PIXEL_OFFSET = np.float32(0.5)
"""COLMAP puts the centre of the top-left pixel at (0.5, 0.5)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapOptions:
    """How verified matches become a model."""

    mapper: Mapper = "incremental"
    refine_intrinsics: bool = True
    seed: int = 0
    threads: int = -1
    """Threads of verification and bundle adjustment; -1: all. One makes the model repeatable to
    the last byte."""
    scale: float = 1.0
    """Original pixels per working pixel: COLMAP's pixel thresholds grow with it."""


def keypoint_tables(results: Iterable[PairResult]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per image the cells used by any pair, ascending, and their (x, y).

    A cell is the same keypoint in every pair, so tracks join by index.
    """
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for result in results:
        for side, xy in enumerate((result.keypoints0, result.keypoints1)):
            parts.setdefault(result.pair[side], []).append((result.cells[:, side], xy))
    tables = {}
    for name, rows in parts.items():
        cells, first = np.unique(np.concatenate([c for c, _ in rows]), return_index=True)
        tables[name] = (cells, np.concatenate([xy for _, xy in rows])[first])
    return tables


def _checked_matches(
    result: PairResult, tables: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Indices into the keypoint tables, uint32 (n, 2); ValueError for what COLMAP dies of."""
    columns = []
    for side, name in enumerate(result.pair):
        cells = tables[name][0]
        index = np.searchsorted(cells, result.cells[:, side])
        if len(index) and (
            index.max() >= len(cells) or (cells[index] != result.cells[:, side]).any()
        ):
            raise ValueError(f"pair {describe(result.pair)}: a match has no keypoint")
        if len(np.unique(index)) != len(index):
            raise ValueError(f"pair {describe(result.pair)}: a keypoint is matched twice")
        columns.append(index)
    return np.stack(columns, axis=1).astype(np.uint32)


def camera_for(image: ImageFile, intrinsics: Intrinsics | None) -> pycolmap.Camera:
    """The given camera, or one from the photo's EXIF focal length (else 1.2 x the longer side)."""
    if intrinsics is not None:
        camera = intrinsics.camera(image.size)
    else:
        try:
            camera = pycolmap.infer_camera_from_image(image.path)
        except Exception:  # COLMAP reads fewer formats than we do; it raises RuntimeError or more
            camera = None
        if camera is None or (camera.width, camera.height) != image.size:
            width, height = image.size
            camera = pycolmap.Camera(
                model="SIMPLE_RADIAL",
                width=width,
                height=height,
                params=[1.2 * max(width, height), width / 2, height / 2, 0.0],
            )
    if not camera.verify_params():
        raise UserError(
            f"{shown_name(image.name)}: COLMAP does not accept the camera {camera.model_name} "
            f"{camera.params}"
        )
    return camera


def write_database(
    path: Path,
    images: list[ImageFile],
    results: Mapping[Pair, PairResult],
    intrinsics: Intrinsics | None,
) -> None:
    """A new COLMAP database with cameras, images, keypoints and matches.

    Args:
      results: the pairs handed on; images without any stay in the database without keypoints.

    Raises:
      ValueError: inconsistent results (nothing is written).
    """
    for pair, result in results.items():
        if pair != result.pair:
            raise ValueError(f"pair {describe(pair)} holds the result of {describe(result.pair)}")
        n = result.num_inliers
        if not (result.cells.shape == result.keypoints0.shape == result.keypoints1.shape == (n, 2)):
            raise ValueError(f"pair {describe(pair)}: cells and keypoints must be {n} x 2")
    tables = keypoint_tables(results.values())
    names = {image.name: image for image in images}
    if unknown := sorted(tables.keys() - names.keys()):
        raise ValueError(f"results name images that are not given: {unknown[0]!r}")
    for name, (_, xy) in tables.items():
        if not np.isfinite(xy).all():
            raise ValueError(f"{name}: keypoints must be finite")
        if (xy < -0.5).any() or (xy > np.asarray(names[name].size) - 0.5).any():
            raise ValueError(f"{name}: keypoints outside the image {names[name].size}")
    matches = {
        pair: _checked_matches(result, tables)
        for pair, result in sorted(results.items())
        if result.num_inliers
    }
    empty = np.zeros((0, 2), np.float32)
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        ids = {}
        camera_id = None
        for image in sorted(images, key=lambda i: i.name):
            if camera_id is None or intrinsics is None:
                camera_id = db.write_camera(camera_for(image, intrinsics))
            ids[image.name] = db.write_image(pycolmap.Image(name=image.name, camera_id=camera_id))
            xy = tables[image.name][1] if image.name in tables else empty
            db.write_keypoints(ids[image.name], (xy + PIXEL_OFFSET).astype(np.float32))
        for (a, b), index in matches.items():
            db.write_matches(ids[a], ids[b], index)


def verify(path: Path, options: MapOptions, token: pycolmap.CancellationToken) -> None:
    """COLMAP's own two-view verification of all pairs (paper, section 4)."""
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.ransac.random_seed = options.seed
    two_view.ransac.max_error *= options.scale
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads
    pycolmap.geometric_verification(
        path,
        verifier_options=verifier,
        two_view_geometry_options=two_view,
        cancellation_token=token,
    )


def verified_counts(path: Path) -> dict[Pair, int]:
    """Inliers of COLMAP's verification, per pair that has any."""
    with pycolmap.Database.open(path) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        pair_ids, geometries = db.read_two_view_geometries()
        counts = {}
        for pair_id, geometry in zip(pair_ids, geometries, strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            if len(geometry.inlier_matches):
                name0, name1 = sorted((names[a], names[b]))
                counts[name0, name1] = len(geometry.inlier_matches)
        return counts


def _incremental_options(options: MapOptions) -> pycolmap.IncrementalPipelineOptions:
    p = pycolmap.IncrementalPipelineOptions()
    p.ba_refine_focal_length = p.ba_refine_extra_params = options.refine_intrinsics
    p.ba_refine_principal_point = False
    p.num_threads = p.mapper.num_threads = options.threads
    p.random_seed = p.mapper.random_seed = options.seed
    p.min_model_size = 2
    p.extract_colors = False  # coloured by `colour_points`, from our own reader
    p.mapper.init_max_error *= options.scale
    p.mapper.abs_pose_max_error *= options.scale
    p.mapper.filter_max_reproj_error *= options.scale
    p.triangulation.complete_max_reproj_error *= options.scale
    p.triangulation.merge_max_reproj_error *= options.scale
    return p


def _global_options(options: MapOptions) -> pycolmap.GlobalPipelineOptions:
    p = pycolmap.GlobalPipelineOptions()
    p.num_threads = options.threads
    p.random_seed = options.seed
    p.mapper.num_threads = options.threads
    p.mapper.random_seed = options.seed
    ba = p.mapper.bundle_adjustment
    ba.refine_focal_length = ba.refine_extra_params = options.refine_intrinsics
    ba.refine_principal_point = False
    return p


def build_models(
    database: Path, options: MapOptions, *, on_image: Callable[[], None] = lambda: None
) -> list[pycolmap.Reconstruction]:
    """Verify and map; the models, the one with most registered images first; empty if none.

    Runs beside the calling thread, which therefore stays open to Ctrl-C: native code is asked to
    stop, then KeyboardInterrupt goes on.

    Args:
      on_image: called for every image registered (incremental mapper).
    """
    token = pycolmap.CancellationToken()
    models: dict[int, pycolmap.Reconstruction] = {}
    failure: list[BaseException] = []
    done = threading.Event()

    def work(scratch: str) -> None:
        try:
            verify(database, options, token)
            if token.is_cancelled:
                return
            if options.mapper == "incremental":
                models.update(
                    pycolmap.incremental_mapping(
                        database,
                        scratch,
                        scratch,
                        _incremental_options(options),
                        initial_image_pair_callback=lambda: (on_image(), on_image()) and None,
                        next_image_callback=on_image,
                        cancellation_token=token,
                    )
                )
            else:
                models.update(
                    pycolmap.global_mapping(database, scratch, scratch, _global_options(options))
                )
        except BaseException as error:
            failure.append(error)
        finally:
            done.set()

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        threading.Thread(target=work, args=(scratch,), name=THREAD, daemon=True).start()
        try:
            # Not Thread.join: Ctrl-C inside it makes Python 3.11 take the thread for ended, and the
            # process then aborts under the native code that still runs.
            while not done.wait(0.2):
                interrupt.check()
            interrupt.check()
        except KeyboardInterrupt:
            token.cancel()
            done.wait(30 if options.mapper == "incremental" else 1)  # the global one has no token
            raise
    if failure and isinstance(failure[0], RuntimeError):
        raise UserError(f"{database}: COLMAP failed ({failure[0]}); the matches are kept")
    if failure:
        raise failure[0]
    return sorted(
        models.values(),
        key=lambda m: (-m.num_reg_images(), -m.num_points3D(), min(m.reg_image_ids())),
    )


def write_models(models: list[pycolmap.Reconstruction], folder: Path) -> None:
    """`folder`/0 the best model, 1, 2, ... the others; what was there before goes."""
    shutil.rmtree(folder, ignore_errors=True)
    for index, model in enumerate(models):
        target = folder / str(index)
        target.mkdir(parents=True)
        model.write_binary(target)


def colour_points(
    model: pycolmap.Reconstruction,
    read_rgb: Callable[[str], tuple[np.ndarray, tuple[float, float]]],
) -> None:
    """Give every 3-D point the mean colour of its observations, in place.

    Args:
      read_rgb: image name -> (uint8 (h, w, 3), (x, y) original pixels per pixel).
    """
    total: dict[int, np.ndarray] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        try:
            rgb, scale = read_rgb(image.name)
        except ImageError:  # the photo went away since; its points keep the others' colours
            continue
        for point in image.points2D:
            if point.has_point3D():
                x, y = np.floor(point.xy / np.asarray(scale)).astype(int)
                x, y = min(max(x, 0), rgb.shape[1] - 1), min(max(y, 0), rgb.shape[0] - 1)
                value = np.append(rgb[y, x].astype(np.float64), 1.0)
                total[point.point3D_id] = total.get(point.point3D_id, 0.0) + value
    for point_id, value in total.items():
        model.point3D(point_id).color = np.round(value[:3] / value[3]).astype(np.uint8)
