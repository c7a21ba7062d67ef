"""A kernel was called: what numba takes a quarter of a second to load for the first one is there
for each program that is forked from a process which has imported this."""

from __future__ import annotations

from usdbrdf.transport.rays import empty_hits

empty_hits(1)
