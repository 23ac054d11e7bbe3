"""`regil report`: one run, or several beside each other, as a page that needs no other file.

* ``run_page``, ``comparison`` - the two pages, written from what ``run_contents`` reads in folders
* ``charts``, ``pictures``, ``guide_view``, ``episode_alignment`` - what is on them
* ``success_films`` - kept while a run learns
* ``page`` - the frame of every page, with ``page.html``
"""

from regil_sb3.report.comparison import write_comparison
from regil_sb3.report.run_page import write_report

__all__ = ["write_comparison", "write_report"]
