"""What a run was made with."""

import importlib.metadata
import platform

import jax

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


def versions() -> dict[str, str]:
    """Names and versions of Python, the packages that decide a result, the system and devices."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # another build of OpenCV, for one
            found[name] = "not known"
    devices = jax.devices()
    return {
        **found,
        "system": f"{platform.system()} {platform.machine()}",
        "devices": f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})",
    }
