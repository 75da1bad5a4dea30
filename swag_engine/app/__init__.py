"""Command line, worker process and batch runs."""
