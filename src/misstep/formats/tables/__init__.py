"""Tables, as CSV and Parquet hold them: a row for each observation, and what was done there.

misstep writes these columns, and reads any others that it is told about:

==================  ============================================================================
column              meaning
==================  ============================================================================
``episode``         number of the episode; the column that changes from one to the next
``time [s]``        time of the observation, from the start of the episode
``x [m]``           an observation, with its unit if it has one
``action:F [N]``    an action; empty in the last row of an episode, which leads nowhere
``cost``            cost of the step; empty where none were recorded
``misstep``         in the first and in the last row of an episode, what else is known of it: one
                    line of JSON, see `misstep.formats.annotation`. With it a file holds all that
                    misstep knows, and comes back the same to the last bit
==================  ============================================================================
"""

from misstep.formats.tables.csv_files import FORMAT as CSV
from misstep.formats.tables.parquet_files import FORMAT as PARQUET

__all__ = ["CSV", "PARQUET"]
