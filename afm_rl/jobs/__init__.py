"""Jobs: the missions of one method, run alone or many at a time, and what they leave behind.

=============== =================================================================================
layout          the files of a run and of a batch, by name
run             one run in its folder: begun, gone on with, published
process         one job of a batch: a run in a process of its own
executor        where jobs run, and how far they are
batch           many jobs, and their tables
=============== =================================================================================
"""
