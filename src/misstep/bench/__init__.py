"""How fast misstep is, beside its peers, in one run.

run.py         the whole bench
plan.py        how much is measured
problems.py    data, starts and paths of states
measuring.py   what contenders are asked, task by task
contenders/    the contenders, each a program of its own
peers.py       the environment that they are installed in
worker.py      their processes
hardware.py    what the machine can do at best
own.py         a trial, a refit, a paper: what only misstep does
results.py     rows, ratios, slopes, targets
tables.py, markdown.py, figures.py, page.py    what is shown
"""
