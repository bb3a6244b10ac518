"""The paper, whole: its experiments, figures, tables and claims, on our own runs."""
