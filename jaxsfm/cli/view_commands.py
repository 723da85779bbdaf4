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
    """Write the report of a run as one page of HTML.

    reconstruct writes this page by itself. Use this command to write it again, for example with
    photos that have moved or with other reference poses.

    Args:
      run: The folder of a run.
      images: The folder of the photos. Without it, the folder in which the run found them.
      reference: Reference poses (Strecha .camera files or a COLMAP model). Without it, those of the
        run.
      out: File.html to write. Without it, report.html in the folder of the run.
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
    """Show the model of a run in the browser, until Ctrl-C.

    Unlike the page that jaxsfm report writes, the viewer shows all points of large models.

    Args:
      run: The folder of a run.
      images: The folder of the photos. Without it, the folder in which the run found them.
      reference: Reference poses (Strecha .camera files or a COLMAP model). Without it, those of the
        run.
      port: The port of the server. If it is taken, the next free port is used.
      host: The address of the server. With 0.0.0.0, other machines can connect too.
    """
    if not 1 <= port <= 65535:
        raise UserError(f"--port must lie in 1 .. 65535; got {port}")
    from jaxsfm.report.finished_run import read_run
    from jaxsfm.report.viewer import serve

    serve(read_run(run, images=images, reference=reference), host=host, port=port)
    return 0
