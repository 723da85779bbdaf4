"""The versions of the software, and the devices, that a run was made with."""

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
    """Return the versions of Python and of the packages that decide a result, by name.

    This does not import the packages.
    """
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # for example another build of OpenCV
            found[name] = "not known"
    return found


def versions() -> dict[str, str]:
    """Return `package_versions`, the operating system and the devices of JAX, by name."""
    import jax

    devices = jax.devices()
    return {
        **package_versions(),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})",
    }
