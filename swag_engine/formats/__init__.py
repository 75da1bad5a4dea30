"""Files that other programs read and write, and the files of a run."""
