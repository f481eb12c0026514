"""
Grids of trainings by name: ``python -m sb3_saf.experiments list | plan | run | report | check``.

An experiment is a grid of cells (``definitions``). ``run`` submits each unfinished cell to a process of this machine or
of a Ray cluster (``engines``), which trains and tests it (``cell``). Results are in one folder per cell (``results``),
from which tables (``tables``) and the report (``report``) are made.
"""
