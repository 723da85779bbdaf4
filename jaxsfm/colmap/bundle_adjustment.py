"""COLMAP's bundle adjustment of a whole model."""

import pycolmap

from jaxsfm.colmap.native import native


def bundle_adjust(
    reconstruction: pycolmap.Reconstruction,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
) -> None:
    """Adjust all poses and points of a model, in place.

    Observations of points that end behind a camera are taken out.

    Args:
      loss_px: scale of the Cauchy loss, original pixels. If it is well above the noise (0.1 px
        after refinement), sound observations count as in least squares, and others count little.
      refine_intrinsics: also adjust focal lengths and distortion.
      threads: of the solver; -1 takes all cores.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-7
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: it switches COLMAP's log messages on for the whole process.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    native(lambda _: adjuster.solve(), "bundle adjustment", grace_s=1)
    # The solver moves points behind cameras. COLMAP gives them an error of 1e154, and a model file
    # with it is refused.
    pycolmap.ObservationManager(reconstruction).filter_observations_with_negative_depth()
    reconstruction.update_point_3d_errors()  # the solver does not update them
