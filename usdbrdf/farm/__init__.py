"""Many scans on a farm: a job bundle of them, the work of its tasks, and what came of all."""
