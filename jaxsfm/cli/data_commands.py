"""The commands `jaxsfm data`: list and download public data sets for the benchmarks."""

from pathlib import Path

import tyro

from jaxsfm.cli.subcommands import one_of

Positional = tyro.conf.Positional


def list_all(*, to: Path | None = None) -> int:
    """List the data sets with their sizes and terms, and say which of them have been fetched.

    Args:
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    for name, data_set in datasets.DATA_SETS.items():
        here = "fetched" if datasets.is_complete(name, to) else "not fetched"
        published = all(file.known_hash for file in data_set.files)
        hashes = (
            "hash published" if published else "no published hash; that of the download is kept"
        )
        print(f"{name:10s} {here}; {data_set.size}; for jaxsfm bench {data_set.bench}")
        print(f"{'':10s} {data_set.title}")
        print(f"{'':10s} {data_set.page}; terms: {data_set.terms}")
        print(f"{'':10s} {hashes}")
    print(f"folder     {to or datasets.data_folder()}")
    return 0


def fetch(name: Positional[str], *, to: Path | None = None) -> int:
    """Download a data set. If a download is interrupted, the same command continues it.

    For example
        $ jaxsfm data fetch wxbs

    Args:
      name: Name of the data set (jaxsfm data list).
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.fetch(name, to, progress=True))
    return 0


def path(name: Positional[str], *, to: Path | None = None) -> int:
    """Print the folder of a data set. The benchmarks take it as --root.

    Args:
      name: Name of the data set (jaxsfm data list).
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.path_of(name, to))
    return 0


_Data = one_of({"list": list_all, "fetch": fetch, "path": path})


def data(result: _Data) -> int:  # pyright: ignore[reportInvalidTypeForm]
    """List and download public data sets for the benchmarks."""
    return result
