"""What a work folder holds, and how no entry of it leads to other files.

A work folder may come from somebody else. What lies in it must not decide which files outside are
written, moved or deleted. So `ENTRIES` names everything that jaxsfm writes, replaces or deletes
there, and the path of each comes from `entry`, which follows no link. A folder is refused when it
is opened if one of its entries is a link, or holds one (`check_entries`), so that a run does not
fail at its end. The folder itself may be reached through links, as the user likes.

COLMAP writes databases and models, and follows links. It is given folders that jaxsfm has just
made, and databases that were looked at.

Who may write into the folder while a command works there could still put a link into the place of
a folder, between a look at it and its use. Only a path that is looked at and used in one call of
the system would close this gap, and COLMAP has no such calls.
"""

import os
import shutil
import stat
from pathlib import Path, PureWindowsPath

from jaxsfm.errors import UserError
from jaxsfm.io.typed_files import read_json

RECORD = "run.json"
"""The file with the identity of the last run. A folder without it is not a work folder."""
FRAMES = "frames"
"""The folder with the frames of a video. It is there before the first run begins."""
FRAMES_RECORD = "frames.json"
"""The file in it that says what the frames were made from."""
VIEWS = "views"
"""The folder with the pinhole views of panoramas, and the other photos of their run."""
VIEWS_RECORD = "views.json"
"""The file in it that says what the views were made from."""
VIEW_MASKS = "view_masks"
"""The folder with the masks of the photos in it."""
PANORAMAS = "panoramas.csv"
"""The table with the poses of the panoramas."""
PAGE = "report.html"
"""The report page (`jaxsfm.report.page`). It is made from the other results, after them."""
STILL = "still.png"
"""The mask of what shows at the same pixels in all photos (`jaxsfm.io.still_pattern`)."""
DATABASE = "database.db"
RESULTS = (PAGE, "report.json", "sparse", "alternative", DATABASE, PANORAMAS)
LOGS = ("-journal", "-wal", "-shm")
"""What SQLite appends to the name of a database for the names of its log files. It reads them when
it opens the database, and a journal can name another file that is to be deleted."""
FAILED = "failed"
"""The folder for the report of a run without a model, beside an earlier model."""
LOCK, UNUSABLE = ".lock", "unusable.json"
FEATURES, MATCHES, DESCRIPTORS, STAGES = "features", "matches", "descriptors", "stages"
FRESH, PUBLISHING = "fresh", "publishing"
PARTIAL = ".partial"
"""The suffix of a file or folder that is still being written."""
ENTRIES = frozenset(
    [
        *RESULTS,
        *(DATABASE + end for end in LOGS),
        *(RECORD, LOCK, UNUSABLE, STILL, FAILED, FRESH, PUBLISHING, FRAMES, FRAMES + PARTIAL),
        *(FEATURES, MATCHES, DESCRIPTORS, STAGES),
        *(VIEWS, VIEWS + PARTIAL, VIEW_MASKS, VIEW_MASKS + PARTIAL),
    ]
)
"""The names of all that jaxsfm writes, replaces or deletes in a work folder. Beside them are files
NAME.PROCESS.partial, which are always made new."""
_JUNCTION = 0xA0000003
"""IO_REPARSE_TAG_MOUNT_POINT: a link to a folder that Windows does not call a symbolic link."""


def entry(folder: Path, name: str, *below: str) -> Path:
    """The path of an entry of a work folder, or of something in it.

    Args:
      name: one of `ENTRIES`.
      below: names of folders and files below it.

    Raises:
      UserError: the entry, or a folder on the way to it, is a link.
    """
    if name not in ENTRIES:
        raise ValueError(f"name must be one of ENTRIES; got {name!r}")
    path = folder
    for each in (name, *below):
        if each in ("", "..") or PureWindowsPath(each).name != each:
            raise ValueError(f"a name must have no folder in it; got {each!r}")
        path = path / each
        if is_link(path):
            raise _refused(path)
    return path


def check_entries(folder: Path) -> None:
    """Check that no entry of a work folder is a link or holds one.

    `frames` is not looked at: it is a folder of photos, in which links are followed to read them.
    It takes 0.1 s for the matches of 100 000 pairs.

    Raises:
      UserError: something is a link, or neither a file nor a folder.
      OSError: a folder cannot be read.
    """
    todo = []
    for path in (entry(folder, name) for name in sorted(ENTRIES - {FRAMES})):
        if path.is_dir():
            todo.append(path)
        elif path.exists() and not path.is_file():
            raise _refused(path)
    while todo:
        with os.scandir(todo.pop()) as found:
            for each in found:
                if each.is_dir(follow_symlinks=False):
                    if _leads_away(each.stat(follow_symlinks=False)):
                        raise _refused(Path(each.path))
                    todo.append(Path(each.path))
                elif not each.is_file(follow_symlinks=False):
                    raise _refused(Path(each.path))


def lock_file(folder: Path) -> Path:
    """The file by which a work folder is locked, which may be missing.

    Raises:
      UserError: it is a link, or another file too, which the lock would empty.
    """
    path = entry(folder, LOCK)
    if path.exists() and (not path.is_file() or (path.stat().st_nlink > 1 and path.stat().st_size)):
        raise UserError(f"{path}: this is not the lock of a run; delete it")
    return path


def named_place(path: Path) -> Path:
    """The place that a user names for results: where the path leads, if it is a link.

    Raises:
      UserError: a link that lies in a work folder leads to it. It need not be the user's own.
    """
    whole, inside = path.absolute(), False
    for each in (*reversed(whole.parents), whole):
        if each.name == "..":
            inside = False
        elif inside and is_link(each):
            raise _refused(each)
        inside = inside or "images" in (read_json(each / RECORD, dict) or {})
    return path.resolve() if is_link(path) else path


def remove(path: Path) -> None:
    """Delete a file or a folder, if it is there. Of a link, only the link itself is deleted."""
    if path.is_dir() and not is_link(path):
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def is_link(path: Path) -> bool:
    """Whether a path is a link to another place, which may be missing."""
    try:
        return _leads_away(path.lstat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _leads_away(found: os.stat_result) -> bool:
    return stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == _JUNCTION


def _refused(path: Path) -> UserError:
    if is_link(path):
        why = "jaxsfm follows no link in a work folder; delete it, or put the files in its place"
    else:
        why = "it is neither a file nor a folder; delete it"
    return UserError(f"{path}: {why}")
