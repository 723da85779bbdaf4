"""The page at the end of a run."""

import logging
from pathlib import Path

from jaxsfm.io.work_folder import PAGE

logger = logging.getLogger(__name__)


def page_after_run(results: Path) -> None:
    """Write the page of results that lie in place; a fault here costs the page alone."""
    try:
        from jaxsfm.report.page.write import write_page

        logger.info("what it did, to look at: %s", write_page(results))
    except Exception as error:
        logger.warning("%s was not written (%s)", results / PAGE, error)
