"""The report of a run as one page of HTML that needs nothing else."""

from jaxsfm.page.write import write_page as write_page
