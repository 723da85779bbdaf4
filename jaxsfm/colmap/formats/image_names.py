"""The names of a model's images, and what other formats can do with them."""

from collections.abc import Iterable
from pathlib import PurePath

import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name


def check_no_blanks(names: Iterable[str], to: str) -> None:
    """Raise UserError for names that a format would cut in two."""
    for name in names:
        if len(name.split()) != 1 or name != name.strip():
            raise UserError(
                f"--to {to}: {shown_name(name)!r} has a blank in it, where {to} ends a name"
            )


def leads_out(name: str, path_type: type[PurePath] = PurePath) -> bool:
    """Whether a name, joined to a folder, gives a path that is not below the folder.

    Args:
      path_type: the kind of paths of the system. On Windows, drives (`C:a.jpg`) and the separator
        `\\` lead out as well.
    """
    path = path_type(name)
    return bool(path.anchor) or ".." in path.parts


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images with a pose, by name; UserError if a name leads out of the photos' folder."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    for image in images:
        if leads_out(image.name):
            raise UserError(f"{shown_name(image.name)}: an image outside the photos' folder")
    return sorted(images, key=lambda image: image.name)
