"""What the processes of all jobs share: imported once, in the process that they are forked from."""

from afm_rl.imports import without_collection

with without_collection():
    import afm_rl.jobs.run  # noqa: F401
