"""Command line, worker process and batch runs."""

import gc

# Importing torch makes hundreds of thousands of objects that stay. Searching them for garbage at every 700 new ones, as
# Python does by itself, takes a fifth of the time until a process begins to work.
gc.set_threshold(10_000)
