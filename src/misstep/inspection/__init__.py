"""What is in a recording, and where each attempt went wrong: summary, pictures, page."""

from misstep.inspection.inspect import Inspection, inspect_file
from misstep.inspection.summary import ColumnSummary, EpisodeSummary

__all__ = ["ColumnSummary", "EpisodeSummary", "Inspection", "inspect_file"]
