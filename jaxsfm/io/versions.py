"""What a run was made with."""

import importlib.metadata
import platform

PACKAGES = (
    "jaxsfm",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
)


def package_versions() -> dict[str, str]:
    """Names and versions of Python and of the packages that decide a result; quick."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # another build of OpenCV, for one
            found[name] = "not known"
    return found


def versions() -> dict[str, str]:
    """`package_versions`, the system and the devices."""
    import jax

    devices = jax.devices()
    return {
        **package_versions(),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})",
    }
