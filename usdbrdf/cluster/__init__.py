"""Units of work on other processes and machines, by Dask (extra ``cluster``)."""
