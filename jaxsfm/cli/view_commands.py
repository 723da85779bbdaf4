"""The commands that show a finished run: `jaxsfm report` and `jaxsfm view`."""

from pathlib import Path

from jaxsfm.cli.run_commands import Positional, check_writable
from jaxsfm.errors import UserError


def report(
    run: Positional[Path],
    *,
    images: Path | None = None,
    reference: Path | None = None,
    out: Path | None = None,
) -> int:
    """Write a run's report as one page of HTML (reconstruct does so by itself).

    Args:
      run: A run's folder.
      images: Folder with the photos; default: where the run found them.
      reference: Reference poses (Strecha .camera files or a COLMAP model); default: the run's.
      out: File.html; default: report.html in the run's folder.
    """
    check_writable(out, "--out", (".html",))
    from jaxsfm.report.page.write import write_page

    print(write_page(run, images=images, reference=reference, out=out))
    return 0


def view(
    run: Positional[Path],
    *,
    images: Path | None = None,
    reference: Path | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
) -> int:
    """Show a run's model in the browser, however large, until Ctrl-C.

    Args:
      run: A run's folder.
      images: Folder with the photos; default: where the run found them.
      reference: Reference poses (Strecha .camera files or a COLMAP model); default: the run's.
      port: Where the browser finds it; the next free one if it is taken.
      host: Address to listen on; 0.0.0.0 lets other machines in.
    """
    if not 1 <= port <= 65535:
        raise UserError(f"--port must lie in 1 .. 65535; got {port}")
    from jaxsfm.report.finished_run import read_run
    from jaxsfm.report.viewer import serve

    serve(read_run(run, images=images, reference=reference), host=host, port=port)
    return 0
