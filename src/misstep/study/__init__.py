"""Studies: many runs, one table, one page.

spec.py          what to run: systems x demonstrators x learners x states x seeds, from TOML
cells.py         one run of it: demonstrate, learn, test the final policy
run.py           all of them, on processes or on Ray, resumable
ray_engine.py    the only file that knows Ray
table.py         cells.csv, summary.csv, summary.json
markdown.py      summary.md, the short table
figures.py       learning curves and histograms
page.py          report.html
"""

from misstep.study.run import run_study
from misstep.study.spec import Study, load_study

__all__ = ["Study", "load_study", "run_study"]
