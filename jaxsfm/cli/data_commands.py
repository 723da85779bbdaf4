"""`jaxsfm data`: public data sets for the benchmarks."""

from pathlib import Path

import tyro

from jaxsfm.cli.subcommands import one_of

Positional = tyro.conf.Positional


def list_all(*, to: Path | None = None) -> int:
    """Which there are, their sizes and terms, and which are there.

    Args:
      to: Folder of data sets; default: $JAXSFM_DATA, or the user's data folder.
    """
    from jaxsfm.bench import datasets

    for name, data_set in datasets.DATA_SETS.items():
        here = "there" if datasets.is_complete(name, to) else "not fetched"
        hashed = all(file.known_hash for file in data_set.files)
        print(f"{name:10s} {here}; {data_set.size}; for jaxsfm bench {data_set.bench}")
        print(f"{'':10s} {data_set.title}")
        print(f"{'':10s} {data_set.page}; terms: {data_set.terms}")
        print(
            f"{'':10s} {'hash known' if hashed else 'no published hash: that of what came is kept'}"
        )
    print(f"folder     {to or datasets.data_folder()}")
    return 0


def fetch(name: Positional[str], *, to: Path | None = None) -> int:
    """Download a data set; an interrupted download goes on.

    For example
        $ jaxsfm data fetch wxbs

    Args:
      name: Of the data set (jaxsfm data list).
      to: Folder of data sets; default: $JAXSFM_DATA, or the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.fetch(name, to, progress=True))
    return 0


def path(name: Positional[str], *, to: Path | None = None) -> int:
    """The folder to give to a benchmark's --root.

    Args:
      name: Of the data set (jaxsfm data list).
      to: Folder of data sets; default: $JAXSFM_DATA, or the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.path_of(name, to))
    return 0


_Data = one_of({"list": list_all, "fetch": fetch, "path": path})


def data(result: _Data) -> int:  # pyright: ignore[reportInvalidTypeForm]
    """Public data sets for the benchmarks."""
    return result
