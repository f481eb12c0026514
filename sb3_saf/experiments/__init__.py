"""
The paper's experiments by name: ``python -m sb3_saf.experiments list | plan NAME | run NAME | report NAME``.

An experiment (``definitions``) is a grid of cells (``cells``), each of which is trained and tested in a process of its
own (``work``) by an engine, on this machine (``local``) or on a Ray cluster (``on_ray``). Results lie in one folder per
cell (``results``), from which the table (``table``) and the report (``report``) are made.
"""
