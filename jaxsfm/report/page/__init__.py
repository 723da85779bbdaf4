"""The report of a run as one page of HTML that needs nothing else."""

import logging
from pathlib import Path

from jaxsfm.io.entries import PAGE

logger = logging.getLogger(__name__)


def page_after_run(results: Path) -> None:
    """Write the page of finished results. A failure is only a warning: the run is not affected."""
    try:
        from jaxsfm.report.page.write import write_page

        write_page(results)
    except Exception as error:
        logger.warning("%s was not written (%s)", results / PAGE, error)
